"""CSV text: spellings that must be read, each against Python's own csv module or plain numbers."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest

from twin_core.csv_table import open_table
from twin_core.errors import TelemetryError

SPELLINGS = {
    "plain": b"t,a,b\n1,2.5,x\n2,,y\n",
    "windows line ends": b"t,a,b\r\n1,2.5,x\r\n2,,y\r\n",
    "old line ends": b"t,a,b\r1,2.5,x\r2,,y\r",
    "byte order mark": b"\xef\xbb\xbft,a,b\n1,2.5,x\n2,,y\n",
    "no last newline": b"t,a,b\n1,2.5,x\n2,,y",
    "blank lines": b"\nt,a,b\n\n1,2.5,x\n\n\n2,,y\n\n",
    "spaces": b"t, a, b\n1, 2.5, x\n2, , y\n",
    "quotes": b'"t","a","b"\n1,"2.5","x"\n2,"","y"\n',
    "exponents": b"t,a,b\n1,25e-1,x\n2.0,,y\n",
}


@pytest.mark.parametrize("data", SPELLINGS.values(), ids=SPELLINGS.keys())
def test_spellings(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.csv").write_bytes(data)
    table = open_table(tmp_path / "a.csv")
    assert table.header == ("t", "a", "b")
    columns = table.numbers(["t", "a"])
    np.testing.assert_array_equal(columns["t"], [1.0, 2.0])
    np.testing.assert_array_equal(columns["a"], [2.5, np.nan])
    assert table.texts("b") == ["x", "y"]


def test_rows_keep_their_line_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n\na\n1\n\n2\n\n\n3\n")
    assert open_table(tmp_path / "a.csv").line.tolist() == [4, 6, 9]


def test_quoted_commas_are_no_separators(tmp_path: Path) -> None:
    text = 'a,note\n1,"one, and more"\n2,two\n'
    (tmp_path / "a.csv").write_text(text)
    expected = [row[1] for row in csv.reader(io.StringIO(text))][1:]
    assert open_table(tmp_path / "a.csv").texts("note") == expected


def test_numbers_survive_exactly(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=200) * 10.0 ** np.arange(-100, 100)
    (tmp_path / "a.csv").write_text("a\n" + "\n".join(map(repr, values.tolist())) + "\n")
    np.testing.assert_array_max_ulp(open_table(tmp_path / "a.csv").numbers(["a"])["a"], values, maxulp=1)


@pytest.mark.parametrize("cell", ["1_000", "0x10", "True", "1,5", "--1", "NA", "null", "1e999", "-inf", "nan"])
def test_what_is_no_number(tmp_path: Path, cell: str) -> None:
    (tmp_path / "a.csv").write_text(f"a\n1\n{cell}\n")
    with pytest.raises(TelemetryError, match=r"a\.csv: row 3: "):
        open_table(tmp_path / "a.csv").numbers(["a"])


def test_folder_is_no_table(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="cannot be read"):
        open_table(tmp_path)
