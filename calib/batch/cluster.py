"""Tasks on a Dask cluster: processes on this machine, or a scheduler that is there already."""

from __future__ import annotations

import logging
import os
import pickle
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager, suppress
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import active_children
from typing import Any

import dask
from distributed import Client, LocalCluster, as_completed
from distributed.scheduler import KilledWorker
from distributed.utils import silence_logging_cmgr

from calib.batch.environment import code_sha256
from calib.batch.pool import without_interruptions
from calib.batch.tasks import Finished, attempt, describe
from calib.errors import CalibError

# Tasks at the scheduler at a time, and bytes of their items: enough for a large cluster, few enough
# for a small memory. They are sent in batches, so that the first are at work while others are read.
WINDOW, BYTES, BATCH = 5000, 400_000_000, 200
# Items are sent with their tasks, on purpose: the workers have no other way to them.
_NO_WARNING = {"distributed.admin.large-graph-warning-threshold": "1 TB"}
_ENVIRONMENT, _TRIM = "distributed.nanny.pre-spawn-environ", "MALLOC_TRIM_THRESHOLD_"
_LOCAL = {
    # When the worker of a task dies, the task is tried so many times more among the others.
    "distributed.scheduler.allowed-failures": 1,
    # Dask has the C library give every freed array back to the system at once, and take it again
    # with a page fault for each 4 KiB: of two workers' time a half. Ours are short-lived and keep
    # theirs.
    f"{_ENVIRONMENT}.{_TRIM}": None,
    # Looking what a task is at, and whether the event loop is awake, takes the interpreter from it
    # a hundred and fifty times a second: of two workers' time a twelfth.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
}
# A nanny replaces a worker that dies, but for one that dies before it is up.
START_TRIES = 2
CONNECT_SECONDS = 10
SETTLE_SECONDS, CLOSE_SECONDS = 20, 20
_LOOK_SECONDS = 0.02
_SAME = ("numpy", "scipy", "emcee")


def on_cluster[I, R](
    function: Callable[[I], R],
    items: Mapping[str, I],
    names: Sequence[str],
    *,
    workers: int,
    scheduler: str | None,
    announce: Callable[[str], None],
) -> Iterator[Finished[R]]:
    """Yield tasks as they come to their end (see `calib.batch.tasks.completed`)."""
    # A cluster of our own need not be larger than the work.
    connected = _local(min(workers, len(names))) if scheduler is None else _existing(scheduler)
    # What goes wrong is told once, as the error of a task or as ours.
    with silence_logging_cmgr(logging.CRITICAL), connected as client:
        announce(_describe(client, local=scheduler is None))
        killed: list[str] = []
        yield from _gather(client, function, items, names, WINDOW, killed)
        # Whatever waited at the same worker died with the culprit: on their own, only it will.
        guilty: list[str] = []
        yield from _gather(client, function, items, killed, 1, guilty)
        for name in guilty:
            yield Finished(
                name, None,
                "the process that ran this task died, each time it was tried and on its own too: "
                "it crashes, or needs more memory than a worker has", 0.0,
            )  # fmt: skip


def _gather[I, R](
    client: Client,
    function: Callable[[I], R],
    items: Mapping[str, I],
    names: Sequence[str],
    window: int,
    killed: list[str],
) -> Iterator[Finished[R]]:
    """Yield tasks as they come, no more than a window of them sent; note those that were killed."""
    sent = _Sent(client, partial(_call, function), window)
    waiting = iter(names)
    while True:
        yield from sent.fill(items, waiting)
        if not len(sent):
            return
        # By what came, not by the future's status: the worker that held a result may have died
        # since, and the scheduler have begun the task anew.
        for name, result in sent.come():
            if isinstance(result, Finished):
                yield result
            elif isinstance(result, CancelledError):
                raise _lost()
            elif isinstance(result[1], KilledWorker):
                killed.append(name)
            else:
                yield Finished(name, None, describe(result[1]), 0.0)


class _Sent:
    """The tasks that the scheduler has, a window of them; `call` takes a name and a sealed item."""

    def __init__(
        self, client: Client, call: Callable[[str, bytes], Finished[Any]], window: int
    ) -> None:
        self._client, self._call, self._window = client, call, window
        self._coming = as_completed(loop=client.loop, with_results=True, raise_errors=False)
        # One prefix for all: the scheduler keeps a queue of them, and workers get few at once.
        self._prefix = f"calib-{uuid.uuid4().hex}"
        self._number = 0
        self._out: dict[str, tuple[str, int]] = {}
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._out)

    def fill[I](self, items: Mapping[str, I], waiting: Iterator[str]) -> Iterator[Finished[Any]]:
        """Send tasks off until there is no room for more; yield those whose item cannot be had."""
        # Not one by one: many cost the scheduler little more than one.
        if len(self) > self._window // 2 or self._bytes > BYTES // 2:
            return
        sealed: dict[str, bytes] = {}
        size = 0
        for name in waiting:
            item = attempt(_seal, name, lambda name=name: items[name])  # type: ignore[misc]
            if item.result is None:
                yield Finished(name, None, item.error, item.seconds)
                continue
            sealed[name] = item.result
            size += len(item.result)
            full = len(self) + len(sealed) >= self._window or self._bytes + size >= BYTES
            if full or len(sealed) >= BATCH:
                self._send(sealed)
                sealed, size = {}, 0
            if full:
                return
        if sealed:
            self._send(sealed)

    def _send(self, sealed: Mapping[str, bytes]) -> None:
        keys = [f"{self._prefix}-{self._number + i}" for i in range(len(sealed))]
        with _connection(), dask.config.set(_NO_WARNING):
            futures = self._client.map(
                self._call, list(sealed), list(sealed.values()), key=keys, pure=False
            )
        self._coming.update(futures)
        self._number += len(keys)
        for key, (name, item) in zip(keys, sealed.items(), strict=True):
            self._out[key] = name, len(item)
            self._bytes += len(item)

    def come(self) -> Iterator[tuple[str, Any]]:
        """Wait for tasks to come to their end; yield name and result of each.

        The result is what the task returned, type, error and traceback of what befell it, or a
        `CancelledError` if the scheduler was lost.
        """
        for future, result in self._coming.next_batch():
            name, size = self._out.pop(future.key)
            self._bytes -= size
            yield name, result


