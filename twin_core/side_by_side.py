"""Independent pieces of work side by side, in processes forked for them.

A fit is thousands of short calls into NumPy, and threads wait for each other at the interpreter: two of them take as long as
one. A forked process has the record, the models and all that is known of them already. It sends back what it has made; what
was there before comes back as itself, not as a copy.
"""

import io
import os
import pickle
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, Pipe, wait
from threading import Lock, RLock, Thread, current_thread, main_thread
from types import FunctionType, MethodType, ModuleType
from typing import Any, TypeVar, cast

import numpy as np

T = TypeVar("T")
U = TypeVar("U")


@dataclass
class _UnderWay:
    """Processes that this one has forked, which end with the last end of a pipe, and how many cores besides its own they use."""

    alive: tuple[int, int]
    n_more: int
    processes: list[int] = field(default_factory=list)

    def end(self, free: tuple[int, int]) -> None:
        """End them, wait until they have, and give their cores back."""
        for descriptor in self.alive:
            with suppress(OSError):  # the thread that ends this process may do the same
                os.close(descriptor)
        for process in self.processes:
            with suppress(ChildProcessError):
                os.waitpid(process, 0)
        n_more, self.n_more = self.n_more, 0
        os.write(free[1], bytes(n_more))


CAN_FORK = sys.platform == "linux"
"""Elsewhere a fork of a process that has used its system's libraries is not safe, and work is done one after the other."""

_INDEX_BYTES = 2

_free: tuple[int, int] | None = None
"""While work is done: a pipe with one byte for each core that has nothing to do, as of make's job server."""

_under_way: list["_UnderWay"] = []
"""What this process waits for, the innermost last."""

_is_forked = False

_forking = Lock()
"""Held while this process forks, and by the thread that ends it, so that nothing is forked any more."""


def n_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if CAN_FORK else 1


def side_by_side(works: Sequence[Callable[[], T]]) -> list[T]:
    """Return what each of some pieces of work returns, done on all cores.

    What they change is lost; what they raise is raised here, that of the first one that did. Within a piece, further pieces are
    done one after the other, until a core has nothing else to do. So are all that are asked for by another thread than the main
    one: beside it there are others, and what they have locked stays locked in a fork.

    Parameters
    ----------
    works
        Functions without arguments, or partial ones. What they return must be picklable, but for locks.
    """
    with ahead(works) as result:
        return [result(i) for i in range(len(works))]


@contextmanager
def ahead(works: Sequence[Callable[[], T]]) -> Iterator[Callable[[int], T]]:
    """Hand out the results of some pieces of work, as :func:`side_by_side`, by their number and each once.

    From the first that is asked for on, others are under way; those are given up with the context.
    """
    left, told = list(range(len(works))), dict[int, tuple[bool, T | Exception]]()
    coming: Generator[tuple[int, tuple[bool, T | Exception]], None, None] | None = None

    def result(i: int) -> T:
        nonlocal coming
        if coming is None and (n_more := _cores_for(len(left))):
            coming = _told(works, left, n_more)
        while coming is not None and i not in told:
            one = next(coming, None)
            if one is None:  # a process that was killed, or could not send what it had made, has left its work undone
                break
            told.update([one])
        if i not in told:
            if i in left:
                left.remove(i)
            return works[i]()
        returned, value = told.pop(i)
        if not returned:
            raise cast(BaseException, value)
        return cast(T, value)

    try:
        yield result
    finally:
        if coming is not None:
            coming.close()


def _cores_for(n_works: int) -> int:
    """Return on how many cores beside this process's own some pieces of work may be done; nobody else uses them from now on."""
    if n_works < 2 or not CAN_FORK or current_thread() is not main_thread():
        return 0
    if _free is None:
        return min(n_works, n_cores()) - 1
    try:
        return len(os.read(_free[0], n_works - 1))
    except BlockingIOError:
        return 0


def both(first: Callable[[], T], second: Callable[[], U]) -> tuple[T, U]:
    """Return what two pieces of work return, done side by side."""
    done: list[object] = side_by_side([first, second])
    return cast(tuple[T, U], tuple(done))


