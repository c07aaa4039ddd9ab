"""Files that operators have -> recordings: Yamcs' CSV exports, Parquet, CCSDS packets through XTCE, frames as JSON."""

import csv
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from replay.bridges.errors import BadTimeError, BridgeError
from replay.bridges.time_scales import Instants, Stated, from_numbers, from_texts
from replay.recording import Recording, align
from replay.wording import counted

FloatArray = NDArray[np.float64]
FORMATS = {
    "csv": (".csv", ".tsv", ".txt"),
    "parquet": (".parquet", ".pq"),
    "ccsds": (".bin", ".ccsds", ".pkts", ".pkt", ".raw", ".dat"),
    "frames": (".json", ".ndjson", ".jsonl"),
}
"""Formats, and the ends of names by which they are told."""
TIME_NAMES = ("time", "timestamp", "generation time", "gentime")
"""Columns that are taken for the time where the user names none, in any case of letters."""
XTCE_EPOCHS = {"TAI": "tai", "J2000": "j2000", "UNIX": "unix", "POSIX": "unix", "GPS": "gps"}
MOST_TOLD = 8


@dataclass(frozen=True)
class Wish:
    """What the user says of a file: its format, its time, and for packets the XTCE with the container to begin at."""

    format: str | None = None
    time: str | None = None
    stated: Stated = field(default_factory=Stated)
    xtce: Path | None = None
    container: str | None = None


def read(path: Path, wish: Wish) -> Recording:
    """Read a file of any of the formats.

    Raises
    ------
    BridgeError
        With one line that names file, row or column.
    """
    kind = wish.format or next((k for k, ends in FORMATS.items() if path.suffix.lower() in ends), None)
    if kind is None:
        raise BridgeError(f"{path}: its name does not tell its format; say it with --format ({', '.join(FORMATS)})")
    try:
        return {"csv": _read_csv, "parquet": _read_parquet, "ccsds": _read_ccsds, "frames": _read_frames}[kind](
            path, wish
        )
    except OSError as error:
        raise BridgeError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise BridgeError(f"{path}: is no UTF-8 text") from error


# Tables


def _read_csv(path: Path, wish: Wish) -> Recording:
    """Read a table of text, comma, semicolon or tab between the cells, such as Yamcs exports."""
    with path.open(newline="", encoding="utf-8-sig") as stream:
        head = stream.readline()
        stream.seek(0)
        delimiter = max("\t;,", key=head.count)
        reader = csv.reader(stream, delimiter=delimiter)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    if len(rows) < 2:
        raise BridgeError(f"{path}: holds no rows")
    lines, (header, *body) = [line for line, _ in rows[1:]], [row for _, row in rows]
    for line, row in zip(lines, body, strict=True):
        if len(row) != len(header):
            raise BridgeError(f"{path}: row {line} has {len(row)} cells, the header {len(header)}")
    columns = {name.strip(): [row[k].strip() for row in body] for k, name in enumerate(header)}
    if len(columns) != len(header):
        raise BridgeError(f"{path}: two columns have the same name")
    times = columns.pop(_time_name(path, list(columns), wish))
    try:
        instants = _instants(path, times, wish.stated)
    except BadTimeError as error:
        raise error.on_line(lines[error.row]) from error
    numbers, notices = {}, []
    for name, texts in columns.items():
        column, said = _numbers(name, texts)
        notices += said
        if column is not None:
            numbers[name] = column
    return _assemble(path, instants, numbers, {}, notices)


def _numbers(name: str, texts: Sequence[str]) -> tuple[FloatArray | None, list[str]]:
    """Return a column of text as numbers, NaN where a cell is empty; None where it holds none."""
    column = np.full(len(texts), np.nan)
    words: Counter[str] = Counter()
    for row, text in enumerate(texts):
        try:
            column[row] = float(text) if text else np.nan
        except ValueError:
            words[text] += 1
    infinite = np.isinf(column)
    if infinite.any():
        column[infinite] = np.nan
        words["inf"] += int(infinite.sum())
    if not words:
        return column, []
    shown = ", ".join(f"'{word[:20]}'" for word, _ in words.most_common(3))
    if np.isnan(column).all():
        return None, [f"column '{name}' holds no numbers ({shown}); left out"]
    cells = counted(words.total(), "cell is not a number", "cells are not numbers")
    return column, [f"column '{name}': {cells} ({shown}); left out"]


