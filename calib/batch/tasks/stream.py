"""Tasks as they come to their end, in this process or on a cluster: result or error, and time."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from calib.errors import CalibError


@dataclass(frozen=True)
class Finished[R]:
    """A task that came to its end, with its result or why it failed, and how long it took."""

    name: str
    result: R | None
    error: str | None
    seconds: float


def attempt[I, R](function: Callable[[I], R], name: str, item: Callable[[], I]) -> Finished[R]:
    """Run a task on what `item` returns, and keep whatever goes wrong with it."""
    began = time.perf_counter()
    try:
        result = function(item())
    # A library that calls sys.exit ends its own task only.
    except (Exception, SystemExit) as error:
        return Finished(name, None, describe(error), time.perf_counter() - began)
    return Finished(name, result, None, time.perf_counter() - began)


def describe(error: BaseException) -> str:
    """Return an error as a reader needs it: what can be mended, or what broke and where."""
    if isinstance(error, CalibError):
        return str(error)
    text = "".join(traceback.format_exception_only(error)).strip()
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return text
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})"


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
        return name in self._sources  # without reading the item


def completed[I, R](
    function: Callable[[I], R],
    items: Mapping[str, I],
    *,
    names: Collection[str] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    announce: Callable[[str], None] | None = None,
) -> Generator[Finished[R]]:
    """Yield tasks as they come to their end, in any order.

    The parameters are those of `calib.batch.tasks.run_tasks`, and `names`, the tasks to do, in this
    order. An item is asked for when its task is sent off, so the mapping may read it only then;
    where that raises, the task has failed.

    What a task returns must not depend on where it is done: it takes every random number from a
    stream of its own (`calib.inference.random`). A task whose worker dies is done again elsewhere;
    one that takes its worker down every time fails.

    Raises
    ------
    CalibError
        If there is no such cluster, or it is lost.
    """
    if workers < 1:
        raise CalibError(f"{workers} workers were asked for", allowed="1 or more")
    todo = list(items if names is None else names)
    if not todo:
        return
    if scheduler is None and workers == 1:
        for name in todo:
            yield attempt(function, name, lambda name=name: items[name])  # type: ignore[misc]
        return
    # Dask takes a second to import: only where it is used.
    from calib.batch.tasks.cluster import on_cluster

    yield from on_cluster(
        function, items, todo, workers=workers, scheduler=scheduler,
        announce=announce or (lambda line: None),
    )  # fmt: skip
