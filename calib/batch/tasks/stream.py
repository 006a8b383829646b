"""Results of tasks as they come, from this process or from a cluster."""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Mapping

from calib.batch.tasks.attempt import Finished, attempt
from calib.errors import CalibError


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
