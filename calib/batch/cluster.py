"""Tasks on a Dask cluster: processes on this machine, or a scheduler that is there already."""

from __future__ import annotations

import logging
import pickle
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, WorkerPlugin, as_completed
from distributed.scheduler import KilledWorker
from distributed.utils import silence_logging_cmgr

from calib.batch.constants import CLOSE_SECONDS, CONNECT_SECONDS, WINDOW
from calib.batch.environment import code_sha256
from calib.batch.pool import interruptions_held
from calib.batch.tasks import Finished, attempt, describe
from calib.batch.user_code import Loader, load, loaded
from calib.errors import CalibError


def on_cluster[I, R](
    function: Callable[[I], R],
    item: Callable[[str], I],
    names: Sequence[str],
    *,
    workers: int,
    scheduler: str | None,
    announce: Callable[[str], None],
) -> Iterator[Finished[R]]:
    """Yield tasks as they come to their end (see `calib.batch.tasks.completed`)."""
    # A cluster of our own need not be larger than the work.
    connected = _local(min(workers, len(names))) if scheduler is None else _existing(scheduler)
    settings = {
        # When the worker of a task dies, the task is tried once more among the others.
        "distributed.scheduler.allowed-failures": 1,
        # Dask has the C library return every freed array at once, which doubles the time of ours.
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
        # Items are sent with their tasks on purpose: the workers have no other way to them.
        "distributed.admin.large-graph-warning-threshold": "1 TB",
    }
    # What goes wrong is reported once, as the error of a task or as ours.
    with (
        silence_logging_cmgr(logging.CRITICAL),
        dask.config.set(settings),
        connected as client,
    ):
        announce(_describe(client, local=scheduler is None))
        killed: list[str] = []
        yield from _gather(client, function, item, names, WINDOW, killed)
        # Whatever waited at the same worker died with the culprit: on its own, only the culprit
        # will.
        guilty: list[str] = []
        yield from _gather(client, function, item, killed, 1, guilty)
        for name in guilty:
            yield Finished(
                name,
                None,
                "the process that ran this task died, each time it was tried and on its own too: "
                "it crashes, or needs more memory than a worker has",
                0.0,
            )


def _gather[I, R](
    client: Client,
    function: Callable[[I], R],
    item: Callable[[str], I],
    names: Sequence[str],
    window: int,
    killed: list[str],
) -> Iterator[Finished[R]]:
    """Yield tasks as they come, with at most a window of them sent; note those that were killed."""
    coming = as_completed(loop=client.loop, with_results=True, raise_errors=False)
    waiting, sent = iter(names), dict[str, str]()
    prefix = f"calib-{uuid.uuid4().hex}"  # one for all: the scheduler then sends few at once
    while True:
        while len(sent) < window and (name := next(waiting, None)) is not None:
            # Sealed, so that Dask does not search the item for tasks of its own.
            sealed = attempt(pickle.dumps, name, partial(item, name))
            if sealed.result is None:
                yield Finished(name, None, sealed.error, sealed.seconds)
                continue
            with _connection():
                future = client.submit(
                    _call, function, name, sealed.result, key=f"{prefix}-{name}", pure=False
                )
            sent[str(future.key)] = name
            coming.add(future)
        if not sent:
            return
        # Judged by what came, not by the future's status: the worker that held a result may have
        # died since, and the scheduler have begun the task anew.
        for future, result in coming.next_batch():
            name = sent.pop(str(future.key))
            if isinstance(result, Finished):
                yield result
            elif isinstance(result, CancelledError):
                raise _lost()
            elif isinstance(result[1], KilledWorker):
                killed.append(name)
            else:
                yield Finished(name, None, describe(result[1]), 0.0)


def _call[I, R](function: Callable[[I], R], name: str, sealed: bytes) -> Finished[R]:
    return attempt(function, name, partial(pickle.loads, sealed))


