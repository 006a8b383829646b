"""Pieces of one result, worked out side by side in a few processes of this machine.

For seconds of work, of which the caller waits for every piece; many tasks whose results are to
outlive a kill are for `calib.batch.tasks.run_tasks`.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import (
    forkserver,
    get_all_start_methods,
    get_context,
    parent_process,
    resource_tracker,
)
from pathlib import Path
from threading import Thread
from typing import Protocol

from calib.batch.plugins import load_files, loaded_files
from calib.errors import CalibError

__all__ = ["HERE", "Later", "Pool", "pool"]

_LOOK_SECONDS = 2.0
_REPORT = ("calib.report.contents", "calib.report.writer")


class Later[R](Protocol):
    """A piece that was asked for."""

    def result(self) -> R:
        """Return it, or raise what went wrong with it."""


class _Here[R]:
    """A piece that is worked out when it is wanted."""

    def __init__(self, work: Callable[[], R]) -> None:
        self._work = work

    def result(self) -> R:
        return self._work()


class _There[R]:
    """A piece that another process works out."""

    def __init__(self, future: Future[R], executor: ProcessPoolExecutor) -> None:
        self._future, self._executor = future, executor

    def result(self) -> R:
        try:
            while not wait([self._future], timeout=_LOOK_SECONDS).done:
                # An executor that starts a process watches it from the next call on only: without
                # one, its death might never be seen.
                self._executor.submit(_begun)
            return self._future.result()
        except BrokenProcessPool:
            raise CalibError(
                "a process died while it worked: it was killed, or there was no memory left",
                mend="run it again, with --workers 1 if it happens again",
            ) from None


class Pool:
    """Where pieces are worked out: in other processes, or here, one after the other.

    Parameters
    ----------
    executor : ProcessPoolExecutor, optional
        Here, by default.
    """

    def __init__(self, executor: ProcessPoolExecutor | None = None) -> None:
        self._executor = executor

    @property
    def here(self) -> bool:
        """Whether pieces are worked out in this process, which can then tell its progress."""
        return self._executor is None

    def submit[**P, R](
        self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> Later[R]:
        """Ask for a piece: a call of a module's function with arguments that can be pickled.

        It takes every random number from a stream of its own, so that it does not matter where
        it is worked out.
        """
        if self._executor is None:
            return _Here(lambda: function(*args, **kwargs))
        return _There(self._executor.submit(function, *args, **kwargs), self._executor)


HERE = Pool()


@contextmanager
def pool(
    workers: int, modules: Sequence[str] = _REPORT, files: Sequence[Path] = ()
) -> Iterator[Pool]:
    """Yield a pool of some processes; of this one with a single worker.

    Parameters
    ----------
    workers : int
        A script that asks for more than one needs ``if __name__ == "__main__":``.
    modules : sequence of str, optional
        What the processes import while the caller still does: what a report needs by default.
    files : sequence of Path, optional
        Python files of the user's own that they run besides those that are loaded here.
    """
    if workers < 2:
        yield HERE
        return
    # Forked from a process that has imported what the work needs, and has no threads.
    forked = "forkserver" in get_all_start_methods()
    context = get_context("forkserver" if forked else "spawn")
    if forked:
        context.set_forkserver_preload(list(modules))
    # Handed over: a server that forks keeps the environment it was started with.
    executor = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin, initargs=([*loaded_files(), *files],)
    )
    # A first process starts now, not when there is work for it; it starts where it can wait.
    Thread(target=_start, args=(executor,), daemon=True).start()
    try:
        yield Pool(executor)
    except BaseException:
        _stop(executor)  # nobody waits for the pieces
        raise
    finally:
        executor.shutdown(wait=False, cancel_futures=True)


def _start(executor: ProcessPoolExecutor) -> None:
    """Start the server and a first process where an interruption does not reach them.

    It is for the process that waits for the pieces; they would end with tracebacks.
    """
    if hasattr(signal, "pthread_sigmask"):
        # Started before: what starts it lets interruptions through again.
        resource_tracker.ensure_running()
        # Of this thread alone, and inherited by what it starts.
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    with suppress(EOFError, OSError, RuntimeError):  # stopped meanwhile
        executor.submit(_begun)


def _stop(executor: ProcessPoolExecutor) -> None:
    """End processes at once, and the server that may just be importing what they need."""
    server = getattr(forkserver._forkserver, "_forkserver_pid", None)
    if server is not None:
        os.kill(server, signal.SIGTERM)
    for process in list((executor._processes or {}).values()):
        process.terminate()


def _begin(files: Sequence[Path]) -> None:
    """Leave an interruption to the process that waits for the pieces; know what it knows."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_leave_with_parent, daemon=True).start()
    load_files(files)


def _leave_with_parent() -> None:
    """End when the process that waits for the pieces does, however it ends."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _begun() -> None:
    """Do nothing, in a process that has begun."""
