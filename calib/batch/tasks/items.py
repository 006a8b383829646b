"""Items that are read when their task is sent off, not all before the first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping


class LateItems[S, I](Mapping[str, I]):
    """A mapping whose values are read anew from their sources each time they are asked for.

    What `read` raises is the error of that task alone.
    """

    def __init__(self, sources: Mapping[str, S], read: Callable[[S], I]) -> None:
        self._sources = sources
        self._read = read

    def __getitem__(self, name: str) -> I:
        return self._read(self._sources[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._sources)

    def __len__(self) -> int:
        return len(self._sources)

    def __contains__(self, name: object) -> bool:
        return name in self._sources
