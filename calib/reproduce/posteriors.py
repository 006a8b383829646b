"""Compare netCDF files: byte by byte, draw by draw, and with the numbers stated of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib.chains import hdi
from calib.errors import CalibError
from calib.models.base import Array
from calib.problem import Problem
from calib.reproduce.items import Item, Status

__all__ = [
    "GROUP", "compare_posterior", "read_draws", "summary_of", "verify_density",
    "verify_summary",
]  # fmt: skip

GROUP = "posteriors"
_HDI = 0.95
# The summary is computed from the same draws in another order of summation.
_ROUNDING = 1e-6
# Part of the draws that may fall on the wrong side of a bound when they are transformed back.
_AT_BOUNDS = 1e-3


def read_draws(path: Path) -> dict[str, Array]:
    """Return the posterior draws in a file by parameter, each of shape (chains, draws).

    Raises
    ------
    CalibError
        If the file cannot be read.
    """
    import arviz as az

    try:
        with az.from_netcdf(path, engine="h5netcdf") as tree:
            found = {str(k): np.asarray(v.values) for k, v in tree["posterior"].data_vars.items()}
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise CalibError(
            f"the file cannot be read ({type(error).__name__})", where=str(path)
        ) from None
    if not found or any(v.ndim != 2 or v.size == 0 for v in found.values()):
        raise CalibError("there are no draws in it", where=str(path))
    return found


def summary_of(draws: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Return mean, sd, median and 95 % highest-density interval of each parameter."""
    found = {}
    for name, values in draws.items():
        flat = values.reshape(-1)
        low, high = hdi(flat, _HDI)
        found[name] = {
            "mean": float(flat.mean()),
            "sd": float(flat.std(ddof=1)),
            "median": float(np.median(flat)),
            "hdi_lower": low,
            "hdi_upper": high,
        }
    return found


def verify_summary(name: str, path: Path, stated: Mapping[str, Any]) -> Item:
    """Check that a file's draws have the summary that is stated of them."""
    try:
        computed = summary_of(read_draws(path))
    except CalibError as error:
        return Item(GROUP, name, Status.DIFFERENT, note=error.message)
    for parameter, values in computed.items():
        entry = stated.get(parameter)
        entry = entry if isinstance(entry, Mapping) else {}
        scale = values["sd"]
        for key, value in values.items():
            given = entry.get(key)
            if not isinstance(given, int | float) or not math.isclose(
                given, value, rel_tol=_ROUNDING, abs_tol=_ROUNDING * scale
            ):
                note = f"{key} of {parameter} is not the one in summary.json"
                return Item(GROUP, name, Status.DIFFERENT, given, value, note=note)
    return Item(GROUP, name, Status.IDENTICAL, note="its draws have the summary that is stated")


def verify_density(name: str, path: Path, problem: Problem) -> Item:
    """Check that a file's draws have the log density that data and priors give them."""
    import arviz as az

    try:
        with az.from_netcdf(path, engine="h5netcdf") as tree:
            group = tree["posterior"]
            stated = np.asarray(tree["sample_stats"]["lp"].values).reshape(-1)
            natural = np.stack(
                [
                    np.full(stated.size, p.loc) if p.fixed else group[p.name].values.reshape(-1)
                    for p in problem.priors.entries
                ],
                axis=-1,
            )
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        note = f"the file cannot be read ({type(error).__name__})"
        return Item(GROUP, name, Status.DIFFERENT, note=note)
    with np.errstate(all="ignore"):
        t = problem.priors.to_internal(natural, margin=0.0)
    computed = problem.log_prob(t)
    close = np.abs(computed - stated) <= _ROUNDING * (1.0 + np.abs(stated))
    if np.mean(close) < 1.0 - _AT_BOUNDS:
        worst = int(np.argmin(close))
        note = "the log density of its draws is not what data and priors give"
        return Item(GROUP, name, Status.DIFFERENT, float(stated[worst]), float(computed[worst]),
                    note=note)  # fmt: skip
    return Item(GROUP, name, Status.IDENTICAL, note="its draws have the density of data and priors")


def compare_posterior(name: str, recorded: Path, drawn: Path, *, exact: bool) -> Item:
    """Compare a file with the one written again.

    Parameters
    ----------
    name : str
    recorded, drawn : Path
    exact : bool
        Whether the same numbers were written by the same versions.
    """
    if recorded.read_bytes() == drawn.read_bytes():
        return Item(GROUP, name, Status.IDENTICAL)
    try:
        old, new = read_draws(recorded), read_draws(drawn)
    except CalibError as error:
        return Item(GROUP, name, Status.DIFFERENT, note=error.message)
    same = set(old) == set(new) and all(np.array_equal(old[k], new[k]) for k in old)
    if exact:
        note = "what is beside the draws differs" if same else "the draws differ"
        return Item(GROUP, name, Status.DIFFERENT, note=f"{note}, and should not by a bit")
    if same:
        return Item(GROUP, name, Status.WITHIN, note="the same draws in another file")
    return Item(GROUP, name, Status.WITHIN, note="other draws; their summary is compared")
