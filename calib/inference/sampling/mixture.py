"""Mixtures of multivariate Student-t."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
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