def _read_parquet(path: Path, wish: Wish) -> Recording:
    """Read a Parquet file: a column of timestamps or numbers, and columns of numbers; units from the fields' metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except pa.ArrowInvalid as error:
        raise BridgeError(f"{path}: is no Parquet file ({' '.join(str(error).split())[:100]})") from error
    time_name = _time_name(path, table.column_names, wish)
    times, kind = table.column(time_name), table.schema.field(time_name).type
    if times.null_count:
        raise BridgeError(f"{path}: the time is missing in {counted(times.null_count, 'row')}")
    if pa.types.is_timestamp(kind):
        readings = times.cast(pa.timestamp("ns", kind.tz)).cast(pa.int64()).to_numpy()
        instants = _of_timestamps(path, readings, kind.tz, wish.stated)
    elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
        instants = from_texts(times.to_pylist(), wish.stated, str(path))
    else:
        instants = from_numbers(times.to_numpy(), wish.stated, str(path))
    columns, units, notices = {}, {}, []
    for field_ in table.schema:
        if field_.name == time_name:
            continue
        if not (
            pa.types.is_floating(field_.type) or pa.types.is_integer(field_.type) or pa.types.is_boolean(field_.type)
        ):
            notices.append(f"column '{field_.name}' is of type {field_.type}, no number; left out")
            continue
        values = table.column(field_.name).cast(pa.float64())
        columns[field_.name] = np.asarray(values.to_numpy(zero_copy_only=False), dtype=np.float64)
        if field_.metadata and b"unit" in field_.metadata:
            units[field_.name] = field_.metadata[b"unit"].decode()
    return _assemble(path, instants, columns, units, notices)


def _of_timestamps(path: Path, readings: NDArray[np.int64], zone: str | None, stated: Stated) -> Instants:
    """Return instants of timestamps: with a zone they are UTC inside, without one the user says what they are."""
    if zone is None and stated.scale is None:
        raise BridgeError(f"{path}: its timestamps have no zone; say with --time-scale which scale they are in")
    if zone is not None and stated.scale not in (None, "utc"):
        raise BridgeError(f"{path}: its timestamps are UTC by their zone, --time-scale says {stated.scale}")
    return from_numbers(readings, Stated(stated.scale or "utc", "1970-01-01", "ns"), str(path))


# Packets


def _read_ccsds(path: Path, wish: Wish) -> Recording:
    """Read CCSDS packets, one behind the other, through an XTCE definition."""
    from space_packet_parser import ccsds_generator

    if wish.time is None:
        raise BridgeError(f"{path}: which parameter is the time of a packet? say it with --time")
    data = path.read_bytes()
    with warnings.catch_warnings(record=True):  # of bytes left over, which the length tells as well
        warnings.simplefilter("always")
        packets = list(ccsds_generator(data))
    left = len(data) - sum(map(len, packets))
    if not packets:
        raise BridgeError(f"{path}: is no sequence of whole CCSDS packets")
    found = _from_packets(path, packets, wish, None)
    said = (f"{path}: {counted(left, 'byte')} at the end: not a whole packet; left out",) if left else ()
    return Recording(found.time_ns, found.columns, found.units, {}, (*found.notices, *said))


def _from_packets(path: Path, packets: Sequence[bytes], wish: Wish, received: Sequence[str] | None) -> Recording:
    """Decode packets; their time is a parameter of theirs, or else when they were received."""
    from space_packet_parser.exceptions import UnrecognizedPacketTypeError

    definition = _definition(path, wish)
    times: list[Any] = []
    series: dict[str, list[tuple[int, float]]] = {}
    unknown, broken = 0, 0
    for k, packet in enumerate(packets):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # a packet longer than its definition is no packet of that kind
                found = definition.parse_bytes(packet, root_container_name=wish.container)
        except UnrecognizedPacketTypeError:
            unknown += 1
            continue
        except (UserWarning, ValueError, IndexError, KeyError) as error:
            if isinstance(error, KeyError) and wish.container and wish.container not in definition.containers:
                raise BridgeError(f"{wish.xtce}: has no container '{wish.container}'") from error
            broken += 1
            continue
        if received is None and wish.time not in found:
            unknown += 1
            continue
        times.append(found[wish.time] if received is None else received[k])
        for name, value in found.items():
            number = getattr(value, "raw_value", value) if isinstance(value, str) else value
            if isinstance(number, int | float) and name != wish.time and name not in _HEADER:
                series.setdefault(name, []).append((len(times) - 1, float(number)))
    if not times:
        what = "" if received is not None else f" with the parameter '{wish.time}'"
        raise BridgeError(f"{path}: {counted(len(packets), 'packet')}, none of which the XTCE describes{what}")
    notices = [f"{counted(unknown, 'packet')} that the XTCE does not describe; left out"] if unknown else []
    misfits = counted(broken, "packet that does", "packets that do")
    notices += [f"{misfits} not fit the definition; left out"] if broken else []
    if received is None:
        instants = _packet_times(path, times, definition, wish)
    else:
        instants = from_texts(times, wish.stated, str(path))
    types = {name: parameter.parameter_type for name, parameter in definition.parameters.items()}
    units = {name: str(types[name].unit) for name in series if name in types and types[name].unit}
    at = instants.unix_ns
    filled = {
        name: (at[np.array([k for k, _ in found])], np.array([value for _, value in found]))
        for name, found in series.items()
    }
    return _told(path, align(filled), units, [*instants.notices, *notices])


_HEADER = frozenset(
    {"VERSION", "TYPE", "SEC_HDR_FLG", "SEQ_FLGS", "SRC_SEQ_CTR", "PKT_LEN", "PKT_APID"}
    | {
        "ccsds_version",
        "ccsds_type",
        "ccsds_sec_hdr_flag",
        "ccsds_apid",
        "ccsds_group_flags",
        "ccsds_seqcount",
        "ccsds_length",
    }
)
"""Fields of the primary header under their usual names: no telemetry."""


def _definition(path: Path, wish: Wish) -> Any:
    from space_packet_parser import load_xtce

    if wish.xtce is None:
        raise BridgeError(f"{path}: packets need the XTCE that describes them; name it with --xtce")
    try:
        return load_xtce(wish.xtce)
    except FileNotFoundError as error:
        raise BridgeError(f"{wish.xtce}: cannot be read (no such file)") from error
    except Exception as error:  # the parser raises whatever its XML library and its own checks come up with
        raise BridgeError(f"{wish.xtce}: is no XTCE that can be read ({' '.join(str(error).split())[:120]})") from error


def _packet_times(path: Path, times: list[Any], definition: Any, wish: Wish) -> Instants:
    """Return the instants that packets state, counted from the user's epoch or else from that of the XTCE."""
    stated = wish.stated
    kind = definition.parameters[wish.time].parameter_type
    declared = getattr(kind, "epoch", None)
    notices: tuple[str, ...] = ()
    if stated.epoch is None and declared is not None:
        epoch = XTCE_EPOCHS.get(declared.upper(), declared)
        stated = Stated(stated.scale, epoch, stated.unit)
        notices = (f"{path}: times count from {declared}, as the XTCE says",)
    if all(isinstance(value, str) for value in times):
        return from_texts(times, stated, str(path))
    found = from_numbers(np.array(times, dtype=np.float64), stated, str(path))
    return Instants(found.unix_ns, (*notices, *found.notices))


