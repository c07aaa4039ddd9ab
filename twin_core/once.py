"""Costly values of an object, computed when they are first asked for."""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Any, TypeVar

from twin_core.side_by_side import side_by_side

Value = TypeVar("Value")


def once(work: Callable[[Any], Value]) -> Callable[[Any], Value]:
    """Return a method without arguments that does its work once per object.

    Threads wait for each other where they ask for the same object only: ``functools.cached_property`` of Python 3.11 holds one
    lock for all objects of a class, so that optimisers behind it would run one after the other.
    """
    key = _key(work.__name__)

    @wraps(work)
    def ask(self: Any) -> Value:
        kept = self.__dict__
        with kept.setdefault("_once_lock", RLock()):
            if key not in kept:
                kept[key] = work(self)
            value: Value = kept[key]
            return value

    return ask


def ask_each(*questions: Callable[[], Any]) -> None:
    """Do the work of several such methods of some objects side by side, so that each is known when it is asked for.

    Parameters
    ----------
    questions
        Bound methods.
    """
    keys: dict[tuple[int, str], Any] = {(id(q.__self__), _key(q.__name__)): q for q in questions}  # type: ignore[attr-defined]
    new = [(key, q) for (_, key), q in keys.items() if key not in q.__self__.__dict__]
    for (key, question), value in zip(new, side_by_side([q for _, q in new]), strict=True):
        question.__self__.__dict__[key] = value


def known(thing: Any) -> dict[str, Any]:
    """Return the costly values of an object that have been computed."""
    return {key: value for key, value in vars(thing).items() if key.startswith(_key("")) and not key.endswith("_lock")}


def keep(thing: Any, values: dict[str, Any]) -> None:
    """Let an object know costly values that were computed of it elsewhere."""
    vars(thing).update({key: value for key, value in values.items() if key not in vars(thing)})


def _key(name: str) -> str:
    return f"_once_{name}"
