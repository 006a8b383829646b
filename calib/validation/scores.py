"""Scores and residuals of predictive draws, and what set each parameter.

`draws` always has shape (n_draws, n): predictive draws of n observations, noise included.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, ndtri

from calib.batch.environment import one_thread
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import power_scaled_weights, power_sensitivity
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.validation.constants import (
    CONTRACTION_MIN,
    LEVELS,
    RELATIVE_ERROR_FAR,
    SENSITIVITY_MIN,
)


@dataclass(frozen=True)
class Sensitivity:
    """What a parameter owes to the prior and to the data, per doubling of the power of either.

    `contraction` is ``1 - var_post/var_prior``: of the internal coordinate of a sampled parameter,
    of the normal scores under the prior (whatever the parameter's scale) of a derived one. Negative
    where the posterior is wider.
    """

    name: str
    prior: float
    likelihood: float
    contraction: float

    @property
    def prior_dominated(self) -> bool:
        """Strong prior, weak likelihood: the marginal reacts to the one, not to the other."""
        return self.prior >= SENSITIVITY_MIN > self.likelihood

    @property
    def identified(self) -> bool:
        """Whether the data say anything of their own about it: both criteria must hold."""
        return self.contraction >= CONTRACTION_MIN and not self.prior_dominated

    @property
    def reading(self) -> str:
        """What the figures say, in words."""
        if not self.identified:
            return "not identified"
        return "data and prior" if self.prior >= SENSITIVITY_MIN else "data"


@one_thread()
def prior_sensitivity(calibration: Calibration) -> dict[str, Sensitivity]:
    """Work out the sensitivity of every parameter that varies, sampled or published.

    Notes
    -----
    The distance depends on the scale of a quantity, so it is taken where a long tail does not
    rule it: on the logarithm of parameters sampled there, and of derived ones that are positive.
    """
    problem, draws = calibration.problem, calibration.draws
    chains = calibration.natural.shape[:2]
    log_prior = problem.priors.log_prob(draws.flat)
    parts = {"prior": log_prior, "likelihood": draws.log_prob.reshape(-1) - log_prior}
    powers = (0.99, 1.01)
    weights = {
        name: (
            power_scaled_weights(part.reshape(chains), powers[0]),
            power_scaled_weights(part.reshape(chains), powers[1]),
        )
        for name, part in parts.items()
    }
    logged = {p.name: p.log for p in problem.priors.free}
    prior = _prior_draws(calibration)
    found = {}
    for name, drawn in calibration.parameters.items():
        scaled = np.log(drawn) if logged.get(name, (drawn > 0.0).all()) else drawn
        reaction = {k: power_sensitivity(scaled, w, powers) for k, w in weights.items()}
        contraction = (
            1.0 - calibration.summary[name].sd_ratio ** 2
            if name in problem.names
            else _score_contraction(prior[name], drawn.reshape(-1))
        )
        found[name] = Sensitivity(name, reaction["prior"], reaction["likelihood"], contraction)
    return found


def _prior_draws(calibration: Calibration) -> Mapping[str, Array]:
    """Published parameters of prior draws at which the model has a value at every row."""
    problem = calibration.problem
    rng = generator(calibration.seed, calibration.label, "sensitivity")
    theta = problem.of_model(problem.theta(problem.priors.sample(rng, 20_000)))
    # A million values at once.
    parts = np.array_split(theta, 1 + len(theta) * len(problem.table) // 1_000_000)
    defined = [
        np.isfinite(problem.bound.mean_response(part, problem.conditions)).all(axis=1)
        for part in parts
    ]
    with np.errstate(all="ignore"):
        return problem.bound.report(theta[np.concatenate(defined)])


def _score_contraction(prior: Array, posterior: Array) -> float:
    ordered = np.sort(prior[~np.isnan(prior)])
    below = np.searchsorted(ordered, posterior) + 0.5
    return 1.0 - float(np.var(ndtri(below / (ordered.size + 1.0))))


@dataclass(frozen=True)
class Coverage:
    """How many observations a band covered, with the 95 % Jeffreys interval of the proportion."""

    level: float
    hits: int
    n: int
    lower: float
    upper: float

    @property
    def proportion(self) -> float:
        """Covered part."""
        return self.hits / self.n


@dataclass(frozen=True)
class Scores:
    """Scores of one set of n observations.

    Parameters
    ----------
    rmse : float
        Of the predictive median, in the unit of the output.
    crps : float
        Mean continuous ranked probability score, in the unit of the output; NaN where the
        predictive distribution's tail is so heavy that it has none.
    relative_error : ndarray, shape (n,)
        (median - observed)/observed; NaN where the observation is below a twentieth of the
        largest.
    pit, median : ndarray, shape (n,)
        Probability integral transform, and the predictive median.
    """

    n: int
    rmse: float
    crps: float
    relative_error: Array
    coverage: Mapping[float, Coverage]
    pit: Array
    median: Array

    @property
    def max_relative_error(self) -> float:
        """Largest absolute relative error; NaN where every observation is near zero."""
        defined = self.relative_error[~np.isnan(self.relative_error)]
        return float(np.abs(defined).max()) if defined.size else float("nan")

    @property
    def n_far(self) -> int:
        """How many rows have a relative error of more than 6 %."""
        return int((np.abs(self.relative_error) > RELATIVE_ERROR_FAR).sum())


def crps(draws: Array, observed: Array) -> Array:
    """Continuous ranked probability score of each observation, shape (n,).

    After Gneiting & Raftery (2007), doi:10.1198/016214506000001437, Eq 21, with the sorted form of
    the mean absolute difference.
    """
    m = draws.shape[0]
    ordered = np.sort(draws, axis=0)
    weight = (2.0 * np.arange(1, m + 1) - m - 1.0) / m**2
    return np.asarray(np.abs(draws - observed).mean(axis=0) - weight @ ordered)


def pit(draws: Array, observed: Array) -> Array:
    """Part of the draws below each observation, shape (n,)."""
    return np.asarray((draws < observed).mean(axis=0))


def coverage(draws: Array, observed: Array, level: float) -> Coverage:
    """Count the observations inside the central band of a level."""
    low, high = np.quantile(draws, [0.5 - level / 2.0, 0.5 + level / 2.0], axis=0)
    hits = int(((observed >= low) & (observed <= high)).sum())
    n = int(observed.size)
    return Coverage(level, hits, n, *jeffreys(hits, n))


def jeffreys(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % Jeffreys interval of a proportion, closed at the ends of all or none.

    After Brown, Cai & DasGupta (2001), doi:10.1214/ss/1009213286.
    """
    # Quantiles of the beta distribution, without SciPy's statistics, which are slow to import.
    a, b = hits + 0.5, n - hits + 0.5
    low = 0.0 if hits == 0 else float(betaincinv(a, b, 0.025))
    return low, 1.0 if hits == n else float(betaincinv(a, b, 0.975))


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values, in their order, for their number, family-wise (Holm 1979, JSTOR 4615733)."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    scaled = np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(scaled, 1.0)
    return [float(v) for v in adjusted]


def score(draws: Array, observed: Array, *, heavy: bool = False) -> Scores:
    """Score predictive draws (n_draws, n) of observations (n,); heavy ones have no CRPS."""
    median = np.median(draws, axis=0)
    # Relative errors of a pull near zero say nothing.
    large = np.abs(observed) > 0.05 * np.abs(observed).max()
    relative = np.full(observed.size, np.nan)
    relative[large] = (median[large] - observed[large]) / observed[large]
    return Scores(
        n=int(observed.size),
        rmse=float(np.sqrt(np.mean(np.square(median - observed)))),
        crps=float("nan") if heavy else float(crps(draws, observed).mean()),
        relative_error=relative,
        coverage={level: coverage(draws, observed, level) for level in LEVELS},
        pit=pit(draws, observed),
        median=median,
    )


@dataclass(frozen=True)
class Standardised:
    """Residuals over the noise scale, posterior means, and predictions of some rows, each (n,).

    Where the noise is Student's, normal scores: standard normal values of the same quantile.
    Residuals are on the scale of the response; the prediction is in the output's unit.
    """

    residual: Array
    predicted: Array


def standardise(calibration: Calibration, problem: Problem) -> Standardised:
    """Work residuals out at the posterior: of the problem's rows, calibrated on or others."""
    natural = problem.theta(calibration.subset(1000))
    location = problem.bound.mean_response(problem.of_model(natural), problem.conditions)
    scores = problem.noise.normal_scores(
        problem.residuals(natural), natural, problem.scale(natural)
    )
    residual = np.nanmean(scores, axis=0)
    return Standardised(residual, problem.bound.from_response(np.nanmedian(location, axis=0)))


def sign_changes(x: Array, residual: Array, groups: Iterable[NDArray[np.bool_]]) -> tuple[int, int]:
    """Count sign changes of residuals (n,) along x within each group, and neighbours in all.

    Independent residuals change sign between half of the neighbours; a curve that misses a pattern
    leaves long runs of one sign.
    """
    changes, pairs = 0, 0
    for rows in groups:
        sign = np.sign(residual[rows][np.argsort(x[rows], kind="stable")])
        changes += int((sign[1:] != sign[:-1]).sum())
        pairs += max(0, sign.size - 1)
    return changes, pairs


def normal_order(n: int) -> tuple[Array, Array, Array]:
    """Quantiles that n sorted standard normals have, and where 95 % of each of them lie."""
    i = np.arange(1.0, n + 1.0)
    low, high = (betaincinv(i, n + 1.0 - i, p) for p in (0.025, 0.975))
    middle, low, high = ndtri(np.stack([(i - 0.375) / (n + 0.25), low, high]))
    return middle, low, high


# The same limit as that of an identified parameter: nine tenths of the prior's sd.
PRIOR_SET = (1.0 - CONTRACTION_MIN) ** 0.5
