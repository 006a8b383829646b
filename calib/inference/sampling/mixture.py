"""Mixtures of multivariate Student-t.

Fit a mixture of Student-t to weighted draws by expectation maximisation.

Squared distances and covariances are both linear in the products of the coordinates, which are
formed once: a step is two matrix products.

Coordinates in which a posterior is nearer to a normal: a triangular quadratic map.

Posteriors of nonlinear regressions bend, and widen with the noise scale. Each coordinate, from the
last (the logarithm of the noise scale) to the first, is regressed on those before it, their
squares and their products; what is left of it, divided by a scale that grows with those before it,
is its straightened value. It is the Knothe-Rosenblatt rearrangement to second order
(Parno & Marzouk 2018, doi:10.1137/17M1134640). A mixture fitted there needs few components.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from calib.models.base import Array


@dataclass(frozen=True)
class StudentT:
    """A multivariate Student-t: mean (d,), lower factor of the scale matrix (d, d), and dof."""

    mean: Array
    cholesky: Array
    dof: float

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Draw, shape (size, d)."""
        normal = rng.standard_normal((size, self.mean.size))
        chi2 = rng.chisquare(self.dof, size) / self.dof
        return self.mean + (normal / np.sqrt(chi2)[:, None]) @ self.cholesky.T

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        whiten, constant = self.prepared
        z = whiten @ (t - self.mean).T
        squared = np.einsum("dk,dk->k", z, z)
        power = 0.5 * (self.dof + self.mean.size)
        return np.asarray(constant - power * np.log1p(squared / self.dof))

    @cached_property
    def prepared(self) -> tuple[Array, float]:
        """Whitening matrix (d, d), and the log density at the mean."""
        d = self.mean.size
        constant = (
            gammaln(0.5 * (self.dof + d))
            - gammaln(0.5 * self.dof)
            - 0.5 * d * np.log(self.dof * np.pi)
            - np.log(np.diag(self.cholesky)).sum()
        )
        return np.linalg.inv(self.cholesky), float(constant)


