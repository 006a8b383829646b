"""The noise of an output's readings: how it grows with slip, and as the tyre goes soft.

Where a case asks for it, neighbours along a run are correlated, by the same autoregression as in
fits (`calib.inference.likelihood`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from calib.data import Table
from calib.data.quantities import columns_of
from calib.gap.constants import CORRELATIONS, KAPPA, LN_KAPPA_PRIOR, LN_RHO_PRIOR, RHO
from calib.gap.effects import View
from calib.inference.likelihood import Serial, serial_of
from calib.inference.priors import Priors
from calib.inference.problem import Problem
from calib.inference.proposal import log_sum
from calib.models.base import Array


@dataclass(frozen=True)
class Along:
    """Runs along which neighbours are correlated.

    Parameters
    ----------
    serial : Serial
        The order of the rows.
    correlations : ndarray
        Of neighbours, as probable as one another.
    """

    serial: Serial
    correlations: Array

    @classmethod
    def of(cls, problem: Problem, field: Table) -> Along | None:
        """Return those of a problem's rows, then the field's; None where all are independent."""
        lab = problem.serial
        there = serial_of(problem.noise.correlated_along, field)
        if lab is None or there is None:
            return None
        rho = Priors(tuple(p for p in problem.priors.entries if p.name == "rho"))
        u = (np.arange(CORRELATIONS)[:, None] + 0.5) / CORRELATIONS
        return cls(lab + there, np.unique(rho.to_natural(rho.ppf(u[:, : len(rho.free)]))))


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
    along : Along, optional
        If neighbours along a run are correlated.
    added : ndarray, optional
        What errors of the rows' conditions add to the square of the growth.
    """

    slip: Array
    softness: Array
    along: Along | None = None
    added: Array | None = None

    @cached_property
    def grid(self) -> list[Noise]:
        """Noises of sigma 1, of which one is to be found."""
        kappas = KAPPA if np.ptp(self.softness) else KAPPA[:1]
        correlations = np.zeros(1) if self.along is None else self.along.correlations
        values = (some.tolist() for some in (RHO, kappas, correlations))
        return [Noise(1.0, *of) for of in product(*values)]

    @cached_property
    def forms(self) -> tuple[Array, Array]:
        """Squares of white residuals as forms of `products`, (grid, n or 2 n); log of their scales.

        A white residual is (r_i / g_i - a_i r_j / g_j) / s_i, with the neighbour j before.
        """
        every, ln_scale = [], []
        for noise in self.grid:
            of = Whitening.of(noise, self)
            own = (of.sd * of.left) ** -2.0
            if of.before is not None:
                carried = (of.after / (of.sd[of.before] * of.left)) ** 2
                own = own + np.bincount(of.before, carried, own.size)
                cross = -2.0 * of.after / (of.sd * of.sd[of.before] * of.left**2)
                own = np.concatenate([own, cross])
            every.append(own)
            ln_scale.append(of.ln_scale)
        return np.array(every), np.array(ln_scale)

    def products(self, one: Array, other: Array) -> Array:
        """Products of residuals (..., n), with themselves and then, if correlated, with neighbours.

        Returns
        -------
        ndarray, shape (..., n) or (..., 2 n)
        """
        own = one * other
        if self.along is None:
            return np.asarray(own)
        return np.concatenate([own, one * other[..., self.along.serial.before_each]], axis=-1)

    def growth(self, rho: float, kappa: float) -> Array:
        """Growth of the noise, shape (n,)."""
        with_slip = 1.0 + rho * np.maximum(self.slip, 0.0)
        grown = with_slip * np.exp(kappa * self.softness)
        return np.asarray(grown if self.added is None else np.hypot(grown, np.sqrt(self.added)))

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
    """Noise of one output: sd sigma (1 + rho slip) (p_lab / p)^kappa on the response's scale.

    Neighbours along a run may have a correlation.
    """

    sigma: float
    rho: float = 0.0
    kappa: float = 0.0
    correlation: float = 0.0

    def sd(self, at: NoiseConditions) -> Array:
        """Noise sd, shape (n,)."""
        return self.sigma * at.growth(self.rho, self.kappa)


