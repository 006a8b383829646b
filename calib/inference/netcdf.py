"""Posteriors as netCDF files, by h5netcdf: xarray takes longer to import than a file to write.

The files are laid out as ArviZ lays them out (a group for each kind of value, a coordinate for each
dimension), so that `arviz.from_netcdf` and `xarray.open_datatree` read them.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

DRAWN = ("chain", "draw")
# ArviZ takes groups for drawn ones unless they say otherwise.
_UNDRAWN = ("observed_data", "constant_data")


@dataclass(frozen=True, eq=False)
class Groups:
    """What a file holds.

    Parameters
    ----------
    values : mapping of str to mapping of str to ndarray
        Variables by group; of shape (chains, draws, ...) but in `observed_data` and
        `constant_data`.
    dims : mapping of str to tuple of str
        Names of a variable's dimensions beyond chain and draw, none by default.
    attrs : mapping of str to str
        Of the file.
    """

    values: Mapping[str, Mapping[str, NDArray[Any]]]
    dims: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    attrs: Mapping[str, str] = field(default_factory=dict)

    def dims_of(self, group: str, name: str) -> tuple[str, ...]:
        """Return the names of a variable's dimensions, all of them."""
        return (() if group in _UNDRAWN else DRAWN) + tuple(self.dims.get(name, ()))


def write_netcdf(groups: Groups, path: Path) -> None:
    """Write groups without time stamps, so equal results give equal content.

    Raises
    ------
    OSError
        If the disk has no room for it, before anything is written.
    """
    from h5netcdf import File

    size = sum(v.nbytes for group in groups.values.values() for v in group.values())
    # HDF5 does not survive a disk that fills up while it writes.
    if shutil.disk_usage(path.parent).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    with File(path, "w") as file:
        for name, text in groups.attrs.items():
            file.attrs[name] = text
        for group, variables in groups.values.items():
            node = file.create_group(group)
            for name, values in variables.items():
                dims = groups.dims_of(group, name)
                for dim, n in zip(dims, values.shape, strict=True):
                    if dim not in node.dimensions:
                        node.dimensions[dim] = n
                        node.create_variable(dim, (dim,), np.int64, data=np.arange(n))
                # Not compressed: draws get a tenth smaller, and take four times as long.
                node.create_variable(name, dims, values.dtype, data=values)


def read_netcdf(path: Path, *only: str) -> Groups:
    """Read a file's groups, or some of them; what is a coordinate is left out.

    Raises
    ------
    OSError, KeyError, ValueError, TypeError, RuntimeError
        If the file is damaged, or lacks a group.
    """
    from h5netcdf import File

    values: dict[str, dict[str, NDArray[Any]]] = {}
    dims: dict[str, tuple[str, ...]] = {}
    with File(path, "r") as file:
        for group in only or tuple(file.groups):
            node = file[group]
            values[group] = {}
            for name, variable in node.variables.items():
                if name not in node.dimensions:
                    values[group][name] = np.asarray(variable[...])
                    dims[name] = tuple(d for d in variable.dimensions if d not in DRAWN)
        attrs = {name: str(text) for name, text in file.attrs.items()}
    return Groups(values, dims, attrs)


@dataclass(frozen=True, eq=False)
class DrawsFile:
    """The draws in a file (chains, draws) by parameter, and their log density."""

    draws: Mapping[str, NDArray[np.float64]]
    log_prob: NDArray[np.float64]


def read_draws(path: Path) -> DrawsFile:
    """Read the posterior draws in a file; raises what `read_netcdf` does, if there are none too."""
    groups = read_netcdf(path, "posterior", "sample_stats").values
    draws, log_prob = groups["posterior"], groups["sample_stats"]["lp"]
    if log_prob.ndim != 2 or not log_prob.size or not draws:
        raise ValueError("there are no draws in it")
    if any(v.shape != log_prob.shape for v in draws.values()):
        raise ValueError("its draws differ in number")
    return DrawsFile(draws, log_prob)
