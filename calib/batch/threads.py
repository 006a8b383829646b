"""One thread of linear algebra, whatever the machine has: several add up in another order."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any


@contextmanager
def one_thread() -> Iterator[None]:
    """Do linear algebra on one thread: the last bits are the same on any number of cores.

    Also a decorator. The matrices are small, so that more threads would not be faster.
    """
    with _libraries().limit(limits=1, user_api="blas"):
        yield


def blas_kernels() -> list[str]:
    """Name the processors that the linear algebra's kernels are made for, as it chose them."""
    found = {str(library.get("architecture", "")) for library in _libraries().info()}
    return sorted(found - {""})


@cache
def _libraries() -> Any:
    # SciPy brings a library of its own, which has to be there to be told.
    import_module("scipy.linalg")
    return import_module("threadpoolctl").ThreadpoolController()
