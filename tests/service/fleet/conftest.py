"""What several tests of a fleet begin with."""

from collections.abc import Iterator

import pytest

from tests.service.fleet.cluster import Cluster


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    made = Cluster()
    yield made
    made.kill(made.worker)
    made.kill(made.scheduler)
