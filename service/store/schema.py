"""The tables, written once in the words of SQLite, as steps that a database goes through in their order.

Each step is a name, under which a database notes that it has gone through it, and statements. What is released stays as it is:
databases have gone through it. The engines apply the steps, each in its own words.
"""

SEGMENT = """n INTEGER NOT NULL, first_us INTEGER NOT NULL, last_us INTEGER NOT NULL, last_seq INTEGER NOT NULL,
        seq BLOB NOT NULL, time BLOB NOT NULL, value BLOB NOT NULL"""
OUTLINE = "instants INTEGER NOT NULL, time BLOB NOT NULL, value BLOB NOT NULL"
"""Columns that samples and residuals have in common."""

TWINS_AND_SAMPLES = f"""
    CREATE TABLE twin (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        name TEXT NOT NULL UNIQUE,
        specification TEXT NOT NULL,
        created_us INTEGER NOT NULL
    );
    CREATE TABLE head (
        twin INTEGER PRIMARY KEY REFERENCES twin(id) ON DELETE CASCADE,
        seq INTEGER NOT NULL DEFAULT 0,
        samples INTEGER NOT NULL DEFAULT 0,
        first_us INTEGER,
        last_us INTEGER,
        small_chunks INTEGER NOT NULL DEFAULT 0,
        small_rows INTEGER NOT NULL DEFAULT 0
    );
    CREATE TABLE chunk (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        {SEGMENT}
    );
    CREATE INDEX chunk_span ON chunk (twin, last_us, first_us, n);
    CREATE INDEX chunk_seq ON chunk (twin, last_seq);
"""

MODELS_AND_JOBS = """
    CREATE TABLE model (
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        version INTEGER NOT NULL,
        created_us INTEGER NOT NULL,
        source TEXT NOT NULL,
        summary TEXT NOT NULL,
        document TEXT NOT NULL,
        PRIMARY KEY (twin, version)
    );
    CREATE TABLE activation (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        twin INTEGER NOT NULL,
        version INTEGER NOT NULL,
        at_us INTEGER NOT NULL,
        reason TEXT NOT NULL,
        FOREIGN KEY (twin, version) REFERENCES model (twin, version) ON DELETE CASCADE
    );
    CREATE INDEX activation_twin ON activation (twin, id);
    CREATE TABLE job (
        number INTEGER PRIMARY KEY AUTOINCREMENT,
        id TEXT NOT NULL UNIQUE,
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        kind TEXT NOT NULL,
        state TEXT NOT NULL,
        progress REAL NOT NULL DEFAULT 0,
        message TEXT NOT NULL DEFAULT '',
        request TEXT NOT NULL,
        created_us INTEGER NOT NULL,
        started_us INTEGER,
        finished_us INTEGER,
        result TEXT,
        page TEXT
    );
    CREATE INDEX job_twin ON job (twin, kind, number);
    CREATE TABLE event (
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        seq INTEGER NOT NULL,
        time_us INTEGER NOT NULL,
        type TEXT NOT NULL,
        body TEXT NOT NULL,
        PRIMARY KEY (twin, seq)
    ) WITHOUT ROWID;
"""

RESIDUALS_AND_ANOMALIES = f"""
    CREATE TABLE residual (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        version INTEGER NOT NULL,
        {SEGMENT}
    );
    CREATE INDEX residual_span ON residual (twin, last_us, first_us, n);
    CREATE INDEX residual_seq ON residual (twin, last_seq);
    CREATE TABLE checkpoint (
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        version INTEGER NOT NULL,
        time_us INTEGER NOT NULL,
        n INTEGER NOT NULL,
        state TEXT NOT NULL,
        PRIMARY KEY (twin, version, time_us)
    ) WITHOUT ROWID;
    CREATE TABLE anomaly (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        sensor TEXT NOT NULL,
        kind TEXT NOT NULL,
        start_us INTEGER NOT NULL,
        stop_us INTEGER,
        score REAL NOT NULL,
        cause TEXT,
        version INTEGER NOT NULL
    );
    CREATE INDEX anomaly_twin ON anomaly (twin, start_us);
"""

OUTLINES = f"""
    CREATE TABLE chunk_outline (
        chunk INTEGER PRIMARY KEY REFERENCES chunk(id) ON DELETE CASCADE,
        {OUTLINE}
    );
    CREATE TABLE residual_outline (
        chunk INTEGER PRIMARY KEY REFERENCES residual(id) ON DELETE CASCADE,
        {OUTLINE}
    );
"""
"""Add outlines of large chunks; chunks that were stored before have none and are read whole."""

CLOCKS = """
    ALTER TABLE chunk ADD COLUMN received BLOB;
    ALTER TABLE head ADD COLUMN revision INTEGER NOT NULL DEFAULT 0;
    CREATE TABLE deletion (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        at_us INTEGER NOT NULL,
        place TEXT NOT NULL,
        start_us INTEGER,
        stop_us INTEGER,
        channels TEXT,
        samples INTEGER NOT NULL,
        undone_us INTEGER
    );
    CREATE INDEX deletion_twin ON deletion (twin, id);
    CREATE TABLE aside (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        deletion INTEGER REFERENCES deletion(id) ON DELETE CASCADE,
        n INTEGER NOT NULL,
        first_us INTEGER NOT NULL,
        last_us INTEGER NOT NULL,
        time BLOB NOT NULL,
        received BLOB NOT NULL,
        value BLOB NOT NULL
    );
    CREATE INDEX aside_twin ON aside (twin, deletion, first_us, last_us, n);
"""
"""Add receive times (chunks of earlier releases have none), and a place for samples that are set aside.

``head.revision`` grows whenever stored samples are taken away: what was computed from them before is outdated then.
"""

