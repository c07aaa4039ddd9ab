"""Costly values of an object, computed when they are first asked for."""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Any, TypeVar

Value = TypeVar("Value")


def once(work: Callable[[Any], Value]) -> Callable[[Any], Value]:
    """Return a method without arguments that does its work once per object.

    Threads wait for each other where they ask for the same object only: ``functools.cached_property`` of Python 3.11 holds one
    lock for all objects of a class, so that optimisers behind it would run one after the other.
    """
    key = f"_once_{work.__name__}"

    @wraps(work)
    def ask(self: Any) -> Value:
        kept = self.__dict__
        with kept.setdefault("_once_lock", RLock()):
            if key not in kept:
                kept[key] = work(self)
            value: Value = kept[key]
            return value

    return ask
