"""Specifications as files and plain data, with one clear message for what is wrong."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from twin_core.errors import SpecError
from twin_core.network.quantities import NAME, TWIN_ID
from twin_core.network.references import unknown_names
from twin_core.network.spec import REFERENCES, TwinSpec

Model = TypeVar("Model", bound=BaseModel)


def _in_words(error: ValidationError) -> list[str]:
    """Return every problem of a validation as ``field: what is wrong``; missing fields come last.

    A field that may be of several types has one problem per type, the first of which is told. What is wrong with a part is
    not told of the whole once more.
    """
    found: dict[tuple[int | str, ...], list[str]] = {}
    for item in sorted(error.errors(), key=lambda item: item["type"] == "missing"):
        where = ""
        for part in item["loc"]:
            where += f"[{part}]" if isinstance(part, int) else f"{'.' if where else ''}{part}"
        message = _wording(item)
        lines = item["ctx"]["problems"] if item["type"] == REFERENCES else [f"{where}: {message}" if where else message]
        found.setdefault(_field(item["loc"]), lines)
    within = {field[:n] for field in found for n in range(len(field))}
    return [line for field, lines in found.items() if field not in within for line in lines]


def _field(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """Return where a problem is, without the name of the type that was tried there."""
    tried = (k for k, part in enumerate(loc) if k > 1 and isinstance(part, str) and _is_type(part))
    return loc[: next(tried, len(loc))]


def _is_type(part: str) -> bool:
    return "[" in part or part in _TYPES_TRIED


_TYPES_TRIED = ("str", "constrained-str", "float")


_QUANTITIES = ("Quantity", "Conductance", "HeatCapacity", "ExchangeArea")


_WORDING = {
    "extra_forbidden": "unknown field; remove it or correct its spelling",
    "missing": "is missing",
    "model_type": "must be a mapping of fields",
    "dict_type": "must be a mapping of names",
    "tuple_type": "must be a list",
    "too_short": "must hold more entries",
    "too_long": "must hold fewer entries",
    "string_type": "must be text",
    "float_parsing": "must be a number",
    "float_type": "must be a number",
    "bool_parsing": "must be true or false",
    "bool_type": "must be true or false",
}


_PATTERN_WORDING = {
    NAME: "is no valid name; begin with a letter or '_' and go on with letters, digits and '_.:/-', 128 at most",
    TWIN_ID: "is no valid id; begin with a lower-case letter or digit and go on with those and '-', 63 at most",
}


def _wording(problem: Mapping[str, Any]) -> str:
    """Return what is wrong in words of the specification rather than of the validator."""
    kind, given = problem["type"], problem["input"]
    if kind == "model_type" and isinstance(given, int | float) and problem["ctx"]["class_name"] in _QUANTITIES:
        return f"write {{value: {given:g}}} where it is known, or {{guess: {given:g}}} where it is to be calibrated"
    if kind == "string_pattern_mismatch":
        message = _PATTERN_WORDING[problem["ctx"]["pattern"]]
    else:
        message = _WORDING.get(kind, problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be"))
    if kind in ("extra_forbidden", "missing", "value_error") or isinstance(given, dict | list):
        return message
    shown = repr(given)
    return f"{message} (got {shown if len(shown) <= 60 else shown[:57] + '...'})"


class _UniqueKeys(yaml.SafeLoader):
    """A safe YAML loader that refuses a key that stands twice, where YAML would silently keep the last.

    Times stay text, quoted or not.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise SpecError(f"line {node.value[i][0].start_mark.line + 1}: '{key}' stands twice")
        return super().construct_mapping(node, deep)


_UniqueKeys.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


class _NoAliases(_UniqueKeys):
    """The same without aliases."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            line = self.peek_event().start_mark.line + 1
            raise SpecError(f"line {line}: aliases are not taken here; write the part out")
        return super().compose_node(parent, index)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object, refusing a key that stands twice."""
    result = dict(pairs)
    if len(result) < len(pairs):
        names = [name for name, _ in pairs]
        raise SpecError(f"'{next(n for i, n in enumerate(names) if n in names[:i])}' stands twice")
    return result


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML or JSON file whose top level is a mapping.

    Raises
    ------
    SpecError
        If the file cannot be read, is not YAML or JSON, or is not a mapping.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a text file"
        raise SpecError(f"{path}: cannot be read ({reason})") from error
    return parse_mapping(text, str(path), is_json=Path(path).suffix == ".json")


def parse_mapping(text: str, name: str, *, is_json: bool = False, may_repeat: bool = True) -> dict[str, Any]:
    """Read a YAML or JSON text whose top level is a mapping.

    Parameters
    ----------
    text
        What to read.
    name
        Of the text, at the head of every message.
    is_json
        Whether it is JSON; YAML otherwise.
    may_repeat
        Whether YAML may repeat parts of itself by aliases: a short text of a stranger might stand for a very long one.

    Raises
    ------
    SpecError
        If it is not YAML or JSON, or is not a mapping.
    """
    try:
        if is_json:
            data = json.loads(text, object_pairs_hook=_unique)
        else:
            data = yaml.load(text, Loader=_UniqueKeys if may_repeat else _NoAliases)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1}: " if mark else ""
        raise SpecError(
            f"{name}: {line}not valid YAML ({getattr(error, 'problem', None) or 'cannot be parsed'})"
        ) from error
    except json.JSONDecodeError as error:
        raise SpecError(f"{name}: line {error.lineno}: not valid JSON ({error.msg})") from error
    except RecursionError as error:
        raise SpecError(f"{name}: is nested too deeply") from error
    except SpecError as error:
        raise SpecError(f"{name}: {error}") from error
    except ValueError as error:
        raise SpecError(f"{name}: holds a number of too many digits") from error
    if not isinstance(data, dict):
        raise SpecError(f"{name}: the top level must be a mapping of fields, got {type(data).__name__}")
    return data


def read_model(
    source: Path | str | dict[str, Any],
    kind: type[Model],
    in_words: Callable[[ValidationError], Sequence[str]],
    beside: Callable[[dict[str, Any]], Iterable[str]] = lambda _: (),
) -> Model:
    """Return what a YAML or JSON file, or its parsed mapping, describes.

    Parameters
    ----------
    source
        File or mapping.
    kind
        What it should describe.
    in_words
        Says in one line each which fields are wrong, and how.
    beside
        What else is wrong with a mapping some of whose fields are wrong.

    Raises
    ------
    SpecError
        With one line that names the file and the first field, and says what is wrong; ``problems`` lists all.
    """
    prefix = "" if isinstance(source, dict) else f"{source}: "
    data = source if isinstance(source, dict) else read_mapping(Path(source))
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        told = any(item["type"] == REFERENCES for item in error.errors())  # every field is right: names were looked up
        problems = list(dict.fromkeys([*in_words(error), *(() if told else beside(data))]))
        raise SpecError(prefix + problems[0], problems) from error
    except SpecError as error:
        raise SpecError(prefix + str(error), error.problems) from error


def load_spec(source: Path | str | dict[str, Any]) -> TwinSpec:
    """Return the validated specification from a YAML or JSON file, or from its parsed mapping; SpecError as above."""
    return read_model(source, TwinSpec, _in_words, unknown_names)


def dump_spec(spec: TwinSpec) -> dict[str, Any]:
    """Return the specification as plain data that ``load_spec`` reads back; absent fields are left out."""
    return spec.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