@contextmanager
def _local(workers: int) -> Iterator[Client]:
    """Start processes of one thread each, which a nanny replaces if they die, and end them.

    Dask gives them one thread of the linear algebra each. They end with this process, however it
    ends.
    """
    with ExitStack() as stack:
        try:
            with interruptions_held():
                cluster = LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=1.0 / workers,
                    dashboard_address="127.0.0.1:0",  # any free port: the usual one may be taken
                    silence_logs=logging.CRITICAL,
                )
                stack.enter_context(_ended(cluster))
        except RuntimeError as error:
            raise CalibError(
                f"the worker processes do not start ({error})",
                hint='in a script of yours, put the call below `if __name__ == "__main__":`',
            ) from error
        client = stack.enter_context(Client(cluster, set_as_default=False))
        if files := loaded():
            client.register_plugin(_UserFiles(files))
        yield client
        # A worker that died is being replaced: Dask cannot close its nanny meanwhile.
        with suppress(TimeoutError):
            client.wait_for_workers(workers, timeout=CLOSE_SECONDS)


@contextmanager
def _ended(cluster: LocalCluster) -> Iterator[None]:
    """End the workers after the block; kill them after an error or an interruption.

    Asked to stop, a worker that is at its work takes seconds, and keeps nothing.
    """
    try:
        yield
    except BaseException:
        for nanny in cluster.workers.values():
            nanny.close_gracefully()  # it starts no other
        for process in active_children():
            if process.name.startswith("Dask Worker"):
                process.kill()
        raise
    finally:
        # Results are here by now, and a process that Dask fails to end will end with this one.
        with suppress(AssertionError, TimeoutError):
            cluster.close(timeout=CLOSE_SECONDS)


class _UserFiles(WorkerPlugin):
    """Has every worker load the files of the user's own that this process has loaded."""

    def __init__(self, files: Mapping[Path, Loader]) -> None:
        self.files = files

    def setup(self, worker: object) -> None:
        """Load them, as Dask calls it in a worker that starts."""
        load(self.files)


class _Client(Client):
    """A client that is closed if it cannot connect, not at some later time by its finaliser."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        try:
            super().__init__(*args, **kwargs)  # type: ignore[no-untyped-call]
        except BaseException:
            self.close()  # type: ignore[no-untyped-call]
            raise


@contextmanager
def _existing(address: str) -> Iterator[Client]:
    """Connect to a scheduler, and check that its workers would give the same numbers."""
    try:
        client = _Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise CalibError(
            f"there is no Dask scheduler at this address ({type(error).__name__}: {error})",
            where=address,
            expected="tcp://HOST:PORT of a running `dask scheduler`",
            hint="start one, or leave --scheduler out to work on this machine",
        ) from None
    with client:
        ours = versions()
        with _connection():
            theirs: dict[str, Any] = client.run(versions, on_error="return")
        for worker, found in theirs.items():
            if isinstance(found, BaseException):
                why = f"calib cannot be imported there ({describe(found)})"
            else:
                differ = [
                    f"{k} {found.get(k)} and not {v}" for k, v in ours.items() if found.get(k) != v
                ]
                if not differ:
                    continue
                why = f"it has {', '.join(differ)}"
            raise CalibError(
                f"a worker would not give the same numbers: {why}",
                where=worker,
                expected="workers with the calib and the libraries of this process",
                hint="install the same versions there (constraints.txt lists them)",
            )
        yield client


def versions() -> dict[str, str]:
    """Return what numbers depend on: versions of libraries, a hash of our own source and priors."""
    own = {"calib source": code_sha256()[:12]}
    return {name: version(name) for name in ("numpy", "scipy", "emcee")} | own


@contextmanager
def _connection() -> Iterator[None]:
    try:
        yield
    except OSError:  # Dask's errors of communication are of this kind
        raise _lost() from None


def _lost() -> CalibError:
    return CalibError(
        "the connection to the Dask scheduler was lost",
        hint="start again when it is back: what has been done is kept",
    )


def _describe(client: Client, *, local: bool) -> str:
    address = client.scheduler.address  # type: ignore[union-attr]
    count = len(client.scheduler_info(n_workers=-1)["workers"])
    where = f"{count} worker{'s' * (count != 1)} {'here' if local else 'there now'}"
    if local and find_spec("bokeh") is None:
        return f"Dask scheduler {address}, {where}; no dashboard (it needs bokeh)"
    return f"Dask scheduler {address}, {where}; dashboard {client.dashboard_link}"
