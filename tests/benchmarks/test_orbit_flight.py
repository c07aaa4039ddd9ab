"""A CubeSat's day in orbit, measured: its cells saw the eclipses that are computed, its panels do what the model says."""

import numpy as np
import pytest

from benchmarks.measured_splits import DATA, ROOT
from benchmarks.orbit_flight import FILE, crossings, fit_and_predict, live_rows, rmse_K
from twin_core.network.spec_io import load_spec

pytestmark = pytest.mark.skipif(not (DATA / FILE).is_file(), reason="the measured data are not part of the repository")

SPEC = load_spec(ROOT / "examples" / "funcube1.yaml")


def test_the_cells_saw_the_computed_eclipses() -> None:
    """Rows are a minute apart and their stamps whole minutes: half a minute of clock is left, and as much of chance."""
    assert SPEC.orbit is not None
    seen = crossings(live_rows(DATA), SPEC.orbit.environment())
    assert seen.off_s.size > 20
    assert abs(seen.off_s.mean()) < 40.0 and np.abs(seen.off_s - seen.off_s.mean()).max() < 60.0
    assert abs(seen.off_s[seen.enters == 1.0].mean() - seen.off_s[seen.enters == 0.0].mean()) < 20.0


@pytest.mark.slow
def test_panels_are_predicted_and_coupons_told_apart() -> None:
    """The last 40 % in open loop; black absorbs and emits more than silver, which was declared alike."""
    model, errors = fit_and_predict(live_rows(DATA), SPEC)
    panels = [i for i, sensor in enumerate(SPEC.sensors) if "solar" in sensor]
    assert rmse_K(errors[:, panels]) < 2.2 and rmse_K(errors) < 2.1
    rows = {row["name"]: row for row in model.summary["parameters"]}
    for name in ("gain:orbit.sun_mean|{}_chassis", "G:{}_chassis|space", "G:{}_panel|space"):
        black, silver = rows[name.format("black")], rows[name.format("silver")]
        assert black["mean"] - silver["mean"] > 2.0 * np.hypot(black["std"], silver["std"]), name
