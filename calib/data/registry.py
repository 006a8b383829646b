"""What is known by name: quantities, models, effects; shipped ones, and those a user adds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

from calib.batch.plugins import PLUGINS, load_installed
from calib.errors import CalibError


class _Declared(Protocol):
    def register(self) -> None: ...


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

    Attributes
    ----------
    version : int
        Another one whenever what is known has changed.
    """

    def __init__(
        self, what: str, key: Callable[[T], str], *declared: T, group: str = PLUGINS
    ) -> None:
        self._what, self._key, self._group = what, key, group
        self._known: dict[str, T] = {}
        self.version = 0
        for one in declared:
            self.add(one)

    def add(self, declared: T) -> None:
        """Add a declaration; a CalibError if another one has its name."""
        name = self._key(declared)
        self.version += 1
        if self._known.setdefault(name, declared) is not declared:
            raise CalibError(
                f"there is a {self._what} {name!r} already",
                allowed=f"a name other than {', '.join(self._known)}",
                mend=f"give the new {self._what} another name",
            )

    def discard(self, name: str) -> None:
        """Forget a declaration, if there is one of this name."""
        self.version += 1
        self._known.pop(name, None)

    def _all(self) -> dict[str, T]:
        load_installed(self._group)
        return self._known

    def __getitem__(self, name: str) -> T:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


def register(*declared: _Declared) -> None:
    """Make quantities, models or effects known by their names.

    Parameters
    ----------
    *declared : Quantity, Model or Effect

    Raises
    ------
    CalibError
        If one is not what it must be, or something else has its name.
    """
    for one in declared:
        if not hasattr(one, "register"):
            raise CalibError(
                f"{one!r} cannot be registered",
                allowed="a Quantity, a Model or an Effect",
                mend="make one of these of it",
            )
        one.register()
