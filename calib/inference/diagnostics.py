"""Statistics of chains, by ArviZ and emcee, and the gate a posterior passes before it is shown.

ArviZ is imported late.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

import numpy as np

from calib.data.files import plain_number
from calib.models.base import Array

_AXES = {"chain_axis": 0, "draw_axis": 1}


def _stats() -> Any:
    base: Any = import_module("arviz_stats.base")  # late: a second, which most commands do without
    return base.array_stats


def convergence(draws: Array) -> tuple[Array, Array, Array]:
    """Return rank-normalised split R-hat, bulk and tail ESS of each parameter, shape (d,) each.

    Of draws of ensembles, (ensembles, walkers, steps, d); NaN of fewer than four steps.
    Walkers of one ensemble are not independent chains, so R-hat compares whole ensembles: each is
    one chain, its halves the earlier and the later steps. Effective sample sizes take each walker
    as a chain, for autocorrelation runs along its steps.

    References
    ----------
    Vehtari et al. (2021), doi:10.1214/20-BA1221.
    """
    ensembles, walkers, steps, d = draws.shape
    if steps < 4:
        return np.full(d, np.nan), np.full(d, np.nan), np.full(d, np.nan)
    by_step = draws[:, :, steps % 2 :].swapaxes(1, 2).reshape(ensembles, -1, d)
    chains = draws.reshape(ensembles * walkers, steps, d)
    with np.errstate(all="ignore"):
        rhat = np.asarray(_stats().rhat(by_step, method="rank", **_AXES))
    return rhat, ess(chains, "bulk"), ess(chains, "tail")


def longest_autocorrelation_time(chain: Array) -> Array:
    """Integrated autocorrelation times in steps of a chain (steps, walkers, d), shape (d,).

    By emcee, of 64 evenly picked walkers: the larger of a coordinate's own and that of its distance
    from its median. A walker that goes to and fro between two modes has little autocorrelation of
    its own to show. Infinite if a walker never moved.
    """
    from emcee.autocorr import integrated_time  # late: half a second

    some = chain[:, :: max(1, chain.shape[1] // 64)]
    both = np.concatenate([some, abs(some - np.median(some, axis=(0, 1)))], axis=2)
    with np.errstate(invalid="ignore"):
        tau = integrated_time(both, c=5, tol=0, quiet=True).reshape(2, -1).max(axis=0)
    moved = (np.ptp(some, axis=0) > 0.0).all(axis=0)
    return np.where(moved & np.isfinite(tau), np.maximum(tau, 1.0), np.inf)


def ess(chains: Array, method: Literal["bulk", "tail", "mean"]) -> Array:
    """Effective sample size of each parameter, shape (chains, draws, d) to (d,)."""
    extra = {"prob": (0.05, 0.95)} if method == "tail" else {}
    with np.errstate(all="ignore"):
        value = _stats().ess(chains, method=method, **_AXES, **extra)
    return np.asarray(value)


def mcse(chains: Array, method: Literal["mean", "sd", "median"]) -> Array:
    """Monte Carlo standard error of a summary of each parameter, (chains, draws, d) to (d,)."""
    with np.errstate(all="ignore"):
        return np.asarray(_stats().mcse(chains, method=method, **_AXES))


def tail_shape(chains: Array) -> Array:
    """Pareto shape k of the heavier tail of each parameter, (chains, draws, d) to (d,).

    Moments up to 1/k exist: with k above 1/2 no variance, so no Monte Carlo error of a mean
    (Vehtari et al. 2024, Pareto smoothed importance sampling, JMLR 25(72)).
    """
    with np.errstate(all="ignore"):
        return np.asarray(_stats().pareto_khat(chains, **_AXES))


def hdi(draws: Array, prob: float) -> tuple[float, float]:
    """Highest-density interval of draws of shape (n,)."""
    low, high = _stats().hdi(draws, prob)
    return float(low), float(high)


def hdi_error(batches: Array, prob: float) -> Array:
    """Monte Carlo standard errors of the ends of a highest-density interval, shape (2,).

    From the draws in g nearly independent parts, shape (g, m). The ends of a shortest interval
    converge with the cube root of the number of draws (Kim & Pollard 1990,
    doi:10.1214/aos/1176347498), slower than the quantiles at which they lie: so do the ends of the
    parts, whose scatter is scaled by that root.
    """
    ends = np.asarray(_stats().hdi(batches, prob, axis=1))
    return np.asarray(ends.std(axis=0, ddof=1) / np.cbrt(batches.shape[0]))


def median_error(batches: Array) -> float:
    """Monte Carlo standard error of the median of draws in nearly independent parts, (g, m)."""
    return float(np.median(batches, axis=1).std(ddof=1) / np.sqrt(batches.shape[0]))


N_BINS = 20


def rank_histograms(values: Array) -> Array:
    """Histograms of the ranks of each ensemble's draws among all draws, relative to uniform.

    Of values (ensembles, n), shape (ensembles, `N_BINS`); all near 1 where the ensembles sample the
    same distribution.
    """
    order = values.ravel().argsort(kind="stable")
    which = np.empty(values.size, dtype=np.int64)
    which[order] = np.arange(values.size) * N_BINS // values.size
    counts = [np.bincount(row, minlength=N_BINS) for row in which.reshape(values.shape)]
    return np.asarray(np.stack(counts) * N_BINS / values.shape[1], dtype=np.float64)


def rank_scatter(effective: float) -> float:
    """Half the 95 % range of a rank histogram's bin about 1, from so many effective draws."""
    return float(1.96 * np.sqrt((N_BINS - 1.0) / max(effective, 1.0)))


