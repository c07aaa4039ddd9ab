"""What the hold-out says against a verdict: told where it is so, and nowhere else."""

import pytest

from twin_core._typing import Json
from twin_core.report.holdout_doubts import doubts

NOISE_K = {"T_a": 0.1, "T_b": 0.1}


def scores(overall_K: float, **each_K: float) -> Json:
    """Return held-out scores with the errors that are asked of them."""
    return {"rmse_K": overall_K, "per_sensor": {name: {"rmse_K": value} for name, value in each_K.items()}}


@pytest.mark.parametrize(
    ("before", "after", "found", "training_K", "said"),
    [
        (scores(1.0, T_a=1.0, T_b=1.0), scores(0.5, T_a=0.5, T_b=0.5), True, 0.5, []),
        (scores(0.5, T_a=0.5, T_b=0.5), scores(0.5, T_a=0.5, T_b=0.5), True, 0.5, ["it did not fall"]),
        (scores(0.5, T_a=0.5, T_b=0.5), scores(0.9, T_a=1.2, T_b=0.5), True, 0.5, ["it did not fall"]),
        (scores(0.5, T_a=0.5, T_b=0.5), scores(0.5, T_a=0.5, T_b=0.5), False, 0.5, []),
        (
            scores(2.0, T_a=2.7, T_b=0.89),
            scores(1.1, T_a=0.3, T_b=1.51),
            True,
            1.0,
            ["error of T_b: 0.89 K before, 1.51 K"],
        ),
        (scores(2.0, T_a=2.7, T_b=0.05), scores(0.3, T_a=0.3, T_b=0.09), True, 0.3, []),  # within its noise
        (scores(2.0, T_a=2.7, T_b=0.89), scores(0.7, T_a=0.3, T_b=0.91), True, 0.7, []),  # by two per cent
        (scores(1.0, T_a=1.4, T_b=0.1), scores(0.1, T_a=0.1, T_b=0.14), True, 0.1, []),  # fits to the noise, by chance
        (scores(1.0, T_a=1.4, T_b=0.1), scores(0.1, T_a=0.1, T_b=0.19), True, 0.1, ["error of T_b"]),
        (scores(2.0, T_a=2.7, T_b=0.2), scores(0.5, T_a=0.5), True, 0.5, ["T_b has no"]),  # not predicted any more
        (scores(2.0, T_a=2.0), scores(0.5, T_a=0.5), True, 0.5, ["T_b has no usable reading in the hold-out"]),
        (scores(0.5, T_a=0.5), scores(0.5, T_a=0.5), False, 0.5, ["T_b has no usable reading in the hold-out"]),
        (scores(3.1, T_a=3.1, T_b=3.1), scores(3.1, T_a=3.1, T_b=3.1), False, 1.0, ["fits 3 times worse"]),
        (scores(3.0, T_a=3.0, T_b=3.0), scores(3.0, T_a=3.0, T_b=3.0), False, 1.0, []),
        (scores(3.0, T_a=3.0, T_b=3.0), scores(3.0, T_a=3.0, T_b=3.0), False, 0.0, []),
    ],
)
def test_what_is_said(before: Json, after: Json, training_K: float, said: list[str], *, found: bool) -> None:
    counts = {name: 50 if name in after["per_sensor"] else 0 for name in NOISE_K}
    told = doubts(NOISE_K, counts, before, after, training_K, found=found)
    assert len(told) == len(said)
    assert all(words in line for words, line in zip(said, told, strict=True))
