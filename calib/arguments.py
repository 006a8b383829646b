"""Refuse arguments of another kind where people call, before they end as an error far inside."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from numbers import Integral
from os import PathLike
from typing import Any

from calib.errors import CalibError

_WORDS = {"Integral": "a whole number from 0 on", "PathLike": "a path", "str": "text"}
_WORDS |= {
    "Mapping": "a dictionary",
    "Real": "a number",
    "Sequence": "a list",
    "ndarray": "an array",
}
_MADE_BY = {
    "Problem": "calib.build_problem(model, table) returns one",
    "Calibration": "calib.calibrate(problem, seed=1) returns one",
    "Validation": "calib.validate_held_out(calibration, held_out) returns one",
    "Case": "calib.read_case(folder) returns one",
    "SamplerSettings": "for example calib.SamplerSettings(max_steps=12800)",
}


def takes[**P, R](**kinds: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Declare of what types some arguments of a function are: one, or a tuple of several.

    None is taken where it is the default. Where a path goes, text does; whole numbers are seeds and
    counts, so not negative. Anything else raises a CalibError.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            # Too many or misspelt arguments are for Python to refuse.
            given = signature.bind(*args, **kwargs).arguments
            for name, kind in kinds.items():
                if name in given and given[name] is not signature.parameters[name].default:
                    _check(function.__name__, name, given[name], kind)
            return function(*args, **kwargs)

        return checked

    return decorate


def _check(function: str, name: str, value: object, kind: Any) -> None:
    kinds = kind if isinstance(kind, tuple) else (kind,)
    taken = (*kinds, str) if PathLike in kinds else kinds
    negative = isinstance(value, Integral) and int(value) < 0
    letters = isinstance(value, str) and str not in taken  # a sequence, but no list of values
    if isinstance(value, taken) and not (
        letters or (Integral in kinds and (isinstance(value, bool) or negative))
    ):
        return
    plain = isinstance(value, int | float | str)
    names = [k.__name__ for k in kinds]
    hints = [_MADE_BY[n] for n in names if n in _MADE_BY]
    raise CalibError(
        f"{name} = {value!r}" if plain else f"{name} is of the type {type(value).__name__}",
        where=f"calib.{function}",
        expected=" or ".join(_WORDS.get(n, f"calib.{n}") for n in names),
        hint="; ".join(hints) or f"correct {name}",
    )