@dataclass(frozen=True)
class Whitening:
    """Makes residuals of rows independent standard normals.

    Parameters
    ----------
    sd, after, left : ndarray, shape (n,)
        Sd of each row, its correlation with the one before, and the sd given that one, of the
        sd.
    before : ndarray of int, shape (n,), optional
        Places of the rows before; None where rows are independent.
    """

    sd: Array
    after: Array
    left: Array
    before: NDArray[np.intp] | None = None

    @classmethod
    def of(cls, noise: Noise, at: NoiseConditions) -> Whitening:
        """Return that of the rows of an output."""
        sd = noise.sd(at)
        if at.along is None:
            return cls(sd, np.zeros_like(sd), np.ones_like(sd))
        serial, after = at.along.serial, np.empty_like(sd)
        after[serial.order] = noise.correlation**serial.gap
        return cls(sd, after, np.sqrt(1.0 - after**2), serial.before_each)

    @classmethod
    def joined(cls, parts: Sequence[Whitening]) -> Whitening:
        """Return that of several outputs' rows, one after the other."""
        sd, after, left = (
            np.concatenate([getattr(p, name) for p in parts]) for name in ("sd", "after", "left")
        )
        if all(p.before is None for p in parts):
            return cls(sd, after, left)
        starts = np.cumsum([0, *(p.sd.size for p in parts)])[:-1]
        own = [np.arange(p.sd.size) if p.before is None else p.before for p in parts]
        before = np.concatenate([b + start for b, start in zip(own, starts, strict=True)])
        return cls(sd, after, left, before)

    def take(self, rows: NDArray[np.int64]) -> Whitening:
        """Return that of some rows in ascending order, which no other row comes before."""
        before = None
        if self.before is not None:
            before = np.searchsorted(rows, self.before[rows]).clip(0, rows.size - 1)
        return Whitening(self.sd[rows], self.after[rows], self.left[rows], before)

    @property
    def ln_scale(self) -> float:
        """Log of the determinant of the covariance's root."""
        return float(np.log(self.sd * self.left).sum())

    def __call__(self, residuals: Array) -> Array:
        """Whiten residuals, shape (..., n)."""
        return self.decorrelated(residuals / self.sd)

    def decorrelated(self, z: Array) -> Array:
        """Whiten residuals over their sds, shape (..., n)."""
        if self.before is None:
            return z
        return np.asarray((z - self.after * z[..., self.before]) / self.left)


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
    """Log prior probability of how a noise grows, whatever its correlation."""
    rho, kappa = np.argmin(np.abs(RHO - noise.rho)), np.argmin(np.abs(KAPPA - noise.kappa))
    return float(LN_RHO_PRIOR[rho] + LN_KAPPA_PRIOR[kappa])


def most_probable(products: Array, at: NoiseConditions) -> list[Noise]:
    """Return the most probable noise by each row of products of residuals, on the grid."""
    value, variance = _profile(products, at)
    best = value.argmax(axis=1).tolist()
    # A model without a value somewhere says nothing about the noise.
    known = np.isfinite(value).all(axis=1).tolist()
    return [
        replace(at.grid[j], sigma=float(np.sqrt(variance[i, j]))) if known[i] else Noise(1.0)
        for i, j in enumerate(best)
    ]


def ln_averaged(products: Array, at: NoiseConditions) -> Array:
    """Log density of residuals, by their products, averaged over the noise, shape (m,).

    Over how it grows and is correlated by the prior, over ln sigma evenly, with a density of
    (n / pi)^(1/2) for each unit: so averaging leaves it as it is at the most probable sigma, where
    all others are averaged alike, and hypotheses' evidence can be compared with and without it.
    """
    n = at.slip.size
    value, _ = _profile(products, at)
    constant = 0.5 * np.log(n / np.pi) - np.log(2.0) + gammaln(0.5 * n)
    constant -= 0.5 * n * np.log(np.pi * n)
    return np.asarray(log_sum(value.T) + constant)


def _profile(products: Array, at: NoiseConditions) -> tuple[Array, Array]:
    """Log of likelihood times prior at the best sigma of every noise of the grid, and its square.

    Both of shape (m, grid), the former but for constants.
    """
    forms, ln_scale = at.forms
    n = at.slip.size
    with np.errstate(invalid="ignore", over="ignore"):
        variance = np.maximum(products @ forms.T / n, 1e-18)
        prior = np.array([ln_prior(noise) for noise in at.grid])
        prior -= 0.0 if at.along is None else np.log(at.along.correlations.size)
        value = -0.5 * n * np.log(variance) + prior - ln_scale
    return value, variance
