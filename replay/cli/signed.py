"""Who stands behind a report: the day, the author, and the files that it was made of."""

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any


def document(author: str, files: Sequence[Path]) -> dict[str, Any]:
    """Return what the report page prints beside its figures: ``date`` (UTC), ``author`` and ``files`` with their SHA-256."""
    hashed = []
    for path in files:
        with path.open("rb") as stream:
            hashed.append({"name": path.name, "sha256": hashlib.file_digest(stream, "sha256").hexdigest()})
    return {"date": datetime.now(UTC).date().isoformat(), "author": author, "files": hashed}
