"""Coordinates in which a posterior is nearer to a normal: a triangular quadratic map.

Posteriors of nonlinear regressions bend, and widen with the noise scale. Each coordinate, from the
last (the logarithm of the noise scale) to the first, is regressed on those before it, their
squares and their products; what is left of it, divided by a scale that grows with those before it,
is its straightened value. It is the Knothe-Rosenblatt rearrangement to second order
(Parno & Marzouk 2018, doi:10.1137/17M1134640). A mixture fitted there needs few components.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array

# Squares, products and the scale saturate this many standard deviations from the mean: they are
# fitted to the bulk, and tails beyond it are bent no further.
_SATURATION = 4.0
# Draws' worth of evidence that coordinates have no relation.
_RIDGE = 3.0
_NEWTON_STEPS = 8
# Of a coordinate's own growth, the sum over those it grows with.
_MOST_GROWTH = 0.5


@dataclass(frozen=True)
class Straightener:
    """A map of coordinates t to straightened ones v, one to one.

    Parameters
    ----------
    mean, sd : ndarray, shape (d,)
        Of t.
    coefficients : ndarray, shape (1 + d (d + 3)/2, d)
        Of the regression of each standardised coordinate, in the order last to first, on the
        features of those before it; zero from its own feature on.
    growth : ndarray, shape (d, d)
        Of the logarithm of each coordinate's scale with each of those before it, in the order
        last to first both.
    """

    mean: Array
    sd: Array
    coefficients: Array
    growth: Array

    @classmethod
    def identity(cls, d: int) -> Straightener:
        """Leave d coordinates as they are."""
        return cls(np.zeros(d), np.ones(d), np.zeros((1 + d * (d + 3) // 2, d)), np.zeros((d, d)))

    @classmethod
    def fit(cls, t: Array, weight: Array) -> Straightener:
        """Fit to draws (k, d) of weights (k,), sum 1; a LinAlgError if they are degenerate."""
        d = t.shape[1]
        mean = weight @ t
        sd = np.sqrt(weight @ np.square(t - mean))
        if not (np.isfinite(sd).all() and (sd > 1e-12 * (1.0 + abs(mean))).all()):
            raise np.linalg.LinAlgError("the draws have no spread")
        z = ((t - mean) / sd)[:, ::-1]
        features = _features(z)
        effective = 1.0 / np.square(weight).sum()
        coefficients = _regress(features, z, weight, effective)
        growth = np.zeros((d, d))
        if d > 1:
            left = np.square(z - features @ coefficients)[:, 1:]
            relative = (left / np.maximum(weight @ left, 1e-300)).mean(axis=1)
            bounded = _bounded(z)
            # With the last coordinate all scales grow alike, and often much.
            growth[1:, 0] = rho = _common_growth(relative, bounded[:, 0], weight)
            # Where the scale is small a draw says more about the bend.
            precise = weight * np.exp(-2.0 * rho * bounded[:, 0])
            coefficients = _regress(features, z, precise / precise.sum(), effective)
            left = (z - features @ coefficients) * np.exp(-bounded @ growth.T)
            growth += _own_growth(np.square(left), bounded, weight, effective)
        return cls(mean, sd, coefficients, growth)

    def straighten(self, t: Array) -> tuple[Array, Array]:
        """Return v, shape (k, d), and the log of the Jacobian |dv/dt|, shape (k,)."""
        z = ((t - self.mean) / self.sd)[:, ::-1]
        v = z - _features(z) @ self.coefficients
        log_scale = _bounded(z) @ self.growth.T
        v *= np.exp(-log_scale)
        return v[:, ::-1], -log_scale.sum(axis=1) - np.log(self.sd).sum()

    def bend(self, v: Array) -> tuple[Array, Array]:
        """Return t, shape (k, d), and the log of |dv/dt| there, as `straighten` of it would."""
        k, d = v.shape
        z, bounded = np.empty((d, k)), np.empty((d, k))
        features = np.empty((self.coefficients.shape[0], k))
        features[0] = 1.0
        log_scales = np.zeros(k)
        n = 1
        for i in range(d):
            log_scale = self.growth[i, :i] @ bounded[:i]
            log_scales += log_scale
            z[i] = self.coefficients[:n, i] @ features[:n] + v[:, d - 1 - i] * np.exp(log_scale)
            bounded[i] = _bounded(z[i])
            features[n] = z[i]
            np.multiply(bounded[i], bounded[: i + 1], out=features[n + 1 : n + i + 2])
            n += i + 2
        return z[::-1].T * self.sd + self.mean, -log_scales - np.log(self.sd).sum()


def _bounded(z: Array) -> Array:
    return np.asarray(_SATURATION * np.tanh(z / _SATURATION))


def _features(z: Array) -> Array:
    """One, and for each coordinate itself and its products with those up to it, (k, 1 + ...).

    The features of the first i coordinates come first.
    """
    k, d = z.shape
    features = np.empty((1 + d * (d + 3) // 2, k))
    features[0] = 1.0
    bounded = np.ascontiguousarray(_bounded(z).T)
    n = 1
    for i in range(d):
        features[n] = z[:, i]
        np.multiply(bounded[i], bounded[: i + 1], out=features[n + 1 : n + i + 2])
        n += i + 2
    return features.T


def _regress(features: Array, z: Array, weight: Array, effective: float) -> Array:
    """Regress each coordinate on the features of those before it.

    Squares and products are shrunk by as much as noise alone would have made of them (the
    positive-part rule of James and Stein): a posterior that is straight stays straight.
    """
    weighted = features * weight[:, None]
    gram, moment = weighted.T @ features, weighted.T @ z
    d = z.shape[1]
    coefficients = np.zeros((features.shape[1], d))
    n = 1
    for i in range(d):
        plain = np.zeros(n)
        columns = np.array([0, *(1 + j * (j + 3) // 2 for j in range(i))])
        plain[columns] = _solve(gram, moment[:, i], columns, effective)
        full = _solve(gram, moment[:, i], np.arange(n), effective)
        # Mean squares explained, up to the same constant.
        gain = float(full @ moment[:n, i] - plain @ moment[:n, i])
        left = max(float(weight @ np.square(z[:, i]) - full @ moment[:n, i]), 1e-300)
        noise = (n - columns.size) / effective * left
        share = max(0.0, 1.0 - noise / gain) if gain > 0.0 else 0.0
        coefficients[:n, i] = plain + share * (full - plain)
        n += i + 2
    return coefficients


def _solve(gram: Array, moment: Array, columns: NDArray[np.intp], effective: float) -> Array:
    penalty = np.full(columns.size, _RIDGE / effective)
    penalty[0] = 0.0
    left = gram[np.ix_(columns, columns)] + np.diag(penalty)
    return np.asarray(np.linalg.solve(left, moment[columns]))


def _common_growth(squared: Array, bounded: Array, weight: Array) -> float:
    """Likeliest rho where squared residuals have a mean proportional to exp(2 rho bounded)."""
    shape = bounded - weight @ bounded
    rho = 0.0
    for _ in range(_NEWTON_STEPS):
        ratio = squared * np.exp(-2.0 * rho * shape)
        ratio /= weight @ ratio
        slope = (weight * shape) @ (ratio - 1.0)
        curvature = 2.0 * (weight * shape * shape) @ np.maximum(ratio, 0.5)
        rho = float(np.clip(rho + slope / curvature, -1.0, 1.0))
    return rho


def _own_growth(squared: Array, bounded: Array, weight: Array, effective: float) -> Array:
    """What the log scale of each coordinate grows by with those before it, shape (d, d).

    One step of Newton's method for the likeliest growth where squared residuals have a mean
    proportional to exp(2 growth bounded), shrunk by as much as noise alone would have made of it.
    """
    d = bounded.shape[1]
    centred = bounded - weight @ bounded
    excess = squared / np.maximum(weight @ squared, 1e-300) - 1.0
    weighted = (centred * weight[:, None]).T
    gram, moment, noise = weighted @ centred, weighted @ excess, weight @ np.square(excess)
    growth = np.zeros((d, d))
    for i in range(1, d):
        ridge = _RIDGE / effective * np.eye(i)
        step = np.linalg.solve(gram[:i, :i] + ridge, moment[:i, i])
        gain = effective * float(step @ moment[:i, i])
        share = max(0.0, 1.0 - i * float(noise[i]) / gain) if gain > 0.0 else 0.0
        step *= 0.5 * share
        growth[i, :i] = step / max(1.0, float(abs(step).sum()) / _MOST_GROWTH)
    return growth
