"""The engine asks what waits together, and one deadly question harms nobody else."""

import asyncio
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from service.live.batches import Batches
from service.live.engine import Engine, WorkerDied
from service.workbench.core import CoreWorkbench
from service.workbench.interface import Stretch, Telemetry
from tests.service.fakes import DEADLY, UNFIT, FakeWorkbench
from twin_core.errors import ModelError


def test_what_comes_while_a_batch_is_under_way_goes_together() -> None:
    asked: list[list[int]] = []

    async def ask(questions: list[int]) -> Sequence[int | Exception]:
        asked.append(questions)
        under_way.set()
        await all_asked.wait()
        return [ModelError("no") if q == 4 else 10 * q for q in questions]

    under_way, all_asked = asyncio.Event(), asyncio.Event()

    async def talk() -> list[Any]:
        batches = Batches(ask, at_once=1, most=5)
        tasks = [asyncio.create_task(batches.ask(q)) for q in range(9)]
        await under_way.wait()
        tasks[8].cancel()  # nobody waits for it any more
        late = [asyncio.create_task(batches.ask(q)) for q in (9,)]
        await asyncio.sleep(0.0)  # it asks
        all_asked.set()
        return await asyncio.gather(*tasks, *late, return_exceptions=True)

    found = asyncio.run(talk())
    assert asked == [[0, 1, 2, 3, 4], [5, 6, 7, 9]]
    assert isinstance(found[4], ModelError) and isinstance(found[8], asyncio.CancelledError)
    assert [one for k, one in enumerate(found) if k not in (4, 8)] == [0, 10, 20, 30, 50, 60, 70, 90]


def test_whoever_asks_as_soon_as_it_is_answered_is_answered_again() -> None:
    """The task that found nothing more to ask has not ended yet when the next question comes."""

    async def ask(questions: list[int]) -> Sequence[int | Exception]:
        await asyncio.sleep(0.0)
        return questions

    async def talk() -> list[int]:
        batches = Batches(ask, at_once=1, most=5)
        async with asyncio.timeout(10.0):
            return [await batches.ask(q) for q in range(3)]

    assert asyncio.run(talk()) == [0, 1, 2]


def test_a_batch_that_cannot_be_asked_fails_for_all_that_are_in_it() -> None:
    async def ask(questions: list[int]) -> Sequence[int | Exception]:
        raise ZeroDivisionError

    async def talk() -> list[Any]:
        batches = Batches(ask, at_once=2, most=5)
        return await asyncio.gather(*(batches.ask(q) for q in range(3)), return_exceptions=True)

    assert [type(one) for one in asyncio.run(talk())] == [ZeroDivisionError] * 3


def stretch(reading: float) -> Stretch:
    values = {"T_px": np.array([290.0, reading]), "T_tank": np.array([20.0, 21.0])}
    return Stretch("{}", Telemetry(0, np.array([0, 10**6]), values), {"last": [290.0, 20.0]})


@pytest.mark.slow
def test_the_process_dies_over_one_twin_and_the_others_have_their_answers() -> None:
    async def talk() -> list[Any]:
        engine = Engine(FakeWorkbench)
        readings = [291.0, 292.0, DEADLY, UNFIT, 293.0]
        questions = [engine.assimilate(stretch(reading)) for reading in readings]
        found = await asyncio.gather(*questions, return_exceptions=True)
        await engine.close()
        return found

    found = asyncio.run(talk())
    assert isinstance(found[2], WorkerDied) and isinstance(found[3], ModelError)
    assert [found[k].innovation_K[-1, 0] for k in (0, 1, 4)] == [1.0, 2.0, 3.0]


def test_a_document_that_is_no_model_leaves_the_others_alone() -> None:
    found = CoreWorkbench().assimilate([stretch(291.0)])
    assert isinstance(found[0], Exception) and "format" in str(found[0])