def distances(
    draws: Array, values: Array, interval: tuple[float, float]
) -> tuple[Array, Array, bool]:
    """Express values (k,), and an interval, as distances from the mean of draws in their sds.

    And say whether logarithms were taken, as they are of positive parameters that span decades; a
    value without one has the distance NaN.
    """
    low, high = interval
    log = bool(low > 0.0 and high > 4.0 * low)
    with np.errstate(invalid="ignore", divide="ignore"):
        to = np.log if log else np.asarray
        t, x = to(draws[draws > 0.0] if log else draws), to(np.asarray(values, dtype=float))
    mean, sd = t.mean(), t.std()
    return (x - mean) / sd, (to(np.array(interval)) - mean) / sd, log


def psis(log_ratio: Array) -> tuple[Array, Array]:
    """Pareto-smoothed log weights (n, draws) of log ratios (n, draws), and the shapes k, (n,).

    After Vehtari et al. (2024), Pareto smoothed importance sampling, JMLR 25(72).
    """
    # ArviZ takes log likelihoods, of which it forms the ratios of leave-one-out itself.
    log_weight, k = _stats().psislw(-log_ratio)
    return np.asarray(log_weight), np.asarray(k)


def power_scaled_weights(log_density: Array, alpha: float) -> Array:
    """Smoothed weights, of sum one, that raise a part of the density to a power `alpha`.

    Shape (chains, draws), as the log density of that part, the prior or the likelihood, at each
    draw. After Kallioinen et al. (2024), doi:10.1007/s11222-023-10366-5.
    """
    log_weight = np.asarray(_stats().power_scale_lw(log_density, alpha=alpha, axis=(0, 1)))
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def power_sensitivity(
    draws: Array, weights: tuple[Array, Array], alphas: tuple[float, float]
) -> float:
    """Distance that a marginal, draws (chains, draws), moves per doubling of the power.

    Weights are those for the lower and for the upper of two powers.
    """
    lower, upper = weights
    value = _stats().power_scale_sense(
        draws, lower, upper, lower_alpha=alphas[0], upper_alpha=alphas[1]
    )
    return float(value)


# R-hat compares ensembles: of fewer it says little.
LEAST_ENSEMBLES = 4


@dataclass(frozen=True)
class Gate:
    """What a set of ensembles must reach, for every parameter.

    Rank-normalised split R-hat between ensembles (Vehtari et al. 2021, doi:10.1214/20-BA1221), bulk
    and tail effective sample size, and length in integrated autocorrelation times.
    """

    rhat_max: float = 1.01
    ess_min: float = 400.0
    taus_min: float = 50.0


@dataclass(frozen=True)
class GateReport:
    """Convergence figures of each parameter, arrays of shape (d,), and the verdict."""

    names: tuple[str, ...]
    rhat: Array
    ess_bulk: Array
    ess_tail: Array
    tau: Array
    steps: int
    passed: bool
    reasons: tuple[str, ...]


def judge(
    draws: Array,
    names: tuple[str, ...],
    gate: Gate,
    *,
    tau: Array,
    steps: int | None = None,
    min_ensembles: int = LEAST_ENSEMBLES,
) -> GateReport:
    """Judge draws of independently seeded ensembles, shape (ensembles, walkers, steps, d).

    `tau` (d,) is the integrated autocorrelation time in steps, the worst of the ensembles; `steps`
    the length of the chain that was run, that of the draws if it is not thinned.
    """
    ensembles = draws.shape[0]
    steps = draws.shape[2] if steps is None else steps
    r, bulk, tail = convergence(draws)
    reasons = []
    if ensembles < min_ensembles:
        reasons.append(f"{ensembles} ensembles, at least {min_ensembles} are needed")
    # Written so that NaN fails.
    for label, value, good, limit in (
        ("R-hat", r, r <= gate.rhat_max, f"at most {gate.rhat_max}"),
        ("bulk ESS", bulk, bulk >= gate.ess_min, f"at least {gate.ess_min:.0f}"),
        ("tail ESS", tail, tail >= gate.ess_min, f"at least {gate.ess_min:.0f}"),
        ("steps/tau", steps / tau, steps / tau >= gate.taus_min, f"at least {gate.taus_min:.0f}"),
    ):
        for name, v, ok in zip(names, value, good, strict=True):
            if not ok:
                reasons.append(f"{label} of {name} is {plain_number(v, 4)}, {limit} is needed")
    return GateReport(names, r, bulk, tail, tau, steps, not reasons, tuple(reasons))
