"""``twin convert``: packets, exports and frames; times against the ERFA library, packets against bytes packed by hand."""

import csv
import json
import struct
from pathlib import Path
from typing import Any

import erfa
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from replay.bridges.convert import Wish, read
from replay.bridges.errors import BridgeError
from replay.bridges.time_scales import STEPS_NS, TAI_LESS_UTC_NS, Stated, from_numbers, from_texts
from replay.cli.main import main
from replay.mcap_io import read_mcap

DAY_S = 86_400


def unix_ns(text: str) -> int:
    return int(np.datetime64(text.removesuffix("Z"), "ns").astype(np.int64))


def test_leap_seconds_are_those_of_erfa() -> None:
    table = erfa.leap_seconds.get()
    known = table[table["year"] >= 1972]
    dates = np.array([f"{row['year']:04d}-{row['month']:02d}-01" for row in known], dtype="datetime64[ns]").astype(
        np.int64
    )
    assert dates.tolist() == STEPS_NS.tolist()
    assert (known["tai_utc"] * 1e9).tolist() == TAI_LESS_UTC_NS.tolist()


@pytest.mark.parametrize("scale", ["tai", "gps", "tt"])
@pytest.mark.parametrize(
    "when",
    ["1980-01-06T00:00:00", "1999-01-01T00:00:00", "2012-07-01T00:00:05", "2016-12-31T23:59:59", "2026-03-01T12:34:56"],
)
def test_scales_are_those_of_erfa(scale: str, when: str) -> None:
    """ERFA takes the UTC instant to TAI and TT; what it reads there must lead back."""
    year, month, day = (int(part) for part in when[:10].split("-"))
    hour, minute, second = (int(part) for part in when[11:].split(":"))
    tai = erfa.utctai(*erfa.dtf2d("UTC", year, month, day, hour, minute, second))
    read = {"tai": tai, "gps": (tai[0], tai[1] - 19.0 / DAY_S), "tt": erfa.taitt(*tai)}[scale]
    y, m, d, hmsf = erfa.d2dtf("TAI", 6, *read)
    text = f"{y:04d}-{m:02d}-{d:02d}T{hmsf['h']:02d}:{hmsf['m']:02d}:{hmsf['s']:02d}.{hmsf['f']:06d}"
    found = from_texts([text], Stated(scale), "x").unix_ns[0]
    assert abs(int(found) - unix_ns(when)) <= 2000  # microseconds of ERFA's rounding


def test_numbers_count_from_their_epoch() -> None:
    def at(value: float, **stated: Any) -> int:
        return int(from_numbers(np.array([value]), Stated(**stated), "x").unix_ns[0])

    assert at(1_772_323_200.25, epoch="unix") == unix_ns("2026-03-01T00:00:00.250")
    assert at(1_772_323_200_250, epoch="unix", unit="ms") == unix_ns("2026-03-01T00:00:00.250")
    # GPS week 2408 began on Sunday 2026-03-01 00:00:00 GPS, 18 s before that UTC second.
    assert at(2408 * 7 * DAY_S, epoch="gps") == unix_ns("2026-02-28T23:59:42")
    assert at(0.0, epoch="j2000") == unix_ns("2000-01-01T11:58:55.816")
    assert at(0.0, epoch="2020-01-01T00:00:00", scale="tai") == unix_ns("2019-12-31T23:59:23")


def test_a_leap_second_counts_as_the_second_after_it() -> None:
    texts = ["2016-12-31T23:59:59.5Z", "2016-12-31T23:59:60.5Z", "2017-01-01T00:00:00.5Z"]
    found = from_texts(texts, Stated(), "x")
    assert np.diff(found.unix_ns).tolist() == [1_000_000_000, 0]
    assert found.notices == ("x: 1 time within a leap second counts as the second after it",)
    tai = ["2017-01-01T00:00:35.5", "2017-01-01T00:00:36.5", "2017-01-01T00:00:37.5"]
    assert from_texts(tai, Stated("tai"), "x").unix_ns.tolist() == found.unix_ns.tolist()
    with pytest.raises(BridgeError, match="there was no leap second"):
        from_texts(["2020-06-30T23:59:60Z"], Stated(), "x")