ALARMS = """
    CREATE TABLE alarm (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        origin TEXT NOT NULL,
        channel TEXT NOT NULL,
        colour TEXT NOT NULL,
        side TEXT NOT NULL,
        bound REAL NOT NULL,
        start_us INTEGER NOT NULL,
        stop_us INTEGER,
        body TEXT NOT NULL,
        acknowledged_us INTEGER,
        note TEXT,
        shelved_until_us INTEGER
    );
    CREATE INDEX alarm_twin ON alarm (twin, stop_us, start_us);
    CREATE TABLE watched (
        twin INTEGER PRIMARY KEY REFERENCES twin(id) ON DELETE CASCADE,
        seq INTEGER NOT NULL,
        state TEXT NOT NULL
    );
"""
"""Add alarms of limits, and how far the archive was watched."""

YEARS = """
    ALTER TABLE residual ADD COLUMN n_rows INTEGER;
    ALTER TABLE twin ADD COLUMN gone_us INTEGER;
    ALTER TABLE twin ADD COLUMN revision INTEGER NOT NULL DEFAULT 1;
    ALTER TABLE twin ADD COLUMN retention TEXT NOT NULL DEFAULT '{}';
    CREATE TABLE revision (
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        number INTEGER NOT NULL,
        at_us INTEGER NOT NULL,
        specification TEXT NOT NULL,
        PRIMARY KEY (twin, number)
    ) WITHOUT ROWID;
    CREATE TABLE floor (
        twin INTEGER NOT NULL REFERENCES twin(id) ON DELETE CASCADE,
        version INTEGER NOT NULL,
        at_us INTEGER NOT NULL,
        PRIMARY KEY (twin, version)
    ) WITHOUT ROWID;
    CREATE TABLE audit (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        at_us INTEGER NOT NULL,
        who TEXT NOT NULL,
        method TEXT NOT NULL,
        path TEXT NOT NULL,
        status INTEGER NOT NULL,
        client TEXT NOT NULL,
        detail TEXT NOT NULL
    );
    CREATE TABLE webhook (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        url TEXT NOT NULL,
        secret TEXT NOT NULL,
        twins TEXT,
        types TEXT,
        created_us INTEGER NOT NULL
    );
    CREATE TABLE delivery (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        webhook INTEGER NOT NULL REFERENCES webhook(id) ON DELETE CASCADE,
        created_us INTEGER NOT NULL,
        type TEXT NOT NULL,
        body TEXT NOT NULL,
        attempts INTEGER NOT NULL DEFAULT 0,
        next_us INTEGER,
        state TEXT NOT NULL DEFAULT 'waiting',
        reason TEXT NOT NULL DEFAULT ''
    );
    CREATE INDEX delivery_due ON delivery (state, next_us);
"""
"""Add what a twin needs that is kept for years: revisions, retention, an audit log, webhooks, and bounds on what is read.

``residual.n_rows`` tells residuals in single precision; those of earlier releases have none.
``twin.gone_us`` marks a deleted twin whose rows are removed bit by bit.
"""

WORKERS = """
    ALTER TABLE job ADD COLUMN attempt INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE job ADD COLUMN worker TEXT;
    ALTER TABLE job ADD COLUMN beat_us INTEGER;
    ALTER TABLE job ADD COLUMN cancel INTEGER NOT NULL DEFAULT 0;
"""
"""Add who does a job, the number of the attempt, and when it was last heard of."""

VITALS = """
    CREATE TABLE vital (
        twin INTEGER PRIMARY KEY REFERENCES twin(id) ON DELETE CASCADE,
        version INTEGER NOT NULL,
        time_us INTEGER NOT NULL,
        sensor TEXT NOT NULL,
        residual_K REAL NOT NULL,
        deviations REAL NOT NULL
    );
"""
"""Add the worst of the newest residuals of each twin."""

RETURNED = """
    ALTER TABLE job ADD COLUMN returned INTEGER NOT NULL DEFAULT 0;
"""
"""Add how often a job was given back untried: numbers of attempts only grow, since they fence."""

QUARTERS = """
    ALTER TABLE head ADD COLUMN reach_us INTEGER NOT NULL DEFAULT 0;
    UPDATE head SET reach_us = (SELECT coalesce(max(last_us - first_us), 0) FROM chunk WHERE chunk.twin = head.twin);
"""
"""Add how long any segment of earlier releases is: since then none holds samples of two quarters."""

STEPS: tuple[tuple[str, str], ...] = (
    ("twins and samples", TWINS_AND_SAMPLES),
    ("models and jobs", MODELS_AND_JOBS),
    ("residuals and anomalies", RESIDUALS_AND_ANOMALIES),
    ("outlines", OUTLINES),
    ("clocks", CLOCKS),
    ("alarms", ALARMS),
    ("years", YEARS),
    ("workers", WORKERS),
    ("vitals", VITALS),
    ("returned jobs", RETURNED),
    ("quarters", QUARTERS),
)


def statements(script: str) -> list[str]:
    """Return the statements of a script one by one, as both drivers take them within a transaction."""
    return [statement for statement in script.split(";") if statement.strip()]