def _told(
    works: Sequence[Callable[[], T]], numbers: Sequence[int], n_more: int
) -> Generator[tuple[int, tuple[bool, T | Exception]], None, None]:
    """Yield the number of each piece of work that is done, whether it returned, and what it returned or raised.

    It is done on ``n_more`` cores and on that of this process, which waits. Cores are free again as soon as nothing is left for
    them.
    """
    global _free
    known = _reachable(works)
    todo, end_of_todo = os.pipe()
    os.write(end_of_todo, b"".join(i.to_bytes(_INDEX_BYTES, "little") for i in numbers))
    os.close(end_of_todo)  # whoever reads beyond the last number learns that nothing is left
    if _free is None:
        _free = os.pipe()
        os.set_blocking(_free[0], False)
        os.write(_free[1], bytes(max(0, n_cores() - n_more - 1)))
    free, own = _free, _UnderWay(os.pipe(), n_more)
    _under_way.append(own)
    receivers: list[Connection] = []
    try:
        for _ in range(n_more + 1):
            receiver, sender = Pipe(duplex=False)
            with _forking:
                process = os.fork()
                if process == 0:
                    for one in _under_way:
                        os.close(one.alive[1])
                    _work(works, known, todo, own.alive[0], sender)
                own.processes.append(process)
            sender.close()
            receivers.append(receiver)
        while receivers:
            for receiver in cast(list[Connection], wait(receivers)):
                try:
                    content = receiver.recv_bytes()
                except (EOFError, OSError):
                    receiver.close()
                    receivers.remove(receiver)
                    if own.n_more:
                        own.n_more -= os.write(free[1], bytes(1))
                else:
                    yield _loaded(content, known)
    finally:
        os.close(todo)
        for receiver in receivers:
            receiver.close()
        own.end(free)
        _under_way.remove(own)
        if not (_under_way or _is_forked):
            _free = None
            for descriptor in free:
                os.close(descriptor)


def _work(
    works: Sequence[Callable[[], object]], known: dict[int, object], todo: int, alive: int, sender: Connection
) -> None:
    """Do work until none is left: the whole life of a forked process."""
    global _is_forked, _under_way, _forking
    _is_forked, _under_way, _forking = True, [], Lock()
    status = 1
    try:
        Thread(target=_end_with, args=(alive,), daemon=True).start()
        while number := os.read(todo, _INDEX_BYTES):
            i = int.from_bytes(number, "little")
            told: tuple[bool, object]
            try:
                told = True, works[i]()
            except Exception as error:
                told = False, error
            try:
                content = _dumped((i, told), known)
            except (pickle.PicklingError, AttributeError, TypeError):
                continue  # the parent makes it again
            sender.send_bytes(content)
        status = 0
    finally:
        os._exit(status)  # nothing that the parent has set up for its own end is ours to do


def _end_with(alive: int) -> None:
    """End this process when the one that forked it does, however it ends: nobody would want the result."""
    os.read(alive, 1)
    _forking.acquire()
    for own in reversed(_under_way):
        own.end(cast(tuple[int, int], _free))
    os._exit(1)


class _Pickler(pickle.Pickler):
    """Tells what the other process has by its address there, which is its own."""

    def __init__(self, file: io.BytesIO, known: dict[int, object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._known = known

    def persistent_id(self, obj: object) -> int | None:
        return id(obj) if id(obj) in self._known else None

    def reducer_override(self, obj: object) -> Any:
        """A lock that was taken to compute what is sent along is not sent along."""
        return (RLock, ()) if isinstance(obj, type(RLock())) else NotImplemented


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: dict[int, object]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, pid: int) -> object:
        return self._known[pid]


def _dumped(value: object, known: dict[int, object]) -> bytes:
    file = io.BytesIO()
    _Pickler(file, known).dump(value)
    return file.getvalue()


def _loaded(content: bytes, known: dict[int, object]) -> tuple[int, Any]:
    loaded: tuple[int, Any] = _Unpickler(io.BytesIO(content), known).load()
    return loaded


def _reachable(works: Iterable[object]) -> dict[int, object]:
    """Return all objects with attributes and all arrays that some pieces of work hold, by their address."""
    found: dict[int, object] = {}
    seen: set[int] = set()
    left: list[object] = [*works]
    while left:
        thing = left.pop()
        if id(thing) in seen or isinstance(thing, (ModuleType, type)):
            continue
        seen.add(id(thing))
        if isinstance(thing, np.ndarray):
            found[id(thing)] = thing
        elif isinstance(thing, partial):
            left += [thing.func, thing.args, thing.keywords]
        elif isinstance(thing, MethodType):
            left.append(thing.__self__)
        elif isinstance(thing, FunctionType):
            left += [cell.cell_contents for cell in thing.__closure__ or ()]
        elif isinstance(thing, dict):
            left += thing.values()
        elif isinstance(thing, (list, tuple, set, frozenset)):
            left += thing
        elif hasattr(thing, "__dict__"):
            found[id(thing)] = thing
            left += vars(thing).values()
    return found
