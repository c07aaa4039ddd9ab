"""The benchmark on public data of other fields: what it makes of a file, and one line where there is nothing to run."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from benchmarks import heated_building, public_sets

CSV = """,Ph,Ti,Ta,Th
2019-12-23 00:00:00+00:00,0,18.0,5.0,4.5
2019-12-23 01:00:00+00:00,1.5,18.5,4.0,20.0
2019-12-23 02:00:00+00:00,2.0,19.0,3.0,30.0
"""


@pytest.mark.parametrize("declaration", sorted(heated_building.DECLARATIONS))
def test_a_building_is_read_in_si(tmp_path: Path, declaration: str) -> None:
    (tmp_path / heated_building.FILE).write_text(CSV)
    given = heated_building.prepared(declaration, 0.3, tmp_path)
    (record,) = given.records
    assert set(record.values) == set(given.spec.channels)
    np.testing.assert_allclose(record.values["Ti"], [291.15, 291.65, 292.15])
    np.testing.assert_allclose(np.diff(record.time_s), 3600.0)
    if "Ph" in record.values:
        np.testing.assert_allclose(record.values["Ph"], [0.0, 1500.0, 2000.0])
    if "hour" in record.values:
        assert record.values["hour"].tolist() == [0.0, 1.0, 2.0]


def test_every_split_can_be_sent_to_a_process() -> None:
    for split in (*heated_building.SPLITS, *public_sets.photovoltaic.SPLITS):
        assert pickle.loads(pickle.dumps(split)).name == split.name


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "give --arrays, --building or both"),
        (["--building", "{}"], "lacks demo_data.csv"),
        (["--arrays", "{}"], "lacks serf_west_15min.csv"),
    ],
)
def test_nothing_to_run_ends_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    with pytest.raises(SystemExit):
        public_sets.main([word.format(tmp_path) for word in words])
    assert told in capsys.readouterr().err