@pytest.mark.parametrize(
    ("texts", "stated", "told"),
    [
        (["2026-03-01T00:00:00"], Stated(), "states no zone; say with --time-scale"),
        (["2026-03-01T00:00:00Z"], Stated("tai"), "is UTC by its zone, --time-scale says tai"),
        (["yesterday"], Stated(), "row 1: 'yesterday' is no time"),
        (["2026-02-30T00:00:00Z"], Stated(), "on no calendar"),
        (["1969-01-01T00:00:00Z"], Stated(), "beyond 1972"),
        (["2017-01-01T00:00:60"], Stated("gps"), "no leap second|second 60"),
    ],
)
def test_times_are_never_guessed(texts: list[str], stated: Stated, told: str) -> None:
    with pytest.raises(BridgeError, match=told):
        from_texts(texts, stated, "x")


@pytest.mark.parametrize(
    ("value", "stated", "told"),
    [
        (1.7e9, Stated(), "what they count from"),
        (1.7e9, Stated(epoch="2000-01-01"), "does not say in which scale"),
        (1.7e9, Stated("tai", "unix"), "is of the scale utc, --time-scale says tai"),
        (1.7e12, Stated(epoch="unix"), "beyond 1972 to 2199|no usable"),
        (float("nan"), Stated(epoch="unix"), "no usable number"),
        (1.0, Stated(epoch="1958"), "none of"),
    ],
)
def test_epochs_are_never_guessed(value: float, stated: Stated, told: str) -> None:
    with pytest.raises(BridgeError, match=told):
        from_numbers(np.array([value]), stated, "x")


def test_day_of_year_and_offsets_are_times() -> None:
    texts = ["2026-060T00:00:00Z", "2026:060:01:00:00Z", "2026-03-01T03:00:00+02:00"]
    hour = 3_600 * 10**9
    assert np.diff(from_texts(texts, Stated(), "x").unix_ns).tolist() == [hour, 0]
    assert from_texts(texts[:1], Stated(), "x").unix_ns[0] == unix_ns("2026-03-01T00:00:00")


# The command

SPEC = {
    "twin": "sat",
    "boundaries": {"space": {"value_K": 2.7}},
    "channels": {"T_a": {"kind": "temperature", "unit": "K"}, "Q_a": {"kind": "power", "unit": "W"}},
    "nodes": [{"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 100.0}}],
    "radiators": [{"node": "a", "emissivity": 0.8, "area_m2": 0.1, "sink": "space"}],
    "loads": [{"channel": "Q_a", "node": "a"}],
}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as stream:
        return list(csv.DictReader(stream))


@pytest.fixture
def spec(tmp_path: Path) -> str:
    (tmp_path / "sat.yaml").write_text(yaml.safe_dump(SPEC))
    return str(tmp_path / "sat.yaml")


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        (["20", "inf"], "1 cell is not a number ('inf')"),
        (["20", "inf", "-inf", "n/a"], "3 cells are not numbers ('inf', 'n/a')"),
    ],
)
def test_cells_without_a_number_are_counted(tmp_path: Path, cells: list[str], said: str) -> None:
    source = tmp_path / "export.csv"
    times = (f"2026-03-01T00:00:0{k}.000Z" for k in range(len(cells)))
    source.write_text("Time\tT_a\n" + "".join(f"{t}\t{cell}\n" for t, cell in zip(times, cells, strict=True)))
    assert f"column 'T_a': {said}; left out" in " ".join(read(source, Wish()).notices)


