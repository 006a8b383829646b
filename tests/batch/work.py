"""What the tests have worker processes do: functions of a module, as any task must be."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

from calib.errors import CalibError
from calib.inference.random import generator


def draw(item: int) -> dict[str, object]:
    """A random number of the task's own stream."""
    return {"item": item, "value": float(generator(7, "draw", item).standard_normal())}


def draw_even(item: int) -> dict[str, object]:
    return draw(item) if fail_on_odd(item) else {}


def versions() -> dict[str, str]:
    """Others on a worker than here."""
    return {"numpy": f"of process {os.getpid()}"}


def files(item: int) -> dict[str, str | bytes]:
    return {"text.txt": f"{item}\n", "deep/er/data.bin": bytes([item])}


def outside(item: int) -> dict[str, str]:
    return {"../elsewhere.txt": "x"}


def fail_on_odd(item: int) -> dict[str, int]:
    if item % 2:
        raise CalibError(f"{item} is odd", hint="use an even number")
    return {"item": item}


def break_on_zero(item: int) -> dict[str, float]:
    return {"inverse": 1 / item}


def leave(item: int) -> dict[str, int]:
    sys.exit(3)


def not_json(item: int) -> dict[str, object]:
    return {"nan": float("nan")} if item == 0 else {"array": np.zeros(2)}


def die(item: tuple[str, str, int]) -> dict[str, int]:
    """Take the worker down, always or once, of which a file is the memory."""
    when, memory, value = item
    if when == "always" or (when == "once" and not Path(memory).exists()):
        Path(memory).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"value": value}


def slow(item: tuple[int, float]) -> dict[str, int]:
    value, seconds = item
    time.sleep(seconds)
    return {"value": value}


def second(item: tuple[bytes, int]) -> dict[str, int]:
    return {"value": item[1]}


def where(item: int) -> dict[str, object]:
    time.sleep(0.05)
    return {
        "pid": os.getpid(),
        "threads": os.environ.get("OPENBLAS_NUM_THREADS"),
        "trim": os.environ.get("MALLOC_TRIM_THRESHOLD_"),
    }
