"""The models that fly at Chandra: every one is read, and one repeats the predictions that the flown software made of it."""

from pathlib import Path

import pytest

from benchmarks.flown_model import MODELS, repeated_rms_K
from twin_core.interchange.xija.specification import read_xija
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec

REFUSED = {"pm2thv1t_spec_radiative_coupling.json": "RadiativeCoupling"}
"""The one specification with a component that has no counterpart."""

pytestmark = pytest.mark.skipif(not MODELS.is_dir(), reason="the flown models are not beside this checkout")


def test_the_flown_model_repeats_its_own_predictions() -> None:
    found = repeated_rms_K()
    assert len(found) == 3 and max(found.values()) < 0.1, found


@pytest.mark.parametrize("path", sorted((MODELS / "specs").glob("*.json")), ids=lambda path: path.stem)
def test_every_flown_model_is_translated_or_refused_by_name(path: Path) -> None:
    if path.stem.endswith("fit_log"):
        return
    imported = read_xija(path.read_text(), path.name)
    assert len(imported.refused) == (path.name in REFUSED)
    assert all(REFUSED[path.name] in line and "line " in line for line in imported.refused)
    assert build_network(load_spec(imported.data), table_knots={}).nodes
