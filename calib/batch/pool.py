"""Pieces of one result, worked out side by side in a few processes of this machine.

For seconds of work, of which the caller waits for every piece. Many tasks whose results must
outlive a kill are for `calib.batch.tasks.run_tasks`.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context, parent_process, resource_tracker
from pathlib import Path
from threading import Thread, current_thread, main_thread
from types import FrameType

from calib.batch.folders import parts, work_for
from calib.batch.user_code import Loader, load, loaded
from calib.errors import CalibError


class _Deferred[R](Future[R]):
    """A piece that is worked out in this process when its result is first asked for."""

    def __init__(self, work: Callable[[], R]) -> None:
        super().__init__()
        self._work = work

    def result(self, timeout: float | None = None) -> R:
        if not self.done():
            try:
                self.set_result(self._work())
            except Exception as error:
                self.set_exception(error)
        return super().result(timeout)


class _InThisProcess(Executor):
    def submit[**P, R](self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        return _Deferred(partial(fn, *args, **kwargs))


# Pieces are worked out one after the other, as their results are asked for.
HERE: Executor = _InThisProcess()


@contextmanager
def pool(workers: int, files: Mapping[Path, Loader] | None = None) -> Iterator[Executor]:
    """Yield an executor of some processes, or `HERE` with a single worker.

    A piece is a call of a module's function with arguments that can be pickled. It takes every
    random number from a stream of its own, so that it does not matter where it is worked out.

    Parameters
    ----------
    workers : int
        A script that asks for more than one needs ``if __name__ == "__main__":``.
    files : mapping of Path to callable, optional
        Files of the user's own that the processes load, and how, beside those that are loaded here.

    Raises
    ------
    CalibError
        If a process died, whose piece nobody can wait for any more.
    """
    if workers < 2:
        yield HERE
        return
    executor = ProcessPoolExecutor(
        workers, get_context("spawn"), _begin, (loaded() | dict(files or {}), parts())
    )
    try:
        with interruptions_held():
            # All at once: an executor does not notice the death of a process that it started last.
            for _ in range(workers):
                executor.submit(os.getpid)
        yield executor
        executor.shutdown()
    except BaseException as error:
        for process in list((executor._processes or {}).values()):
            process.kill()
        executor.shutdown(wait=False, cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise CalibError(
                "a process died while it worked: it was killed, or there was no memory left",
                hint="run it again; if it happens again, with one worker (--workers 1)",
            ) from None
        raise


@contextmanager
def interruptions_held() -> Iterator[None]:
    """Hold Ctrl-C back until the block ends; processes started within never see it."""
    if current_thread() is not main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    resource_tracker.ensure_running()  # its start would let interruptions through again
    usual = signal.signal(signal.SIGINT, lambda *given: came.append(given))
    # Processes inherit what is blocked, unlike the handler.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, usual)
    if came and callable(usual):
        usual(*came[0])


def _begin(files: Mapping[Path, Loader], parts: Path | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for the process that waits
    Thread(target=_end_with_parent, daemon=True).start()
    work_for(parts)
    load(files)


def _end_with_parent() -> None:
    """End when the process that waits for the pieces does, however it ends."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
