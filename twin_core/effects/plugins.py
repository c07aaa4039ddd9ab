"""Effects from outside the package: of a Python file that the user names, or of an installed package's entry points."""

import importlib.util
import inspect
import sys
import traceback
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

from twin_core.effects.base import Effect
from twin_core.errors import PluginError

GROUP = "thermal_twin.effects"
"""The group of entry points: each names an effect, or a module with effects."""

PACKAGE = "package "
"""What a model file writes before the name of a package; a file stands there by its bare name."""


def effects_in_file(file: Path) -> tuple[type[Effect], ...]:
    """Return the effects that a Python file defines, in its order; a file is run once in a process.

    Raises
    ------
    PluginError
        If it cannot be read or run, or defines no effect.
    """
    path = file.resolve()
    if path not in _LOADED:
        _LOADED[path] = _run(path, str(file))
    return _LOADED[path]


_LOADED: dict[Path, tuple[type[Effect], ...]] = {}


def _run(path: Path, shown: str) -> tuple[type[Effect], ...]:
    if path.suffix != ".py" or not path.is_file():
        what = "is not a Python file" if path.is_file() else "is not there"
        raise PluginError(f"{shown}: {what}; name a file .py that defines an effect")
    name = f"thermal_twin_effects_{path.stem}_{crc32(str(path).encode()):08x}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None  # by its suffix
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise PluginError(f"{shown}{_line(error, path)}: {_said(error)}; correct the file") from error
    return tuple(_effects_of(module, shown))


def installed_effects() -> Iterator[tuple[str, str, type[Effect]]]:
    """Yield the effects of installed packages: source, what model files remember of it, effect.

    Raises
    ------
    PluginError
        If an entry point cannot be loaded or is no effect.
    """
    for point in entry_points(group=GROUP):
        package = point.dist.name if point.dist is not None else point.module
        source = f"package {package}, entry point {point.name}"
        for kind in _effects_at(point, source):
            yield source, PACKAGE + package, kind


def fault_of_a_file(error: BaseException) -> str | None:
    """Return the line to say where an error arose in a plug-in file while it was used; None where it did not."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if Path(frame.filename) in _LOADED:
            return f"{frame.filename}:{frame.lineno}: {_said(error)}; correct the plug-in"
    return None


def remedy(plugin: str) -> str:
    """Return what to do for the plug-in that a model file remembers."""
    if plugin.startswith(PACKAGE):
        return f"install {plugin}"
    return f"give it with --effects {plugin} (in the service: TWIN_EFFECTS={plugin})"


def _effects_at(point: EntryPoint, source: str) -> list[type[Effect]]:
    try:
        found: Any = point.load()
    except (Exception, SystemExit) as error:
        raise PluginError(f"{source}: {_said(error)}; correct the package or uninstall it") from error
    if isinstance(found, ModuleType):
        return list(_effects_of(found, source))
    if not (inspect.isclass(found) and issubclass(found, Effect)) or inspect.isabstract(found):
        raise PluginError(
            f"{source}: {point.value} is no effect; it must be a subclass of twin_core.effects.base.Effect"
        )
    return [_complete(found, source)]


def _effects_of(module: ModuleType, source: str) -> Iterator[type[Effect]]:
    """Yield the effects that a module itself defines."""
    kinds = [kind for kind in vars(module).values() if inspect.isclass(kind) and issubclass(kind, Effect)]
    own = [kind for kind in dict.fromkeys(kinds) if kind.__module__ == module.__name__]
    whole = [kind for kind in own if not inspect.isabstract(kind)]
    if not own:
        raise PluginError(f"{source}: defines no effect; write a subclass of twin_core.effects.base.Effect")
    if not whole:
        lacking = ", ".join(sorted(own[0].__abstractmethods__))
        raise PluginError(f"{source}: {own[0].__name__} lacks {lacking}; define what is missing")
    yield from (_complete(kind, source) for kind in whole)


def _complete(kind: type[Effect], source: str) -> type[Effect]:
    for attribute in ("name", "keys", "equation", "reference", "sentence"):
        if not getattr(kind, attribute, None):
            raise PluginError(f"{source}: {kind.__name__} has no '{attribute}'; set it in the class")
    return kind


def _line(error: BaseException, path: Path) -> str:
    """Return the line of a file at which an error arose as ``:7``, nothing where it did not arise there."""
    if isinstance(error, SyntaxError):
        return f":{error.lineno}" if error.lineno else ""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f":{lines[-1]}" if lines else ""


def _said(error: BaseException) -> str:
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{type(error).__name__}: {message}" if message else type(error).__name__
