"""What a job is given of the archive."""

import numpy as np

from service.jobs.runner import validation_start
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
