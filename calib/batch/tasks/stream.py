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

    Parameters
    ----------
    function : callable
        Of a module, so that another process can import it; called with one item.
    items : mapping of str to object
        What each task works on, picklable. An item is asked for when its task is sent off, so the
        mapping may read it only then; where that raises, the task has failed.
    names : collection of str, optional
        The tasks to do, in this order; all items by default.
    workers : int
        Processes on this machine; with 1 the tasks are done here, one after the other.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://host:8786``, in the place of `workers`.
    announce : callable, optional
        Called with one line that says where the tasks are done.

    Raises
    ------
    CalibError
        If there is no such cluster, or it is lost.

    Notes
    -----
    What a task returns must not depend on where it is done: it takes every random number from a
    stream of its own (`calib.inference.random`). A task whose worker dies is done again elsewhere;
    one that takes its worker down every time fails.
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
