"""Parameters that follow from others by a formula, such as ``b_rear = "b_front / 2"``."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

from calib.errors import CalibError

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide,
    ast.Pow: np.power, ast.USub: np.negative, ast.UAdd: np.positive,
}  # fmt: skip
_FUNCTIONS = ("sqrt", "exp", "log", "log10", "sin", "cos", "tan", "abs", "minimum", "maximum")


def evaluate(formula: str, known: Mapping[str, Any]) -> Any:
    """Evaluate a formula of numbers, names, ``+ - * / **`` and a few functions.

    Parameters
    ----------
    formula : str
        It is parsed, not run: nothing else than arithmetic can stand in it.
    known : mapping of str to float or ndarray
        Values by name, which broadcast.

    Raises
    ------
    CalibError
        If it is no such formula, or names what is not known.

    Examples
    --------
    >>> float(evaluate("b_front / 2 + sqrt(c)", {"b_front": 3.0, "c": 4.0}))
    3.5
    """
    with np.errstate(all="ignore"):
        return _value(_parsed(formula), known)


@cache
def _parsed(formula: str) -> ast.expr:
    try:
        return ast.parse(formula.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise _refused(f"{formula!r} cannot be read", {}) from None


def _value(node: ast.expr, known: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return np.float64(number)
        case ast.Name(id=name) if name in known:
            return known[name]
        case ast.BinOp(left, op, right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(left, known), _value(right, known))
        case ast.UnaryOp(op, operand) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(operand, known))
        case ast.Call(ast.Name(id=name), args, []) if name in _FUNCTIONS:
            if len(args) == (2 if name in ("minimum", "maximum") else 1):
                return getattr(np, name)(*(_value(argument, known) for argument in args))
    raise _refused(f"{ast.unparse(node)!r} is not known", known)


def _refused(what: str, known: Mapping[str, Any]) -> CalibError:
    return CalibError(
        what, expected=f"numbers, + - * / **, {', '.join(_FUNCTIONS)}, {', '.join(known)}",
        hint="correct the formula",
    )  # fmt: skip
