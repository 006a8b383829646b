"""Processors that this one can stand in for: kernels of its linear algebra, NumPy's instructions.

OpenBLAS is told which processor's kernels to use, NumPy which vector instructions to do without.
Both decide how sums are rounded, as another processor would.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pytest

# By kernel, the newest vector instructions that it needs.
_NEEDS = {
    "Prescott": "SSE3", "Nehalem": "SSE42", "Sandybridge": "AVX", "Haswell": "AVX2", "Zen": "AVX2",
    "SkylakeX": "AVX512_SKX",
}  # fmt: skip


class Setting(NamedTuple):
    """Kernel of the linear algebra, whether NumPy uses all vector instructions, threads."""

    kernel: str
    vectors: bool
    threads: int

    def environment(self) -> dict[str, str]:
        """Return the environment of a process that stands in for such a processor."""
        config: Any = np.show_config(mode="dicts")
        # What a build needs at the least cannot be switched off.
        optional = " ".join(config["SIMD Extensions"].get("found", ()))
        bare = {k: v for k, v in os.environ.items() if k != "NPY_DISABLE_CPU_FEATURES"}
        return bare | {
            "OPENBLAS_CORETYPE": self.kernel,
            "OPENBLAS_NUM_THREADS": str(self.threads),
            **({} if self.vectors or not optional else {"NPY_DISABLE_CPU_FEATURES": optional}),
        }

    def __str__(self) -> str:
        """Name the setting, for a test's id."""
        return f"{self.kernel}-{'all' if self.vectors else 'few'}-{self.threads}"


def _can_run(kernel: str) -> bool:
    from numpy._core._multiarray_umath import __cpu_features__

    return platform.machine() in ("x86_64", "AMD64") and __cpu_features__.get(_NEEDS[kernel], False)


KERNELS = tuple(filter(_can_run, _NEEDS))
ALL = tuple(Setting(*s) for s in product(KERNELS, (True, False), (1, 2)))
# The oldest, one between and the newest; one thread and two, all instructions and few.
_CHOSEN = (("Prescott", False, 1), ("Sandybridge", True, 2), ("SkylakeX", True, 1))
FEW = tuple(Setting(*s) for s in _CHOSEN if s[0] in KERNELS)


@cache
def crashes(kernel: str) -> bool:
    """Whether a library's kernel takes the process down on this machine, as some do on some."""
    product = (
        "import numpy as np\n"
        "for n in (1000, 3000, 8000, 23000):\n"
        "    for d in (3, 5, 9, 11, 16, 26):\n"
        "        x = np.random.default_rng(1).normal(size=(n, d)); (x * x[:, :1]).T @ x; x @ x[0]"
    )
    environment = Setting(kernel, True, 1).environment()
    ran = subprocess.run([sys.executable, "-c", product], env=environment, check=False)
    return ran.returncode != 0


def skip_what_crashes(setting: Setting) -> None:
    """Skip a test of a kernel that this machine cannot run, and say so."""
    if crashes(setting.kernel):
        pytest.skip(f"the linear algebra's kernel for {setting.kernel} crashes on this machine")
