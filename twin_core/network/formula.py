"""Channels that are computed from others: a formula of channels and of the date, known and without parameters."""

import ast
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import TelemetryError
from twin_core.units import parse_instant_ns

DAYS = "days"
"""The function ``days('2016-01-01T00:00:00Z')``: days since an instant."""

_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "exp": (1, np.exp),
    "sqrt": (1, np.sqrt),
    "abs": (1, np.abs),
    "radians": (1, np.radians),
    "round": (1, np.round),
    "min": (2, np.minimum),
    "max": (2, np.maximum),
    "where": (3, np.where),
}
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.USub: np.negative,
    ast.UAdd: np.positive,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
    ast.Not: np.logical_not,
}

FUNCTIONS = (*_FUNCTIONS, DAYS)
MOST_CHARACTERS = 10_000


@lru_cache(maxsize=1024)
def parse(formula: str) -> ast.expr:
    """Return a formula as a tree; ValueError with what is wrong if it is none.

    Numbers, channels, ``+ - * / **``, comparisons (1 where true, else 0), ``and or not`` and the functions of ``FUNCTIONS``.
    """
    if len(formula) > MOST_CHARACTERS:
        raise ValueError(f"a formula has {MOST_CHARACTERS} characters at most")
    try:
        tree = ast.parse(formula.strip(), mode="eval").body
    except (SyntaxError, RecursionError, ValueError, MemoryError) as error:
        raise ValueError("is no formula; write it like 0.5 * (pitch - 90)") from error
    _check(tree)
    return tree


def _check(tree: ast.expr) -> None:
    """Refuse whatever is not arithmetic."""
    match tree:
        case ast.Constant(value=value) if isinstance(value, int | float) and not isinstance(value, bool):
            if not np.isfinite(float(value)):
                raise ValueError("holds a number that is not finite")
        case ast.Name():
            pass
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            _check(left)
            _check(right)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            _check(operand)
        case ast.BoolOp(values=joined):
            for part in joined:
                _check(part)
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _OPERATORS:
            _check(left)
            _check(right)
        case ast.Call(func=ast.Name(id="days"), args=[ast.Constant(value=str(date))], keywords=[]):
            try:
                parse_instant_ns(date)
            except TelemetryError as error:
                raise ValueError(str(error)) from error
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS:
            if len(args) != _FUNCTIONS[name][0]:
                raise ValueError(f"'{name}' takes {_FUNCTIONS[name][0]} numbers (got {len(args)})")
            for taken in args:
                _check(taken)
        case _:
            raise ValueError(
                f"cannot use '{ast.unparse(tree)}'; known are + - * / **, comparisons, {', '.join(FUNCTIONS)}"
            )


def channels_of(formula: str) -> tuple[str, ...]:
    """Return the names that a formula reads, each once."""
    called = {id(node.func) for node in ast.walk(parse(formula)) if isinstance(node, ast.Call)}
    names = (node.id for node in ast.walk(parse(formula)) if isinstance(node, ast.Name) and id(node) not in called)
    return tuple(dict.fromkeys(names))


def is_dated(formula: str) -> bool:
    """Return whether a formula needs the date."""
    return any(
        isinstance(n, ast.Call) and isinstance(n.func, ast.Name) and n.func.id == DAYS for n in ast.walk(parse(formula))
    )


def evaluate(formula: str, inputs: Mapping[str, FloatArray], unix_s: FloatArray) -> FloatArray:
    """Return a formula's value wherever its channels are told.

    Parameters
    ----------
    formula
        As declared.
    inputs : channel -> (...)
        Every channel that it reads.
    unix_s : (...)
        Unix time, for ``days``.
    """
    with np.errstate(all="ignore"):
        found = _value(parse(formula), inputs, unix_s)
    return np.broadcast_to(np.asarray(found, dtype=np.float64), unix_s.shape).copy()


def _value(tree: ast.expr, inputs: Mapping[str, FloatArray], unix_s: FloatArray) -> Any:
    match tree:
        case ast.Constant(value=value):
            return float(value)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return inputs[name]
        case ast.BinOp(left=left, op=op, right=right):
            return _OPERATORS[type(op)](_value(left, inputs, unix_s), _value(right, inputs, unix_s))
        case ast.UnaryOp(op=op, operand=operand):
            return _OPERATORS[type(op)](_value(operand, inputs, unix_s))
        case ast.BoolOp(op=op, values=joined):
            found = _value(joined[0], inputs, unix_s)
            for part in joined[1:]:
                found = _OPERATORS[type(op)](found, _value(part, inputs, unix_s))
            return found
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            return np.asarray(
                _OPERATORS[type(op)](_value(left, inputs, unix_s), _value(right, inputs, unix_s)), dtype=np.float64
            )
        case ast.Call(func=ast.Name(id="days"), args=[ast.Constant(value=date)]):
            return (unix_s - parse_instant_ns(str(date)) / 1e9) / 86_400.0
        case ast.Call(func=ast.Name(id=name), args=args):
            return _FUNCTIONS[name][1](*(_value(arg, inputs, unix_s) for arg in args))
    raise ValueError(f"cannot use '{ast.unparse(tree)}'")
