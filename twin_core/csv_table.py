"""CSV text as columns: knows rows, columns and numbers, but nothing of temperatures."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import TelemetryError

_NEWLINE, _COMMA = 10, 44


@dataclass(frozen=True)
class CsvTable:
    """A CSV file whose rows all have as many fields as its header.

    Attributes
    ----------
    name
        The file, for messages.
    header
        Column names, distinct.
    line : (n_rows,)
        Line of each row in the file, counted from 1; blank lines are no rows.
    data
        The file's bytes with newlines made uniform.
    """

    name: str
    header: tuple[str, ...]
    line: IntArray
    data: bytes

    def numbers(self, columns: Sequence[str]) -> dict[str, FloatArray]:
        """Return columns as finite numbers, (n_rows,) each, NaN where a cell is empty.

        Raises
        ------
        TelemetryError
            Naming row and column of the first cell that is not a finite number.
        """
        if not columns:
            return {}
        try:
            frame = self._parse(columns, "float64")
            parsed = {name: frame[name].to_numpy() for name in columns}
        except ValueError:
            parsed = {}
        if not parsed or any(
            np.isinf(column).any() for column in parsed.values()
        ):  # some cell is wrong; find out which
            return {name: self._one_by_one(name) for name in columns}
        return parsed

    def texts(self, column: str) -> list[str]:
        """Return one column as text, stripped, '' where a cell is empty."""
        frame = self._parse([column], "str")
        return [str(text).strip() for text in frame[column].fillna("").to_list()]

    def refuse(self, row: int, column: str, problem: str) -> None:
        """Raise TelemetryError about one cell."""
        raise TelemetryError(f"{self.name}: row {self.line[row]}: column '{column}' {problem}")

    def _parse(self, columns: Sequence[str], dtype: str) -> pd.DataFrame:
        return pd.read_csv(
            io.BytesIO(self.data),
            header=0,
            names=list(self.header),
            usecols=list(columns),
            index_col=False,
            dtype=dict.fromkeys(columns, dtype),
            keep_default_na=False,
            na_values=[""],
            skipinitialspace=True,
            low_memory=False,
        )

    def _one_by_one(self, name: str) -> FloatArray:
        texts = self.texts(name)
        column = np.full(len(texts), np.nan)
        for row, text in enumerate(texts):
            if text:
                column[row] = self._number(row, name, text)
        return column

    def _number(self, row: int, name: str, text: str) -> float:
        shown = text if len(text) <= 40 else f"{text[:37]}..."
        mend = (
            "correct it" if name == self.header[0] else "correct it, or leave the cell empty where a sample is missing"
        )
        try:
            value = float(text.replace("_", "x"))  # Python alone would read 1_000
        except ValueError:
            self.refuse(row, name, f"holds '{shown}', which is not a number; {mend}")
        if not np.isfinite(value):
            self.refuse(row, name, f"holds '{shown}', which is not a finite number; {mend}")
        return value


def open_table(path: Path | str) -> CsvTable:
    """Read a comma-separated file with a header row.

    Raises
    ------
    TelemetryError
        If the file cannot be read, is not text, has no rows, a repeated column name or a row of another length.
    """
    data = _read(Path(path))
    names, line_numbers, fields = _shape(str(path), data)
    header = _header(str(path), names)
    wrong = fields != len(header)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise TelemetryError(
            f"{path}: row {line_numbers[row]}: has {fields[row]} fields, the header has {len(header)};"
            " write one comma-separated value per column"
        )
    if not line_numbers.size:
        raise TelemetryError(f"{path}: has a header but no rows; add samples")
    return CsvTable(str(path), header, line_numbers, data)


def _read(path: Path) -> bytes:
    """Return the file's bytes, without byte order mark, trailing blanks and carriage returns."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read ({error.strerror})") from error
    data = data.removeprefix(b"\xef\xbb\xbf")
    if not data.isascii():
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, error.start) + 1
            raise TelemetryError(f"{path}: row {line}: not text in UTF-8; is this a CSV file?") from error
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise TelemetryError(f"{path}: row {line}: holds a NUL byte; is this a CSV file?")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not data.strip():
        raise TelemetryError(f"{path}: is empty; a header row and samples are expected")
    return data.rstrip() + b"\n"


def _shape(name: str, data: bytes) -> tuple[list[str], IntArray, IntArray]:
    """Return the header's names, and for each row its line in the file and its number of fields."""
    if b'"' in data:
        rows = list(_quoted_rows(name, data))
        lines = np.array([line for line, _ in rows[1:]], dtype=np.int64)
        return rows[0][1], lines, np.array([len(cells) for _, cells in rows[1:]], dtype=np.int64)
    characters = np.frombuffer(data, dtype=np.uint8)
    ends = np.flatnonzero(characters == _NEWLINE)
    starts = np.concatenate([[0], ends[:-1] + 1])
    filled = np.flatnonzero(ends > starts)
    commas = np.diff(np.searchsorted(np.flatnonzero(characters == _COMMA), ends), prepend=0)
    header = data[starts[filled[0]] : ends[filled[0]]].decode().split(",")
    return header, filled[1:] + 1, commas[filled[1:]] + 1


def _quoted_rows(name: str, data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each row of a file with quotation marks."""
    reader = csv.reader(io.StringIO(data.decode(), newline=""), strict=True)
    try:
        for cells in reader:
            if cells:
                yield reader.line_num, cells
    except csv.Error as error:
        raise TelemetryError(f"{name}: row {reader.line_num}: {error}; check the quotation marks") from error


def _header(path: str, names: list[str]) -> tuple[str, ...]:
    header = tuple(name.strip() for name in names)
    for position, name in enumerate(header):
        if name in header[:position]:
            raise TelemetryError(f"{path}: row 1: column '{name}' stands twice in the header; rename or drop one")
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        raise TelemetryError(f"{path}: row 1: columns must be separated by commas (got '{header[0][:60]}')")
    return header
