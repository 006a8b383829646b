"""The noise of an output's readings: how it grows with slip, and as the tyre goes soft."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from calib.data import Table
from calib.data.quantities import columns_of
from calib.gap.constants import KAPPA, LN_KAPPA_PRIOR, LN_RHO_PRIOR, RHO
from calib.gap.effects import View
from calib.inference.proposal import log_sum
from calib.models.base import Array


@dataclass(frozen=True)
class NoiseConditions:
    """What the noise of some rows depends on, shape (n,) each.

    Parameters
    ----------
    slip : ndarray
        Recorded, as a fraction; zero where it is not recorded.
    softness : ndarray
        Minus the logarithm of inflation pressure over the median of the calibration's; zero where
        it is not recorded.
    """

    slip: Array
    softness: Array

    @cached_property
    def growths(self) -> tuple[Array, Array]:
        """Growth of the noise for every rho and kappa, (rho, kappa, n); of its log the sums."""
        kappas = KAPPA if np.ptp(self.softness) else KAPPA[:1]
        growth = np.array([[self.growth(rho, kappa) for kappa in kappas] for rho in RHO])
        return growth, np.log(growth).sum(axis=2)

    def growth(self, rho: float, kappa: float) -> Array:
        """Growth of the noise, shape (n,)."""
        with_slip = 1.0 + rho * np.maximum(self.slip, 0.0)
        return np.asarray(with_slip * np.exp(kappa * self.softness))

    def rows(self, rows: NDArray[np.int64]) -> NoiseConditions:
        """Some of the rows."""
        return NoiseConditions(self.slip[rows], self.softness[rows])

    def __add__(self, other: NoiseConditions) -> NoiseConditions:
        """These rows, then others."""
        return NoiseConditions(
            np.concatenate([self.slip, other.slip]),
            np.concatenate([self.softness, other.softness]),
        )


@dataclass(frozen=True)
class Noise:
    """Noise of one output: sd sigma (1 + rho slip) (p_lab / p)^kappa on the response's scale."""

    sigma: float
    rho: float = 0.0
    kappa: float = 0.0

    def sd(self, at: NoiseConditions) -> Array:
        """Noise sd, shape (n,)."""
        return self.sigma * at.growth(self.rho, self.kappa)


def noise_conditions(view: View) -> NoiseConditions:
    """What the noise of a view's rows depends on."""
    return _at(view.conditions, view.lab, view.slip().size)


def noise_conditions_of_lab(lab: Table, view: View) -> NoiseConditions:
    """What the noise of calibration rows depends on, beside a view of the field."""
    return _at(lab.columns, view.lab, len(lab))


def _at(conditions: Mapping[str, Array], lab: Mapping[str, float], size: int) -> NoiseConditions:
    softness = np.zeros(size)
    slip, recorded = (
        next((c for c in columns_of(role) if c in conditions), "") for role in ("slip", "pressure")
    )
    pressure, reference = conditions.get(recorded), lab.get(recorded)
    if pressure is not None and reference is not None:
        softness = -np.log(np.maximum(pressure, 1e-6) / max(reference, 1e-6))
    return NoiseConditions(conditions.get(slip, np.zeros(size)), softness)


def ln_prior(noise: Noise) -> float:
    """Log prior probability of how a noise grows."""
    rho, kappa = np.argmin(np.abs(RHO - noise.rho)), np.argmin(np.abs(KAPPA - noise.kappa))
    return float(LN_RHO_PRIOR[rho] + LN_KAPPA_PRIOR[kappa])


def most_probable(squared: Array, at: NoiseConditions) -> list[Noise]:
    """Return the most probable noise of each row of squared residuals (m, n), on the grid."""
    value, variance = _profile(squared, at)
    kappas = value.shape[1] // RHO.size
    best = value.argmax(axis=1).tolist()
    # A model without a value somewhere says nothing about the noise.
    known = np.isfinite(value).all(axis=1).tolist()
    return [
        Noise(float(np.sqrt(variance[i, j])), float(RHO[j // kappas]), float(KAPPA[j % kappas]))
        if known[i]
        else Noise(1.0)
        for i, j in enumerate(best)
    ]


def ln_averaged(squared: Array, at: NoiseConditions) -> Array:
    """Log density of squared residuals (m, n), averaged over the noise and its growth, (m,).

    Over rho and kappa by their prior, over ln sigma evenly, with a density of (n / pi)^(1/2) for
    each unit: so averaging leaves it as it is at the most probable sigma, where all others are
    averaged alike, and hypotheses' evidence can be compared with and without it.
    """
    n = squared.shape[1]
    value, _ = _profile(squared, at)
    constant = 0.5 * np.log(n / np.pi) - np.log(2.0) + gammaln(0.5 * n)
    constant -= 0.5 * n * np.log(np.pi * n)
    return np.asarray(log_sum(value.T) + constant)


def _profile(squared: Array, at: NoiseConditions) -> tuple[Array, Array]:
    """Log of likelihood times prior at the best sigma of every rho and kappa, and its square.

    Both of shape (m, rho times kappa), the former but for constants.
    """
    growth, ln_growth = at.growths
    _, kappas, n = growth.shape
    with np.errstate(invalid="ignore", over="ignore"):
        variance = np.maximum(squared @ (growth**-2).reshape(-1, n).T / n, 1e-18)
        prior = LN_RHO_PRIOR[:, None] + LN_KAPPA_PRIOR[:kappas]
        value = -0.5 * n * np.log(variance) + (prior - ln_growth).ravel()
    return value, variance
