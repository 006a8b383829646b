"""VDrift's tyre from the library that tyre.toml says how to build."""

import ctypes
from pathlib import Path

import numpy as np

_tyre = ctypes.CDLL(str(Path(__file__).with_name("libtyre.so"))).tyre
_tyre.restype = None
_ARRAY = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
_tyre.argtypes = [ctypes.c_int, ctypes.c_int, *[_ARRAY] * 4]


def pull(theta, conditions):
    """Return the pull (N), shape (k, n), of the parameters b0 to b10, shape (k, 11)."""
    slip, load = (np.ascontiguousarray(conditions[name]) for name in ("slip", "load"))
    found = np.empty((len(theta), slip.size))
    _tyre(len(theta), slip.size, np.ascontiguousarray(theta), slip, load, found)
    return found
