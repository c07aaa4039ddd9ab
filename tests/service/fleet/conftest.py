"""What several tests of a fleet begin with."""

from collections.abc import Iterator

import pytest

from tests.service.fleet.cluster import Cluster
from tests.service.fleet.load import STARTED


@pytest.fixture(autouse=True)
def no_load_stays() -> Iterator[None]:
    """A test that failed leaves nobody behind who sends on."""
    yield
    while STARTED:
        STARTED.pop().stop()


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    made = Cluster()
    yield made
    made.kill(made.worker)
    made.kill(made.scheduler)
