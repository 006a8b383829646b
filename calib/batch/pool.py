"""Pieces of one result, worked out side by side in a few processes of this machine.

For seconds of work, of which the caller waits for every piece; many tasks whose results are to
outlive a kill are for `calib.batch.tasks.run_tasks`.
"""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import (
    forkserver,
    get_all_start_methods,
    get_context,
    parent_process,
    resource_tracker,
)
from multiprocessing.context import BaseContext
from pathlib import Path
from threading import Lock, Thread
from typing import Any, Protocol

from calib.batch import foreign
from calib.batch.plugins import load_files, loaded_files
from calib.errors import CalibError

_LOOK_SECONDS = 2.0
# Processes that are started before there is work for them.
_AT_FIRST = 2
_SAFE = "PYTHONSAFEPATH"
_SERVING = Lock()
# What a report needs, and what its figures and files import when they are first made.
_REPORT = (
    "calib.report.sections", "calib.report.writer", "calib.report.figures.collect",
    "calib.gap.diagnose", "calib.inference.sampling.sampler", "calib.inference.diagnostics",
    "scipy.fft", "h5netcdf", "PIL.Image",
)  # fmt: skip


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
    """A piece that another process works out, or this one while there is no other."""

    def __init__(self, work: Callable[[], R], executor: ProcessPoolExecutor) -> None:
        self._work, self._executor = work, executor
        self._place: Future[Future[R]] = Future()

    def send(self) -> None:
        """Hand it over to the processes."""
        try:
            self._place.set_result(self._executor.submit(self._work))
        except Exception as error:  # for the one who waits for it
            self._place.set_exception(error)

    def work(self) -> None:
        """Work it out in this process."""
        done: Future[R] = Future()
        try:
            done.set_result(self._work())
        except Exception as error:  # for the one who waits for it
            done.set_exception(error)
        self._place.set_result(done)

    def result(self) -> R:
        try:
            future = self._place.result()
            while not wait([future], timeout=_LOOK_SECONDS).done:
                # An executor that starts a process watches it from the next call on only: without
                # one, its death might never be seen.
                self._executor.submit(_begun)
            return future.result()
        except BrokenProcessPool:
            raise CalibError(
                "a process died while it worked: it was killed, or there was no memory left",
                hint="run it again, with --workers 1 if it happens again",
            ) from None


class Pool:
    """Where pieces are worked out: in other processes, or here, one after the other.

    Parameters
    ----------
    executor : ProcessPoolExecutor, optional
        Here, by default. Until it is said to have `begun`, pieces wait, and may be worked out here.
    """

    def __init__(self, executor: ProcessPoolExecutor | None = None) -> None:
        self._executor = executor
        self._lock = Lock()
        self._waiting: list[_There[Any]] = []
        self._has_begun = False

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
        return self._ask(partial(function, *args, **kwargs))

    def submit_long[**P, R](
        self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> Later[R]:
        """Ask for a piece that takes longer than others: before those that still wait."""
        return self._ask(partial(function, *args, **kwargs), first=True)

    def _ask[R](self, work: Callable[[], R], *, first: bool = False) -> Later[R]:
        if self._executor is None:
            return _Here(work)
        piece = _There(work, self._executor)
        with self._lock:
            if not self._has_begun:
                self._waiting.insert(0 if first else len(self._waiting), piece)
                return piece
        piece.send()
        return piece

    def begun(self) -> None:
        """Hand over to the processes, which have begun, what waited for them."""
        with self._lock:
            self._has_begun = True
            for piece in self._waiting:
                piece.send()
            self._waiting.clear()

    def drop(self) -> None:
        """Forget what waits: nobody wants it any more."""
        # Without the lock, which may be held by what hands it over and waits for a process.
        self._waiting.clear()

    def help(self) -> None:
        """Work out here what was asked for last, piece by piece, until the processes have begun."""
        while piece := self._last():
            piece.work()

    def _last(self) -> _There[Any] | None:
        with self._lock:
            return self._waiting.pop() if self._waiting else None


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
    context = _context(modules)
    # Handed over: a server that forks keeps the environment it was started with.
    with _SERVING:
        safe_path = os.environ.get(_SAFE)
    executor = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin,
        initargs=([*loaded_files(), *files], safe_path, foreign.place()),
    )  # fmt: skip
    side = Pool(executor)
    # The first processes start now, not when there is work for them, and where they can wait.
    Thread(target=_start, args=(executor, side, workers), daemon=True).start()
    try:
        yield side
        executor.shutdown()
    except BaseException:
        side.drop()  # nobody waits for the pieces
        _stop(executor)
        executor.shutdown(wait=False, cancel_futures=True)
        raise


def begin_imports(workers: int, modules: Sequence[str] = _REPORT) -> None:
    """Have the processes of a `pool` to come import what they need while the caller does.

    Parameters
    ----------
    workers : int
        Of the pool.
    modules : sequence of str, optional
    """
    if workers > 1 and _context(modules).get_start_method() == "forkserver":
        Thread(target=_serve, daemon=True).start()


def _context(modules: Sequence[str]) -> BaseContext:
    """How processes start: forked from one that has imported these modules and has no threads."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(list(modules))
    return context


def _serve() -> None:
    """Start the server where an interruption does not reach it.

    It is for the process that waits for the pieces; they would end with tracebacks.
    """
    without_interruptions()
    with _SERVING:
        before = os.environ.get(_SAFE)
        # It would take a `corner.py` of the working folder for the library of that name.
        os.environ[_SAFE] = "1"
        with suppress(EOFError, OSError):  # stopped meanwhile
            forkserver.ensure_running()
        _restore(before)


def _restore(safe_path: str | None) -> None:
    """Have what is started from here on look for modules as it was said before."""
    if safe_path is None:
        os.environ.pop(_SAFE, None)
    else:
        os.environ[_SAFE] = safe_path


def _start(executor: ProcessPoolExecutor, side: Pool, workers: int) -> None:
    """Start the first processes, and what they are forked from; then hand over what waits."""
    try:
        with suppress(EOFError, OSError, RuntimeError):  # stopped meanwhile, or short of processes
            if "forkserver" in get_all_start_methods():
                _serve()
            for _ in range(min(workers, _AT_FIRST)):
                executor.submit(_begun)
    finally:
        side.begun()


def without_interruptions() -> None:
    """Keep interruptions from this thread, and from the threads and processes it starts."""
    if hasattr(signal, "pthread_sigmask"):
        # Started before: what starts it lets interruptions through again.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])


def end_server() -> None:
    """End the server of all processes, which may just be importing what they need.

    It would end by itself, but only then, and keep a pipe open that the output goes to.
    """
    server = getattr(forkserver._forkserver, "_forkserver_pid", None)
    if server is not None:
        with suppress(ProcessLookupError):  # one before it was stopped, and is gone
            os.kill(server, signal.SIGTERM)


def _stop(executor: ProcessPoolExecutor) -> None:
    """End processes at once, and what they are forked from."""
    end_server()
    for process in list((executor._processes or {}).values()):
        process.terminate()


def _begin(files: Sequence[Path], safe_path: str | None, parts: Path | None) -> None:
    """Leave an interruption to the process that waits for the pieces; know what it knows."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _restore(safe_path)
    foreign.work_for(parts)
    gc.freeze()  # what was imported stays: the garbage collector need not look at it again
    gc.set_threshold(20_000, 20)  # as `calib.cli.main` has it
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
