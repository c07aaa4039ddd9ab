"""What gradients within nodes explain, and what a name explains of what they do not."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from twin_core.discover.policy import MOST_COARSENESS
from twin_core.discover.trial import Trial, explained

NATS = 100.0


@dataclass
class Fake:
    """A trial of which only what it leaves counts: alone, and beside gradients so much likelier, if they were fitted."""

    alone: float
    beside: float | None = None
    likelier: float = 1.0

    def calibration(self) -> Any:
        return SimpleNamespace(log_posterior=NATS)

    def beside_gradients(self) -> Any:
        if self.beside is None:
            return None
        return SimpleNamespace(log_posterior=NATS + self.likelier, residuals=[np.array([[self.beside]])])

    def excess(self) -> Any:
        return np.array([self.alone])

    def _excess(self, residuals: list[Any]) -> Any:
        return residuals[0][0]

    def share_of_gradients(self) -> float:
        return float(Trial.share_of_gradients.__wrapped__(self))  # type: ignore[attr-defined]

    def left_beside(self, share: float) -> float:
        return Trial.left_beside(cast(Trial, self), share)


@pytest.mark.parametrize(
    ("trial", "share", "left"),
    [
        (Fake(9.0), 0.0, 9.0),
        (Fake(9.0, 0.5), 1.0, 0.5),
        (Fake(9.0, 0.5, likelier=0.0), 0.0, 9.0),
        (Fake(9.0, MOST_COARSENESS), 1.0, MOST_COARSENESS),
        (Fake(90.0, 10.0 * MOST_COARSENESS), 0.1, 0.9 * 90.0 + MOST_COARSENESS),
    ],
    ids=["fits to the noise", "coarse", "no likelier beside gradients", "as coarse as can be", "missing far more"],
)
def test_gradients_explain_what_a_coarse_network_leaves(trial: Fake, share: float, left: float) -> None:
    """Where far more stays beside them than any coarse network leaves, what they explain is hardly theirs."""
    assert trial.share_of_gradients() == pytest.approx(share)
    assert trial.left_beside(share) == pytest.approx(left)


@pytest.mark.parametrize(
    ("simple", "rich", "found", "nats"),
    [
        (Fake(MOST_COARSENESS, 1.0), Fake(3.0, 0.5), None, 0.5),
        (Fake(9.0, 1.0), Fake(3.0, 0.5, likelier=-1.0), None, 6.0),
        (Fake(9.0, 1.0), Fake(0.0), None, 9.0),
        (Fake(MOST_COARSENESS, 1.0, likelier=-1.0), Fake(3.0, 0.5), None, 0.5),
        (Fake(9.0, 1.0), Fake(3.0, 0.5), Fake(0.0), 6.0),
        (Fake(MOST_COARSENESS + 1.5, 1.0), Fake(3.0, 0.5), None, 1.0),
        (Fake(90.0, 1.0), Fake(3.0, 0.5), None, 90.0 - MOST_COARSENESS - 0.5),
        (Fake(90.0, 1.0), Fake(30.0, 0.5), None, 60.0),
    ],
    ids=[
        "coarse with it too",
        "no longer coarse",
        "nothing stays",
        "coarse only with it",
        "as another one was found",
        "hardly more than coarse without it",
        "far more than coarse without it",
        "far more than coarse with it too",
    ],
)
def test_a_name_explains_what_gradients_do_not(simple: Fake, rich: Fake, found: Fake | None, nats: float) -> None:
    """A sensor that lags is what gradients explain too: with the lag nothing is left to them, so that all of it is its own.

    What exceeds any coarse network's misfit they cannot explain without the name, unless they must beside it too.
    """
    told = explained(cast(Trial, simple), cast(Trial, rich), cast("Trial | None", found))
    assert told == pytest.approx(nats)
