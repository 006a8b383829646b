"""What is known by name: quantities, models, effects; shipped ones, and those a user adds."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any

from calib.batch.user_code import PLUGINS, declared_in, fingerprint, load_installed
from calib.errors import CalibError


def run_again(known: Sequence[FunctionType], new: Sequence[FunctionType]) -> bool:
    """Whether functions of a user's own are others of the same code, run again.

    In a notebook what was declared may be declared anew; in a file only where all of it is run
    again, for there one name may have been given to two things.
    """
    places = [[(declared_in(f), f.__qualname__) for f in functions] for functions in (known, new)]
    if not new or places[0] != places[1]:
        return False
    return _interactive() or all(
        a.__globals__ is not b.__globals__ for a, b in zip(known, new, strict=True)
    )


def _functions(declared: object) -> list[FunctionType]:
    found = vars(declared).values()
    return [v for v in found if isinstance(v, FunctionType) and declared_in(v)]


def _says_the_same(known: object, new: object) -> bool:
    """Whether two declarations are equal, their functions by what they do."""
    if not (_functions(new) or _interactive()):
        return False
    # What a model is evaluated by holds the model itself.
    told = [
        [type(d), {k: v for k, v in vars(d).items() if getattr(v, "model", None) is not d}]
        for d in (known, new)
    ]
    try:
        return fingerprint(told[0]) == fingerprint(told[1])
    except ValueError:
        return False


def _interactive() -> bool:
    # In a notebook, or where Python reads what is typed, the program is no file.
    return not Path(getattr(sys.modules["__main__"], "__file__", "")).is_file()


class Registry[T](Mapping[str, T]):
    """Declarations by name, in the order in which they came.

    Parameters
    ----------
    what : str
        What they are, for messages.
    key : callable
        Returns the name of one.
    *declared
        Those that are shipped.
    group : str, optional
        Entry points of installed packages that are loaded before any is looked up.
    """

    def __init__(
        self, what: str, key: Callable[[T], str], *declared: T, group: str = PLUGINS
    ) -> None:
        self._what, self._key, self._group = what, key, group
        self._known: dict[str, T] = {}
        for one in declared:
            self.add(one)

    def add(self, *declared: T) -> None:
        """Add declarations, all or none; a CalibError if another one has the name of one.

        One that says the same as before is not added again. Where the code that declared it is run
        again, as a cell of a notebook is, the new one takes its place.
        """
        new: dict[str, T] = {}
        for one in declared:
            name = self._key(one)
            known = self._known.get(name, new.get(name))
            if known is None or run_again(_functions(known), _functions(one)):
                new[name] = one
            elif known is not one and not _says_the_same(known, one):
                raise CalibError(
                    f"there is a {self._what} {name!r} already",
                    expected=f"a name other than {', '.join(self._known)}",
                    hint=f"give the new {self._what} another name; if it is to take the place of "
                    "the other, start Python again",
                )
        self._known |= new

    def discard(self, name: str) -> None:
        """Forget a declaration, if there is one of this name."""
        self._known.pop(name, None)

    @contextmanager
    def standing_in(self, *declared: T) -> Iterator[None]:
        """Let declarations take the places of those of their names within a block."""
        known, self._known = self._known, {**self._all(), **{self._key(d): d for d in declared}}
        try:
            yield
        finally:
            self._known = known

    def _all(self) -> dict[str, T]:
        load_installed(self._group)
        return self._known

    def __getitem__(self, name: str) -> T:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


def register(*declared: Any) -> None:
    """Make quantities, models or effects known by their names.

    Raises
    ------
    CalibError
        If one is not what it must be, or something else has its name.

    Examples
    --------
    >>> import calib
    >>> from calib.data.quantities import Range
    >>> belly = calib.Quantity(
    ...     "belly_clearance_mm", "condition", "length", Range(0.0), word="belly clearance"
    ... )  # doctest: +SKIP
    >>> calib.register(belly)  # doctest: +SKIP
    """
    for one in declared:
        if not hasattr(one, "register"):
            raise CalibError(
                f"{one!r} cannot be registered",
                expected="a Quantity, a Model or an Effect",
                hint="make one of these of it",
            )
        one.register()