def test_an_export_of_yamcs_becomes_telemetry(tmp_path: Path, spec: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The form that Yamcs' ``exportParameterValues`` writes: tabs, times in UTC, empty cells where there is no value."""
    source, out = tmp_path / "export.csv", tmp_path / "t.csv"
    source.write_text(
        "Time\t/SAT/T_a\t/SAT/Q_a\t/SAT/mode\n"
        "2026-03-01T00:00:00.000Z\t20.5\t1500\tSAFE\n"
        "2026-03-01T00:00:10.000Z\t21.5\t\tSAFE\n"
    )
    command = ["convert", str(source), "--spec", spec, "--out", str(out), "--unit", "/SAT/T_a=degC"]
    assert main(command) == 2  # the power's unit is not stated either
    assert "'/SAT/Q_a' states no unit" in capsys.readouterr().err
    assert not out.exists()
    assert main([*command, "/SAT/Q_a=mW"]) == 0
    told = capsys.readouterr().err
    assert "column '/SAT/mode' holds no numbers ('SAFE'); left out" in told
    first, second = rows(out)
    assert first["time"] == "2026-03-01T00:00:00.000000Z"
    assert float(first["T_a"]) == pytest.approx(293.65) and float(first["Q_a"]) == pytest.approx(1.5)
    assert float(second["T_a"]) == pytest.approx(294.65) and second["Q_a"] == ""
    assert main(["check", spec, "--telemetry", str(out)]) in (0, 1)  # the command line reads what it wrote


def test_units_that_contradict_are_told_by_name(tmp_path: Path, spec: str, capsys: pytest.CaptureFixture[str]) -> None:
    schema = pa.schema(
        [
            ("time", pa.timestamp("ms", tz="UTC")),
            pa.field("T_a", pa.float64(), metadata={"unit": "V"}),
            ("Q_a", pa.int32()),
        ]
    )
    table = pa.table({"time": [0, 1000], "T_a": [1.0, 2.0], "Q_a": [3, 4]}, schema=schema)
    pq.write_table(table, tmp_path / "t.parquet")
    command = ["convert", str(tmp_path / "t.parquet"), "--spec", spec, "--out", str(tmp_path / "t.csv")]
    assert main(command) == 2
    assert "1970" in capsys.readouterr().err  # before leap seconds were whole ones
    table = table.set_column(
        0, schema.field(0), pa.array([1_772_323_200_000, 1_772_323_201_000], pa.timestamp("ms", tz="UTC"))
    )
    pq.write_table(table, tmp_path / "t.parquet")
    assert main(command) == 2
    told = capsys.readouterr().err
    assert "'T_a' is in V, channel 'T_a' is in K" in told and "'Q_a' states no unit" in told
    assert main([*command, "--unit", "T_a=K"]) == 2
    assert "--unit says K of 'T_a', the file V" in capsys.readouterr().err


def test_parquet_without_a_zone_asks_for_the_scale(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = pa.array([1_772_323_237_000_000, 1_772_323_238_000_000], pa.timestamp("us"))
    pq.write_table(pa.table({"time": times, "T_a": [290.0, None]}), tmp_path / "t.parquet")
    command = ["convert", str(tmp_path / "t.parquet"), "--out", str(tmp_path / "t.mcap")]
    assert main(command) == 2
    assert "have no zone; say with --time-scale" in capsys.readouterr().err
    assert main([*command, "--time-scale", "tai", "--unit", "T_a=K"]) == 0
    made = read_mcap(tmp_path / "t.mcap")
    assert made.time_ns.tolist() == [unix_ns("2026-03-01T00:00:00")]  # 37 s later in TAI; the other has no value
    assert dict(made.units) == {"T_a": "K"}


XTCE = """<?xml version="1.0" encoding="UTF-8"?>
<xtce:SpaceSystem name="SAT" xmlns:xtce="http://www.omg.org/spec/XTCE/20180204">
 <xtce:TelemetryMetaData>
  <xtce:ParameterTypeSet>
   {types}
   <xtce:IntegerParameterType name="seconds" signed="false"><xtce:UnitSet><xtce:Unit>s</xtce:Unit></xtce:UnitSet>
    <xtce:IntegerDataEncoding sizeInBits="32" encoding="unsigned"/></xtce:IntegerParameterType>
   <xtce:FloatParameterType name="celsius"><xtce:UnitSet><xtce:Unit>degC</xtce:Unit></xtce:UnitSet>
    <xtce:IntegerDataEncoding sizeInBits="16" encoding="unsigned"><xtce:DefaultCalibrator><xtce:PolynomialCalibrator>
     <xtce:Term exponent="0" coefficient="-100"/><xtce:Term exponent="1" coefficient="0.01"/>
    </xtce:PolynomialCalibrator></xtce:DefaultCalibrator></xtce:IntegerDataEncoding></xtce:FloatParameterType>
   <xtce:FloatParameterType name="watt"><xtce:UnitSet><xtce:Unit>W</xtce:Unit></xtce:UnitSet>
    <xtce:FloatDataEncoding sizeInBits="32"/></xtce:FloatParameterType>
  </xtce:ParameterTypeSet>
  <xtce:ParameterSet>
   {header}
   <xtce:Parameter name="GPS_S" parameterTypeRef="seconds"/>
   <xtce:Parameter name="T_a" parameterTypeRef="celsius"/>
   <xtce:Parameter name="Q_a" parameterTypeRef="watt"/>
  </xtce:ParameterSet>
  <xtce:ContainerSet>
   <xtce:SequenceContainer name="CCSDSPacket" abstract="true"><xtce:EntryList>{entries}</xtce:EntryList></xtce:SequenceContainer>
   <xtce:SequenceContainer name="Thermal"><xtce:EntryList>
     <xtce:ParameterRefEntry parameterRef="GPS_S"/><xtce:ParameterRefEntry parameterRef="T_a"/>
     <xtce:ParameterRefEntry parameterRef="Q_a"/></xtce:EntryList>
    <xtce:BaseContainer containerRef="CCSDSPacket"><xtce:RestrictionCriteria>
     <xtce:Comparison parameterRef="PKT_APID" value="42" useCalibratedValue="false"/></xtce:RestrictionCriteria>
    </xtce:BaseContainer>
   </xtce:SequenceContainer>
  </xtce:ContainerSet>
 </xtce:TelemetryMetaData>
</xtce:SpaceSystem>
"""
HEADER = {"VERSION": 3, "TYPE": 1, "SEC_HDR_FLG": 1, "PKT_APID": 11, "SEQ_FLGS": 2, "SRC_SEQ_CTR": 14, "PKT_LEN": 16}


def xtce(folder: Path) -> Path:
    types = "".join(
        f'<xtce:IntegerParameterType name="U{n}" signed="false"><xtce:IntegerDataEncoding sizeInBits="{n}" encoding="unsigned"/>'
        "</xtce:IntegerParameterType>"
        for n in sorted(set(HEADER.values()))
    )
    header = "".join(f'<xtce:Parameter name="{name}" parameterTypeRef="U{bits}"/>' for name, bits in HEADER.items())
    entries = "".join(f'<xtce:ParameterRefEntry parameterRef="{name}"/>' for name in HEADER)
    (folder / "sat.xml").write_text(XTCE.format(types=types, header=header, entries=entries))
    return folder / "sat.xml"


def packet(count: int, gps_s: int, raw: int, power: float, apid: int = 42) -> bytes:
    """Return a CCSDS space packet (CCSDS 133.0-B-2), packed by hand."""
    data = struct.pack(">IHf", gps_s, raw, power)
    return struct.pack(">HHH", apid, 0xC000 | count, len(data) - 1) + data


GPS_S = 2408 * 7 * DAY_S + 18
"""2026-03-01T00:00:00Z in GPS seconds."""


def test_packets_become_telemetry_through_xtce(tmp_path: Path, spec: str, capsys: pytest.CaptureFixture[str]) -> None:
    frames = [packet(k, GPS_S + 10 * k, 12_000 + k, 1.5) for k in range(3)]
    (tmp_path / "tm.bin").write_bytes(b"".join([*frames, packet(3, GPS_S, 0, 0.0, apid=7)]))
    out = tmp_path / "t.csv"
    command = ["convert", str(tmp_path / "tm.bin"), "--xtce", str(xtce(tmp_path)), "--spec", spec, "--out", str(out)]
    assert main(command) == 2 and "say it with --time" in capsys.readouterr().err
    command += ["--time", "GPS_S"]
    assert main(command) == 2 and "what they count from" in capsys.readouterr().err
    assert main([*command, "--epoch", "gps"]) == 0
    assert "1 packet that the XTCE does not describe" in capsys.readouterr().err
    found = rows(out)
    assert [row["time"] for row in found] == [f"2026-03-01T00:00:{10 * k:02d}.000000Z" for k in range(3)]
    assert [float(row["T_a"]) for row in found] == pytest.approx([293.15 + 0.01 * k for k in range(3)])
    assert [float(row["Q_a"]) for row in found] == [1.5] * 3
    (tmp_path / "cut.bin").write_bytes(b"".join(frames)[:-3])
    assert main(["convert", str(tmp_path / "cut.bin"), *command[2:], "--epoch", "gps"]) == 0
    assert "13 bytes at the end: not a whole packet" in capsys.readouterr().err and len(rows(out)) == 2
    (tmp_path / "text.bin").write_text("hello world, this is text")
    assert main(["convert", str(tmp_path / "text.bin"), *command[2:], "--epoch", "gps"]) == 2
    assert "no sequence of whole CCSDS packets" in capsys.readouterr().err
    assert main([*command, "--epoch", "gps", "--container", "Nobody"]) == 2
    assert "has no container 'Nobody'" in capsys.readouterr().err


def test_frames_of_satnogs_become_telemetry(tmp_path: Path, spec: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Two stations hear the same frame; one frame is of somebody else."""
    heard = [
        ("2026-03-01T00:00:01Z", packet(0, GPS_S, 12_000, 1.0)),
        ("2026-03-01T00:00:02Z", packet(0, GPS_S, 12_000, 1.0)),
    ]
    heard += [("2026-03-01T00:00:11Z", packet(1, GPS_S + 10, 12_100, 2.0)), ("2026-03-01T00:00:12Z", b"\x00" * 4)]
    records = [
        {"norad_cat_id": 1, "observer": "x", "timestamp": t, "decoded": "influxdb", "frame": f.hex()} for t, f in heard
    ]
    (tmp_path / "f.json").write_text(json.dumps({"next": None, "results": records}))
    out = tmp_path / "t.csv"
    command = ["convert", str(tmp_path / "f.json"), "--spec", spec, "--out", str(out)]
    assert main(command) == 2 and "need the XTCE" in capsys.readouterr().err
    assert main([*command, "--xtce", str(xtce(tmp_path))]) == 0
    assert [float(row["T_a"]) for row in rows(out)] == pytest.approx([293.15, 293.15, 294.15])


def test_decoded_frames_become_telemetry(tmp_path: Path, spec: str, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [
        {
            "timestamp": "2026-03-01T00:00:00Z",
            "fields": {"thermal": {"T_a": {"value": 20.0, "unit": "degC"}}, "Q_a": 3},
        },
        {
            "timestamp": "2026-03-01T00:00:10Z",
            "fields": {"thermal": {"T_a": {"value": 21.0, "unit": "degC"}}, "text": "x"},
        },
        {"timestamp": "2026-03-01T00:00:20Z", "frame": "00"},
    ]
    (tmp_path / "f.ndjson").write_text("\n".join(json.dumps(line) for line in lines))
    command = [
        "convert",
        str(tmp_path / "f.ndjson"),
        "--spec",
        spec,
        "--out",
        str(tmp_path / "t.csv"),
        "--unit",
        "Q_a=W",
    ]
    assert main(command) == 0
    assert "1 frame is not decoded" in capsys.readouterr().err
    assert [row["T_a"] for row in rows(tmp_path / "t.csv")] == ["293.15", "294.15"]


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("x.csv", b"", "holds no rows"),
        ("x.csv", b"time,a\n2026-03-01T00:00:00Z\n", "row 2 has 1 cells, the header 2"),
        ("x.csv", b"time,a\n\n2026-03-01T00:00:00Z\n", "row 3 has 1 cells, the header 2"),
        ("x.csv", b"time,a\n2026-03-01T00:00:00Z,1\n\nyesterday,2\n", "x.csv: row 4: 'yesterday' is no time"),
        ("x.csv", b"time,a\n1969-01-01T00:00:00Z,1\n", "x.csv: row 2: the time is 1969-01-01"),
        ("x.csv", b"when,a\n2026-03-01T00:00:00Z,1\n", "which column is the time"),
        ("x.csv", b"time,a\n1772323200,1\n", "what they count from"),
        ("x.csv", b"time,a\n2026-03-01T00:00:00Z,ON\n", "no column of numbers"),
        ("x.csv", b"time,a,a\n2026-03-01T00:00:00Z,1,2\n", "same name"),
        ("x.csv", b"\xff\xfe\x00", "no UTF-8"),
        ("x.parquet", b"PAR1 no", "is no Parquet"),
        ("x.json", b"{", "is no JSON"),
        ("x.json", b"[]", "holds no frames"),
        ("x.json", b'[{"frame": "00"}]', "has no 'timestamp'"),
        ("x.bin", b"\x00" * 3, "--time"),
        ("x.what", b"", "does not tell its format"),
    ],
)
def test_bad_files_are_one_line(
    tmp_path: Path, name: str, content: bytes, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    assert main(["convert", str(tmp_path / name), "--out", str(tmp_path / "o.csv")]) == 2
    heard = capsys.readouterr().err
    assert told in heard and heard.count("\n") == 1 and not (tmp_path / "o.csv").exists()
