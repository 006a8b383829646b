"""What the figures were measured on: type of processor and versions, no names and no paths."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__all__ = ["describe", "use_one_core"]

_LIBRARIES = (
    "numpy", "scipy", "emcee", "arviz-stats", "distributed", "pymc", "pytensor", "nutpie", "numba",
    "numexpr", "jax",
)  # fmt: skip


def describe() -> dict[str, object]:
    """Return processor, cores, memory, operating system, versions and the load."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
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


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
