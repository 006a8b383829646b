"""The one exception a user sees: what was found, where, what is expected, how to fix it."""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# What reading somebody else's file may raise.
FAULTS = (AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError)


class CalibError(Exception):
    """Raised for every problem the user can fix.

    Parameters
    ----------
    message : str
        What was found.
    where : str, optional
        File, row, column or parameter at which it was found.
    expected : str, optional
        What would have been accepted there.
    hint : str, optional
        What to do about it.

    Attributes
    ----------
    each : tuple of CalibError
        The problems it stands for, where there are several.
    """

    each: tuple[CalibError, ...] = ()

    def __init__(
        self,
        message: str,
        *,
        where: str | None = None,
        expected: str | None = None,
        hint: str | None = None,
    ) -> None:
        self.message = message
        self.where = where
        self.expected = expected
        self.hint = hint
        super().__init__(str(self))

    def __str__(self) -> str:
        lines = [f"{self.where}: {self.message}" if self.where else self.message]
        if self.expected:
            lines.append(f"  expected: {self.expected}")
        if self.hint:
            lines.append(f"  hint: {self.hint}")
        return "\n".join(lines)

    def within(self, *places: str | None) -> CalibError:
        """Return the error with what it was found in named before where it was found."""
        where = ", ".join(filter(None, (*places, self.where)))
        return CalibError(self.message, where=where, expected=self.expected, hint=self.hint)

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword-only arguments do not survive the default pickling between worker processes.
        return (_rebuild, (self.message, self.where, self.expected, self.hint))


def several(faults: Sequence[CalibError]) -> CalibError:
    """Return an error that stands for others, and shows the first of them."""
    if len(faults) == 1:
        return faults[0]
    more = f"\n  and {len(faults) - 5} more" if len(faults) > 5 else ""
    lines = "".join(f"\n  {str(fault).splitlines()[0]}" for fault in faults[:5])
    error = CalibError(f"{len(faults)} problems{lines}{more}")
    error.each = tuple(faults)
    return error


def meant(name: str, known: Iterable[str], otherwise: str = "correct the name") -> str:
    """Suggest known names that contain a name, or else the most similar one.

    Parameters
    ----------
    name : str
        What was given.
    known : iterable of str
        What there is.
    otherwise : str
        What is said if none is like it.
    """
    known = list(known)
    # Of a few letters it would be chance that another name holds them.
    near = [one for one in known if len(name) > 3 and name in one][:3]
    near = near or difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {' or '.join(near)}?" if near else otherwise


def in_words(error: Mapping[str, Any]) -> str:
    """Say what pydantic, one of whose `errors` this is, found wrong in a file."""
    kind, said = error["type"], error["msg"]
    key = error["loc"][-1] if error["loc"] else "it"
    if kind == "missing":
        return f"{key} is missing"
    if kind.endswith("too_short"):
        return f"{key} is empty"
    if kind == "string_pattern_mismatch":
        said = "Input should be a name: a letter, then letters, digits and _"
        if "0-9a-f" in error["ctx"]["pattern"]:
            said = "Input should be a SHA-256: 64 digits, 0 to 9 and a to f"
    should = said.removeprefix("Input should be ")
    if should == said:
        return f"{said.removeprefix('Value error, ')} (found {reprlib.repr(error['input'])})"
    if should.startswith("a valid"):
        should = re.split(", | or ", should)[0]
        words = {"dictionary": "table", "string": "text", "integer": "whole number", "valid ": ""}
        for its, plain in {**words, "a boolean": "true or false"}.items():
            should = should.replace(its, plain)
    return f"{key} = {reprlib.repr(error['input'])} is not {should}"


def _rebuild(message: str, where: str | None, expected: str | None, hint: str | None) -> CalibError:
    return CalibError(message, where=where, expected=expected, hint=hint)
