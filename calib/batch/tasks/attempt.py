"""One task: its result or its error, and how long it took."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
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