def _seal(item: object) -> bytes:
    """Pickle an item, so that Dask does not search it for tasks of its own."""
    return pickle.dumps(item)


def _call[I, R](function: Callable[[I], R], name: str, sealed: bytes) -> Finished[R]:
    return attempt(function, name, lambda: pickle.loads(sealed))


@contextmanager
def _local(workers: int) -> Iterator[Client]:
    """Start worker processes, spawned and of one thread each, which a nanny replaces if they die.

    Dask gives them one thread of the linear algebra each. They end with this process, however it
    ends.
    """
    with _own_environment(), dask.config.set(_LOCAL):
        cluster = _start(workers)
        try:
            with Client(cluster, set_as_default=False) as client, _left_at_once(cluster):
                yield client
                # A worker that died is being replaced: Dask cannot close its nanny meanwhile.
                with suppress(TimeoutError):
                    client.wait_for_workers(workers, timeout=SETTLE_SECONDS)
        finally:
            # Results are here by now; a process that Dask fails to end (one that Ctrl-C met as it
            # started, say) ends with this one.
            with suppress(AssertionError, TimeoutError):
                cluster.close(timeout=CLOSE_SECONDS)


def _start(workers: int, tries: int = START_TRIES) -> LocalCluster:
    """Start a scheduler here and its workers, once more if one of them died as it started."""
    # Where no interruption reaches it, which would leave half a cluster.
    with ThreadPoolExecutor(1, initializer=without_interruptions) as apart:
        coming = apart.submit(
            LocalCluster,
            n_workers=workers, threads_per_worker=1, processes=True, memory_limit=1.0 / workers,
            dashboard_address="127.0.0.1:0",  # any free port: the usual one may be taken
            silence_logs=logging.CRITICAL, preload=["calib.batch.plugins"],
        )  # fmt: skip
        try:
            return coming.result()
        except RuntimeError as error:
            if tries > 1:
                return _start(workers, tries - 1)
            raise CalibError(
                f"the worker processes do not start ({error})",
                hint='in a script of yours, put the call below `if __name__ == "__main__":`',
            ) from error
        except KeyboardInterrupt:
            # Without its workers it fails to start, and closes itself.
            while not wait([coming], _LOOK_SECONDS).done:
                _kill_workers()
            if coming.exception() is None:
                with closing(coming.result()) as cluster, _left_at_once(cluster):
                    raise
            raise


@contextmanager
def _left_at_once(cluster: LocalCluster) -> Iterator[None]:
    """Kill the workers if what they are at is not wanted any more.

    Asked to stop, one that is at work or still starting takes seconds, and keeps nothing.
    """
    try:
        yield
    except BaseException:
        for nanny in cluster.workers.values():
            nanny.close_gracefully()  # it starts no other
        _kill_workers()
        raise


def _kill_workers() -> None:
    for process in active_children():
        if process.name.startswith("Dask Worker"):
            process.kill()


@contextmanager
def _own_environment() -> Iterator[None]:
    """Take out what another cluster of Dask's has left in this process's environment."""
    left = os.environ.get(_TRIM)
    if left != str(dask.config.get(_ENVIRONMENT).get(_TRIM)):
        yield
        return
    del os.environ[_TRIM]
    try:
        yield
    finally:
        os.environ[_TRIM] = left


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
                raise _unlike(worker, f"calib cannot be imported there ({describe(found)})")
            differ = [
                f"{k} {found.get(k)} and not {v}" for k, v in ours.items() if found.get(k) != v
            ]
            if differ:
                raise _unlike(worker, f"it has {', '.join(differ)}")
        yield client


def versions() -> dict[str, str]:
    """Return what numbers depend on: versions of libraries, a hash of our own source and priors."""
    return {**{name: version(name) for name in _SAME}, "calib source": code_sha256()[:12]}


def _unlike(worker: str, why: str) -> CalibError:
    return CalibError(
        f"a worker would not give the same numbers: {why}",
        where=worker,
        expected="workers with the calib and the libraries of this process",
        hint="install the same versions there (constraints.txt lists them)",
    )


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
    dashboard = client.dashboard_link
    if local and find_spec("bokeh") is None:
        return f"Dask scheduler {address}, {where}; no dashboard (it needs bokeh)"
    return f"Dask scheduler {address}, {where}; dashboard {dashboard}"