def _read_frames(path: Path, wish: Wish) -> Recording:
    """Read frames as SatNOGS gives them out: a time each, and either a frame as hex or decoded numbers."""
    frames = _json_objects(path)
    for number, frame in enumerate(frames, start=1):
        if not isinstance(frame, dict) or not isinstance(frame.get(wish.time or "timestamp"), str):
            raise BridgeError(f"{path}: frame {number} has no '{wish.time or 'timestamp'}'")
    times = [frame[wish.time or "timestamp"] for frame in frames]
    if all(isinstance(frame.get("frame"), str) for frame in frames) and wish.xtce is not None:
        packets = [_bytes(path, number, frame["frame"]) for number, frame in enumerate(frames, start=1)]
        return _from_packets(path, packets, wish, times)
    instants = from_texts(times, wish.stated, str(path))
    series: dict[str, tuple[list[int], list[float]]] = {}
    units: dict[str, str] = {}
    without = 0
    for k, frame in enumerate(frames):
        fields = next((frame[n] for n in ("decoded", "fields", "values") if isinstance(frame.get(n), dict)), None)
        if fields is None:
            without += 1
            continue
        for name, value in _flat(fields, units):
            series.setdefault(name, ([], []))[0].append(int(instants.unix_ns[k]))
            series[name][1].append(value)
    if not series:
        raise BridgeError(f"{path}: no frame is decoded; frames as hex need the XTCE that describes them (--xtce)")
    notices = [f"{counted(without, 'frame is', 'frames are')} not decoded; left out"] if without else []
    columns = {name: (np.array(at, dtype=np.int64), np.array(values)) for name, (at, values) in series.items()}
    return _told(path, align(columns), units, [*instants.notices, *notices])


