"""What the figures were measured on: type of processor and versions, no names and no paths."""

from __future__ import annotations

import ctypes
import os
import platform
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

__all__ = ["describe", "hold_memory", "use_one_core"]

_LIBRARIES = (
    "numpy", "scipy", "emcee", "arviz-stats", "distributed", "pymc", "pytensor", "nutpie", "numba",
    "numexpr", "jax",
)  # fmt: skip


def describe() -> dict[str, object]:
    """Return processor, cores, memory, operating system, versions and the load."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": found,
        "load_average_1_min": round(os.getloadavg()[0], 2),
    }


def use_one_core() -> None:
    """Keep this process, and all threads it will start, on one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def hold_memory(gib: float) -> bool:
    """Take so much memory now and keep what is freed from then on; say whether it could be done.

    A virtual machine may give freed memory back to its host within seconds, and getting it anew
    takes 3 ms for each megabyte: a figure of the host's, not of the sampler that came next.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # of the GNU C library
    if mallopt is None:
        return False
    # No block of its own for a large array (M_MMAP_MAX), and nothing trimmed (M_TRIM_THRESHOLD).
    held = mallopt(-4, 0) == 1 and mallopt(-1, -1) == 1
    np.empty(int(gib * 2**27)).fill(0.0)
    return held


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
