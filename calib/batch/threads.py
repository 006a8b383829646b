"""The same arithmetic, whatever the machine has and the caller has set.

One thread of linear algebra, for several add up in another order; and no floating-point errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np


@contextmanager
def one_thread() -> Iterator[None]:
    """Do linear algebra on one thread: the last bits are the same on any number of cores.

    Also a decorator. The matrices are small, so that more threads would not be faster. Nor does
    it matter whether the caller has NumPy raise floating-point errors.
    """
    with _libraries().limit(limits=1, user_api="blas"), no_floating_point_errors():
        yield


def no_floating_point_errors() -> np.errstate:
    """Have NumPy warn of what it would raise, as it does by default (not of underflow)."""
    import numpy as np

    usual: Any = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}
    set_here: dict[str, Any] = np.geterr()  # type: ignore[assignment]
    return np.errstate(**{k: usual[k] if v == "raise" else v for k, v in set_here.items()})


def blas_kernels() -> list[str]:
    """Name the processors that the linear algebra's kernels are made for, as it chose them."""
    found = {str(library.get("architecture", "")) for library in _libraries().info()}
    return sorted(found - {""})


@cache
def _libraries() -> Any:
    # SciPy brings a library of its own, which has to be there to be told.
    import_module("scipy.linalg")
    return import_module("threadpoolctl").ThreadpoolController()