def _json_objects(path: Path) -> list[Any]:
    data = path.read_bytes()
    try:
        if data.lstrip()[:1] == b"[":
            found = orjson.loads(data)
        else:
            found = [orjson.loads(line) for line in data.splitlines() if line.strip()]
    except orjson.JSONDecodeError as error:
        raise BridgeError(f"{path}: is no JSON ({error.msg}, line {error.lineno})") from error
    if len(found) == 1 and isinstance(found[0], dict) and isinstance(found[0].get("results"), list):
        found = found[0]["results"]  # one page of the SatNOGS interface
    if not found:
        raise BridgeError(f"{path}: holds no frames")
    return list(found)


def _bytes(path: Path, number: int, text: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError as error:
        raise BridgeError(f"{path}: frame {number}: '{text[:20]}' is not hexadecimal") from error


def _flat(fields: Mapping[str, Any], units: dict[str, str], prefix: str = "") -> Iterable[tuple[str, float]]:
    """Yield the numbers of nested fields; ``{"value": 3.1, "unit": "K"}`` is one number with its unit."""
    for name, value in fields.items():
        if isinstance(value, dict) and "value" in value:
            if isinstance(value.get("unit"), str):
                units[f"{prefix}{name}"] = value["unit"]
            value = value["value"]
        if isinstance(value, dict):
            yield from _flat(value, units, f"{prefix}{name}.")
        elif isinstance(value, int | float) and abs(value) < float("inf"):
            yield f"{prefix}{name}", float(value)


# What all have in common


def _time_name(path: Path, names: Sequence[str], wish: Wish) -> str:
    if wish.time is not None:
        if wish.time not in names:
            raise BridgeError(f"{path}: has no column '{wish.time}' ({', '.join(names[:MOST_TOLD])})")
        return wish.time
    found = [name for name in names if name.lower() in TIME_NAMES]
    if len(found) != 1:
        raise BridgeError(f"{path}: which column is the time? say it with --time ({', '.join(names[:MOST_TOLD])})")
    return found[0]


def _instants(path: Path, texts: Sequence[str], stated: Stated) -> Instants:
    try:
        numbers = np.array(texts, dtype=np.float64)
    except ValueError:
        return from_texts(texts, stated, str(path))
    return from_numbers(numbers, stated, str(path))


def _assemble(
    path: Path, instants: Instants, columns: Mapping[str, FloatArray], units: Mapping[str, str], notices: Sequence[str]
) -> Recording:
    if not columns:
        raise BridgeError(f"{path}: holds no column of numbers beside the time")
    kept = {name: ~np.isnan(column) for name, column in columns.items()}
    series = {name: (instants.unix_ns[kept[name]], column[kept[name]]) for name, column in columns.items()}
    return _told(path, align(series), units, [*instants.notices, *notices])


def _told(path: Path, found: Recording, units: Mapping[str, str], notices: Sequence[str]) -> Recording:
    told = (*notices, *found.notices)
    named = tuple(notice if notice.startswith(str(path)) else f"{path}: {notice}" for notice in told)
    return Recording(found.time_ns, found.columns, dict(units), {}, named)
