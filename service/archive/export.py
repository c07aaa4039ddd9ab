"""A part of the archive as a file, made piece by piece: its length is no matter of memory."""

import asyncio
import io
from collections.abc import AsyncIterator, Sequence
from typing import Any, Literal, Protocol

import numpy as np

from service.instants import format_instants
from service.store import samples
from service.store.connection import Connection
from service.store.database import Database
from service.store.samples import Samples
from service.twins.registry import Entry

Format = Literal["csv", "parquet"]
MEDIA: dict[Format, str] = {"csv": "text/csv; charset=utf-8", "parquet": "application/vnd.apache.parquet"}
PIECE = 20_000
"""So many samples are read at once."""


class _Writer(Protocol):
    def write(self, found: Samples) -> bytes:
        """Return the next samples as bytes of the file."""

    def end(self) -> bytes:
        """Return what stands at its end."""


class _Csv:
    """A file as docs/telemetry.md has it: a column ``time``, one per channel, an empty cell where nothing was read."""

    def __init__(self, names: Sequence[str]) -> None:
        self._head = ",".join(["time", *(f'"{n}"' if "," in n else n for n in names)]) + "\r\n"

    def write(self, found: Samples) -> bytes:
        columns = [["" if v != v else repr(v) for v in row.tolist()] for row in found.values]
        lines = [",".join(cells) for cells in zip(format_instants(found.time_us), *columns, strict=True)]
        head, self._head = self._head, ""
        return (head + "".join(f"{line}\r\n" for line in lines)).encode()

    def end(self) -> bytes:
        head, self._head = self._head, ""
        return head.encode()


class _Sink(io.RawIOBase):
    """A file that keeps nothing: what was written is taken away again and again, while positions go on growing."""

    def __init__(self) -> None:
        super().__init__()
        self._parts: list[bytes] = []
        self._position = 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._parts.append(bytes(data))
        self._position += len(self._parts[-1])
        return len(self._parts[-1])

    def tell(self) -> int:
        return self._position

    def take(self) -> bytes:
        """Return what was written since the last time."""
        made, self._parts = b"".join(self._parts), []
        return made


class _Parquet:
    """A table with a row group per piece: ``time`` in UTC microseconds, one column of doubles per channel."""

    def __init__(self, names: Sequence[str], units: dict[str, str | None]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        fields = [pa.field("time", pa.timestamp("us", tz="UTC"), nullable=False)]
        fields += [pa.field(name, pa.float64(), metadata={"unit": units[name] or ""}) for name in names]
        self._pa, self._schema = pa, pa.schema(fields)
        self._sink = _Sink()
        self._writer: Any = pq.ParquetWriter(self._sink, self._schema, compression="zstd")

    def write(self, found: Samples) -> bytes:
        columns = [self._pa.array(found.time_us, type=self._schema.field(0).type)]
        columns += [self._pa.array(row, mask=np.isnan(row)) for row in found.values]
        self._writer.write_table(self._pa.Table.from_arrays(columns, schema=self._schema))
        return self._sink.take()

    def end(self) -> bytes:
        self._writer.close()
        return self._sink.take()


async def stream(
    database: Database, twin: Entry, names: Sequence[str], start_us: int | None, stop_us: int | None, form: Format
) -> AsyncIterator[bytes]:
    """Yield a file with the samples of start <= time < stop; what comes meanwhile may or may not be part of it."""
    rows = [twin.channels.index(name) for name in names]
    units = {name: twin.units[name] for name in names}
    writer: _Writer = (
        await asyncio.to_thread(_Csv, names) if form == "csv" else await asyncio.to_thread(_Parquet, names, units)
    )
    after = start_us
    while True:
        found, after = await database.read(_piece, twin.key, len(twin.channels), rows, after, stop_us)
        if found.time_us.size:
            yield await asyncio.to_thread(writer.write, found)
        if after is None:
            break
    yield await asyncio.to_thread(writer.end)


def _piece(
    connection: Connection, twin: int, n_channels: int, rows: Sequence[int], start_us: int | None, stop_us: int | None
) -> tuple[Samples, int | None]:
    """Return the next samples, and where the piece after them begins; None: nowhere."""
    before = None if start_us is None else start_us - 1
    cut_us = samples.block_stop(connection, twin, before, PIECE)
    last = cut_us is None or (stop_us is not None and cut_us >= stop_us)
    until_us = stop_us if last else cut_us
    return samples.select(connection, twin, n_channels, rows, start_us, until_us), None if last else until_us
