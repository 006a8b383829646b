"""Calibrate: a problem in, its posterior out, seeded by point estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Integral

import numpy as np
from numpy.typing import NDArray

from calib.arguments import takes
from calib.inference.diagnostics import convergence, ess, hdi, hdi_error, median_error
from calib.inference.estimators import PointEstimate
from calib.inference.priors import Priors
from calib.inference.problem import Problem
from calib.inference.random import stream
from calib.inference.sampler import Draws, Progress, SamplerSettings, sample_posterior
from calib.models.base import Array
from calib.shown import Shown


@dataclass(frozen=True)
class ParameterSummary:
    """Posterior summary of one parameter; the interval is the 95 % highest-density one."""

    name: str
    unit: str
    mean: float
    sd: float
    median: float
    hdi_lower: float
    hdi_upper: float
    ess_bulk: float
    ess_tail: float
    rhat: float
    mcse_mean: float
    sd_ratio: float
    """Posterior over prior standard deviation; near 1 the data say nothing. NaN if derived."""
    mcse_median: float = float("nan")
    mcse_hdi_lower: float = float("nan")
    mcse_hdi_upper: float = float("nan")


@dataclass(frozen=True, repr=False)
class Calibration(Shown):
    """A calibrated model.

    Parameters
    ----------
    label : str
        Names the random streams that belong to it.
    estimates : tuple of PointEstimate
        That seeded the sampler.
    settings : SamplerSettings
        How it was sampled.
    part_of : str
        The joint posterior that its draws are a part of; empty of one by itself.
    """

    problem: Problem
    draws: Draws
    seed: int
    label: str
    estimates: tuple[PointEstimate, ...] = ()
    settings: SamplerSettings = field(default_factory=SamplerSettings)
    part_of: str = ""

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        name, n = self.problem.bound.model.name, len(self.problem.table)
        return f"<Calibration of {name} on {n} rows, {state}>"

    @property
    def converged(self) -> bool:
        """Whether the gate was passed."""
        return self.draws.report.passed

    @cached_property
    def summary(self) -> Mapping[str, ParameterSummary]:
        """Of every parameter that varies, sampled and published."""
        return _summarise(self)

    @cached_property
    def natural(self) -> Array:
        """Draws of all natural parameters, sigma last, shape (chains, draws, d_all)."""
        ensembles, walkers, steps, _ = self.draws.t.shape
        return self.problem.theta(self.draws.flat).reshape(ensembles * walkers, steps, -1)

    @cached_property
    def reported(self) -> Mapping[str, Array]:
        """Draws of the published parameters, each of shape (chains, draws)."""
        flat = self.problem.of_model(self.natural.reshape(-1, self.natural.shape[-1]))
        values = self.problem.bound.report(flat)
        return {name: v.reshape(self.natural.shape[:2]) for name, v in values.items()}

    @cached_property
    def parameters(self) -> Mapping[str, Array]:
        """Draws of everything that varies, sampled and published, shape (chains, draws) each."""
        sampled = {
            p.name: self.natural[:, :, i]
            for i, p in enumerate(self.problem.priors.entries)
            if not p.fixed
        }
        derived = {
            name: v for name, v in self.reported.items() if name not in sampled and np.ptp(v) > 0.0
        }
        return {**derived, **sampled}

    def subset(self, size: int) -> Array:
        """Evenly spaced draws in internal coordinates, shape (size, d)."""
        return np.asarray(self.draws.flat[self.picked(size)])

    def picked(self, size: int) -> NDArray[np.intp]:
        """Places of evenly spaced draws among `Draws.flat`, shape (size,)."""
        n = len(self.draws.flat)
        return np.linspace(0, n - 1, min(size, n)).round().astype(np.intp)


def _summarise(calibration: Calibration) -> dict[str, ParameterSummary]:
    problem = calibration.problem
    units = {**problem.bound.model.reported, **{p.name: p.unit for p in problem.priors.entries}}
    ratios = sd_ratios(problem.priors, calibration.draws.flat)
    return summarise(calibration.parameters, units, calibration.draws.t.shape[:3], ratios)


def sd_ratios(priors: Priors, flat: Array) -> dict[str, float]:
    """Return posterior over prior sds of free parameters, whose draws are (n, d).

    In internal coordinates, where a log-normal's is finite and meaningful.
    """
    levels = (np.arange(999) + 0.5) / 999.0
    prior = priors.ppf(levels[:, None] * np.ones(len(priors.free)))
    ratios = flat.std(axis=0) / prior.std(axis=0)
    return dict(zip(priors.names, ratios.tolist(), strict=True))


def summarise(
    parameters: Mapping[str, Array], units: Mapping[str, str], shape: tuple[int, ...],
    sd_ratio: Mapping[str, float],
) -> dict[str, ParameterSummary]:  # fmt: skip
    """Summarise draws (chains, draws) by name, of ensembles, walkers and steps of a shape."""
    names, (ensembles, walkers, steps) = tuple(parameters), shape
    stacked = np.stack([parameters[name] for name in names], axis=-1)
    rhat, bulk, tail = convergence(stacked.reshape(ensembles, walkers, steps, -1))
    mean_ess = ess(stacked, "mean")
    flat = stacked.reshape(-1, len(names))
    # Consecutive parts of every ensemble are nearly independent.
    parts = max(1, min(4, steps // 2))
    kept = stacked.reshape(ensembles, walkers, steps, -1)[:, :, : parts * (steps // parts)]
    batches = kept.reshape(ensembles, walkers, parts, -1, len(names)).transpose(4, 0, 2, 1, 3)
    batches = batches.reshape(len(names), ensembles * parts, -1)
    interval_error = [hdi_error(each, 0.95) for each in batches]
    return {
        name: ParameterSummary(
            name=name,
            unit=units[name],
            **moments(flat[:, j]),
            ess_bulk=float(bulk[j]),
            ess_tail=float(tail[j]),
            rhat=float(rhat[j]),
            mcse_mean=float(flat[:, j].std(ddof=1) / np.sqrt(mean_ess[j])),
            sd_ratio=sd_ratio.get(name, np.nan),
            mcse_median=median_error(batches[j]),
            mcse_hdi_lower=float(interval_error[j][0]),
            mcse_hdi_upper=float(interval_error[j][1]),
        )
        for j, name in enumerate(names)
    }


def moments(draws: Array) -> dict[str, float]:
    """Return what a summary says of draws (n,) in whatever order they came."""
    low, high = hdi(draws, 0.95)
    return {
        "mean": float(draws.mean()),
        "sd": float(draws.std(ddof=1)),
        "median": float(np.median(draws)),
        "hdi_lower": low,
        "hdi_upper": high,
    }


@takes(problem=Problem, seed=Integral, settings=SamplerSettings)
def calibrate(
    problem: Problem,
    seed: int,
    *,
    label: str = "",
    estimates: tuple[PointEstimate, ...] = (),
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Sample a problem's posterior.

    Parameters
    ----------
    seed : int
        Same seed, same numbers.
    label : str
        Names the random stream; the model's output by default.
    estimates : tuple of PointEstimate
        Seed the search for the mode; empty to search from prior draws alone.
    settings : SamplerSettings, optional
    progress : callable, optional
        Called with steps done and steps planned.

    Returns
    -------
    Calibration
        Read ``converged`` before use.

    Examples
    --------
    >>> import calib
    >>> ruts = calib.load_he2019("rut_depth")
    >>> calibration = calib.calibrate(calib.build_problem("bekker", ruts), seed=1)
    >>> calibration.converged
    True
    >>> calibration.summary["z_ref"].unit
    'mm'
    """
    label = label or problem.bound.model.output
    starts = _starts(problem, estimates) if estimates else None
    chosen = settings or SamplerSettings()
    draws = sample_posterior(
        problem, stream(seed, label, "sample"), starts=starts, settings=chosen, progress=progress
    )
    found = Calibration(problem, draws, seed, label, estimates, chosen)
    _ = found.summary  # here, and not in every process that it goes to
    return found


def _starts(problem: Problem, estimates: tuple[PointEstimate, ...]) -> Array:
    natural = [problem.completed(e.theta, max(e.rmse, 1e-12)) for e in estimates]
    return problem.priors.to_internal(np.array(natural))
