"""Compare netCDF files: byte by byte, draw by draw, and with the numbers stated of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib.check.outcome import Item, Status, claim
from calib.data.files import inside
from calib.errors import FAULTS, CalibError
from calib.inference.calibration import moments
from calib.inference.io import DRAWN, DrawsFile, read_draws, read_netcdf
from calib.inference.problem import Problem
from calib.models.base import Array

GROUP = "posteriors"
# The summary is computed from the same draws in another order of summation.
_ROUNDING = 1e-6
# Of the sd of what goes with draws: chains of the shortest run that passes the gate agree so far.
_OF_SD = 0.5
# Part of the draws that may fall on the wrong side of a bound when they are transformed back.
_AT_BOUNDS = 1e-3


def summary_of(file: DrawsFile) -> dict[str, dict[str, float]]:
    """Return mean, sd, median and 95 % highest-density interval of each parameter."""
    return {name: moments(values.reshape(-1)) for name, values in file.draws.items()}


def verify_posterior(
    path: Path, problem: Callable[[], Problem], stated: Mapping[str, Any] | None = None
) -> list[Item]:
    """Hold a file of draws, if it is there, against its summary if stated, data and priors."""
    if not path.is_file():
        return []
    items = []
    try:
        file = read_draws(path)
        items += [] if stated is None else [_verify_summary(path.name, file, stated)]
        items.append(_verify_density(path.name, file, problem()))
    except CalibError as error:
        items.append(claim(GROUP, path.name, error.message))
    except FAULTS as error:
        items.append(_unread(path.name, error))
    return items


def _unread(name: str, error: Exception) -> Item:
    return claim(GROUP, name, f"the file cannot be read ({type(error).__name__}: {error})")


def _verify_summary(name: str, file: DrawsFile, stated: Mapping[str, Any]) -> Item:
    """Check that a file's draws have the summary that is stated of them."""
    for parameter, values in summary_of(file).items():
        for key, value in values.items():
            given = inside(stated, parameter).get(key)
            if not isinstance(given, int | float) or not math.isclose(
                given, value, rel_tol=_ROUNDING, abs_tol=_ROUNDING * values["sd"]
            ):
                # Which of the two is wrong is for the sampling to say.
                both, note = f"summary.json and {name}", f"{key} of {parameter} is not the same"
                return Item(GROUP, both, Status.DIFFERENT, given, value, note=note)
    return claim(GROUP, name, "", "its draws have the summary that is stated")


def _verify_density(name: str, file: DrawsFile, problem: Problem) -> Item:
    """Check that draws have the density of data and priors, and derived ones follow from them."""
    stated = file.log_prob.reshape(-1)
    natural = problem.priors.stack(file.draws, stated.shape)
    with np.errstate(all="ignore"):
        t = problem.priors.to_internal(natural, margin=0.0)
        derived = problem.bound.report(problem.of_model(natural))
    for key, values in derived.items():
        said = file.draws.get(key, values)
        if not np.allclose(said.reshape(-1), values, rtol=_ROUNDING, atol=0.0, equal_nan=True):
            return claim(GROUP, name, f"{key} does not follow from the other parameters")
    computed = problem.log_prob(t)
    close = np.abs(computed - stated) <= _ROUNDING * (1.0 + np.abs(stated))
    if np.mean(close) < 1.0 - _AT_BOUNDS:
        pair = float(stated[close.argmin()]), float(computed[close.argmin()])
        note = "the log density of its draws is not what data and priors give"
        return Item(GROUP, name, Status.DIFFERENT, *pair, note=note)
    return claim(GROUP, name, "", "its draws have the density of data and priors")


def compare_posterior(name: str, recorded: Path, drawn: Path) -> Item:
    """Compare what is beside the posterior draws in a file with the same written again.

    It may be apart by a part of its own sd. Draws are held against their summary and density.
    """
    if recorded.read_bytes() == drawn.read_bytes():
        return Item(GROUP, name, Status.IDENTICAL)
    try:
        old, new = (_groups(path) for path in (recorded, drawn))
    except FAULTS as error:
        return _unread(name, error)
    apart = [key for key in {**old, **new} if not _alike(old.get(key), new.get(key))]
    if apart:
        wrong = f"{', '.join(sorted(apart)[:3])} in it: not what is written again"
        return claim(GROUP, name, wrong)
    return Item(GROUP, name, Status.WITHIN, note="its draws are compared by their summary")


def _groups(path: Path) -> dict[str, Array]:
    """Read every variable of a file by its path; of drawn ones, median and sd by row."""
    groups = read_netcdf(path)
    found: dict[str, Array] = {}
    for group, variables in groups.values.items():
        for name, values in variables.items():
            x = values.astype(np.float64)
            if x.ndim >= 2 and groups.dims_of(group, name)[:2] == DRAWN:
                draws = x.reshape(x.shape[0] * x.shape[1], -1)
                # Whatever their tails.
                low, median, high = np.quantile(draws, [0.16, 0.5, 0.84], axis=0)
                x = np.stack([median, 0.5 * (high - low)])
            found[f"{group}/{name}"] = x
    return found


def _alike(old: Array | None, new: Array | None) -> bool:
    if old is None or new is None or old.shape != new.shape:
        return False
    if old.ndim == 2 and old.shape[0] == 2:
        return bool((np.abs(old - new) <= _OF_SD * np.maximum(new[1], old[1]) + _ROUNDING).all())
    scale = max(float(np.abs(new).max(initial=0.0)), 1e-300)
    return bool(np.allclose(old, new, rtol=_ROUNDING, atol=_ROUNDING * scale, equal_nan=True))
