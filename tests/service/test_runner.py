"""What a job is given of the archive."""

import numpy as np
import pytest

from service.jobs.runner import HOLDOUT_SHARE, usual_holdout, validation_start
from service.workbench.interface import Telemetry


def archive(time_s: np.ndarray) -> Telemetry:
    return Telemetry(0, np.rint(1e6 * time_s).astype(np.int64), {})


def test_the_last_fifth_is_one_of_the_time_that_samples_cover() -> None:
    regular = np.arange(200.0)
    assert validation_start(archive(regular), None) == 160_000_000
    assert validation_start(archive(np.append(regular, 6.9e9)), None) == 160_000_000  # a clock that is wrong once
    assert validation_start(archive(np.insert(regular + 1e9, 0, 5.0)), None) == 1_000_000_160_000_000
    assert validation_start(archive(regular), 170_000_000) == 170_000_001
    assert validation_start(archive(regular), 190_000_000) == 199_000_001


@pytest.mark.parametrize(
    ("began_s", "share"),
    [
        ([], HOLDOUT_SHARE),
        ([100.0], HOLDOUT_SHARE),
        ([900.0], 0.05),
        ([100.0, 980.0, 900.0], 0.05),
        ([990.0], 0.019),
        ([1000.0], HOLDOUT_SHARE),
    ],
    ids=["none open", "before it", "within", "the first within", "no fewer than twenty samples", "at the end"],
)
def test_a_diagnosis_searches_half_of_what_came_since_an_anomaly_began(began_s: list[float], share: float) -> None:
    time_us = np.arange(1001, dtype=np.int64) * 1_000_000
    assert usual_holdout(time_us, [round(1e6 * began) for began in began_s]) == pytest.approx(share)