@dataclass(frozen=True)
class Mixture:
    """A mixture of m Student-t components with weights (m,)."""

    weights: Array
    components: tuple[StudentT, ...]

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return int(self.components[0].mean.size)

    @cached_property
    def _stacked(self) -> tuple[Array, Array, Array, Array]:
        """Whitening matrices (m d, d), whitened means (m, d, 1), constants and dof (m, 1)."""
        d, m = self.n_dim, len(self.components)
        inverses = np.stack([c.prepared[0] for c in self.components])
        means = np.stack([c.mean for c in self.components])
        dof = np.array([[c.dof] for c in self.components])
        constant = np.log(self.weights)[:, None] + [[c.prepared[1]] for c in self.components]
        whitened = inverses @ means[:, :, None]
        return inverses.reshape(m * d, d), whitened, constant, dof

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Draw, shape (size, d)."""
        drawn = np.empty((size, self.n_dim))
        ends = np.cumsum(rng.multinomial(size, self.weights)).tolist()
        for start, end, component in zip([0, *ends], ends, self.components, strict=False):
            drawn[start:end] = component.sample(rng, end - start)
        return drawn.take(rng.permutation(size), axis=0)

    def squared_distances(self, t: Array) -> Array:
        """Squared Mahalanobis distances from each component, shape (k, d) to (m, k)."""
        whiten, centre, _, _ = self._stacked
        z = (whiten @ t.T).reshape(len(self.components), self.n_dim, -1)
        z -= centre
        return np.asarray(np.einsum("mdk,mdk->mk", z, z))

    def log_parts(self, squared: Array) -> Array:
        """Log of each weighted component density at squared distances, shape (..., m, k)."""
        _, _, constant, dof = self._stacked
        parts = np.log1p(squared / dof)
        parts *= -0.5 * (dof + self.n_dim)
        parts += constant
        return np.asarray(parts)

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        return log_sum(self.log_parts(self.squared_distances(t)))


def log_sum(parts: Array) -> Array:
    """Log of the sum of exponentials over the first axis, all finite."""
    top = parts.max(axis=0)
    scaled = parts - top
    np.exp(scaled, out=scaled)
    return np.asarray(top + np.log(scaled.sum(axis=0)))


_MOST_COMPONENTS = 16
# Effective draws per entry of a component's covariance.
_DRAWS_PER_ENTRY = 5.0
_STEPS = 20
# Standard deviations up to this part of the mean are no spread.
_ROUNDING = 1e-12
# Components are widened a little: tails that are too light cost far more than too heavy ones.
_WIDEN = 1.07
_DOFS = (3.0, 6.0, 12.0, 30.0)


def moments(x: Array, weight: Array) -> tuple[Array, Array] | None:
    """Weighted mean and Cholesky factor of the covariance; None where it is degenerate."""
    mean = weight @ x
    centred = x - mean
    covariance = (centred * weight[:, None]).T @ centred
    scale = np.sqrt(np.diag(covariance))
    if not (np.isfinite(scale).all() and (scale > _ROUNDING * (1.0 + abs(mean))).all()):
        return None
    correlation = covariance / np.outer(scale, scale) + 1e-9 * np.eye(mean.size)
    try:
        return mean, scale[:, None] * np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return None


def fit_mixture(
    v: Array,
    weight: Array,
    mean: Array,
    cholesky: Array,
    effective: float,
    rng: np.random.Generator,
) -> Mixture:
    """Fit a mixture to weighted draws (k, d), weights (k,) of sum 1, of known `moments`.

    What the draws are worth limits the number of components; these start at draws picked at random.
    """
    d = mean.size
    m = int(np.clip(effective / (_DRAWS_PER_ENTRY * d**2), 1, _MOST_COMPONENTS))
    # In coordinates where the draws have no correlation and unit variance.
    x = np.linalg.solve(cholesky, (v - mean).T)
    centres = x.T[rng.choice(weight.size, size=m, p=weight)] if m > 1 else np.zeros((1, d))
    scale = (0.7 if m > 1 else 1.0) * np.eye(d)
    parts = _Parts(
        np.full(m, 1.0 / m), centres, np.repeat(scale[None], m, axis=0), np.full(m, _DOFS[2])
    )
    products = _products(x)
    for step in range(_STEPS):
        choose_dof = step in (_STEPS // 2 - 1, _STEPS - 1)
        parts = _improved(parts, x, products, weight, effective, choose_dof=choose_dof)
    back = (
        StudentT(mean + cholesky @ centre, _WIDEN * cholesky @ factor, float(dof))
        for centre, factor, dof in zip(parts.means, parts.choleskys, parts.dofs, strict=True)
    )
    return Mixture(parts.weights, tuple(back))


@dataclass(frozen=True)
class _Parts:
    """Components: weights (m,), means (m, d), Cholesky factors (m, d, d), dof (m,)."""

    weights: Array
    means: Array
    choleskys: Array
    dofs: Array


def _products(x: Array) -> Array:
    """Products of coordinates, shape (d, k) to (d (d + 1)/2, k)."""
    i, j = np.triu_indices(x.shape[0])
    return np.asarray(x[i] * x[j])


def _squared_distances(parts: _Parts, x: Array, products: Array) -> Array:
    """Squared Mahalanobis distances from each component, shape (m, k)."""
    i, j = np.triu_indices(x.shape[0])
    inverse = np.linalg.inv(parts.choleskys)
    precision = inverse.swapaxes(1, 2) @ inverse
    packed = precision[:, i, j] * np.where(i == j, 1.0, 2.0)
    linear = np.einsum("mab,mb->ma", precision, parts.means)
    constant = np.einsum("ma,ma->m", linear, parts.means)
    squared: Array = packed @ products - 2.0 * linear @ x + constant[:, None]
    return np.maximum(squared, 0.0)


def _improved(
    parts: _Parts, x: Array, products: Array, weight: Array, effective: float, *, choose_dof: bool
) -> _Parts:
    """One step on weighted, whitened draws.

    Covariances are drawn towards a half of the whole by as many draws as there are dimensions.
    """
    d = x.shape[0]
    squared = _squared_distances(parts, x, products)
    dof = parts.dofs[:, None]
    constant = np.log(parts.weights) - np.log(np.diagonal(parts.choleskys, axis1=1, axis2=2)).sum(
        axis=1
    )
    log_part = _log_kernel(squared, dof, d) + constant[:, None]
    share = np.exp(log_part - log_sum(log_part))
    share *= weight
    if choose_dof:
        dof = _likeliest_dof(squared, share, d)[:, None]
    # Draws far out in a component's tails weigh little: the Student-t's own weighting.
    tail = share * ((dof + d) / (dof + squared))
    mass = share.sum(axis=1)
    kept = mass * effective >= d
    kept[np.argmax(mass)] = True  # however little the draws are worth
    tail, mass, dof = tail[kept], mass[kept], dof[kept]
    means = tail @ x.T / tail.sum(axis=1)[:, None]
    second = np.empty((mass.size, d, d))
    i, j = np.triu_indices(d)
    second[:, i, j] = second[:, j, i] = tail @ products.T
    about = second - np.einsum("m,ma,mb->mab", tail.sum(axis=1), means, means)
    pseudo = d / effective
    covariances = (about + 0.5 * pseudo * np.eye(d)) / (mass + pseudo)[:, None, None]
    return _Parts(mass / mass.sum(), means, np.linalg.cholesky(covariances), dof[:, 0])


def _log_kernel(squared: Array, dof: Array | float, d: int) -> Array:
    """Log density of a Student-t at squared distances, but for its scale."""
    constant = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * np.log(dof)
    return np.asarray(constant - 0.5 * (dof + d) * np.log(1.0 + squared / dof))


def _likeliest_dof(squared: Array, share: Array, d: int) -> Array:
    value = [(share * _log_kernel(squared, dof, d)).sum(axis=1) for dof in _DOFS]
    return np.asarray(np.array(_DOFS)[np.argmax(value, axis=0)])


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
