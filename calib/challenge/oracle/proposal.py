"""Where the dials of a cause are drawn from once a field has said where to look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

type Array = NDArray[np.float64]

_FREEDOM = 5.0


@dataclass(frozen=True)
class Proposal:
    """A mixture of Student t distributions of five degrees of freedom.

    Attributes
    ----------
    share : array
        Shares of the components, ``(C,)``, which sum to one.
    centre : array
        Shape ``(C, D)``.
    root : array
        Cholesky factors of the scale matrices, lower, ``(C, D, D)``.
    """

    share: Array
    centre: Array
    root: Array

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Return draws, shape ``(count, D)``."""
        which = rng.choice(self.share.size, count, p=self.share)
        normal = rng.standard_normal((count, self.centre.shape[1]))
        heavy = np.sqrt(_FREEDOM / rng.chisquare(_FREEDOM, count))[:, None]
        steps = np.einsum("nij,nj->ni", self.root[which], normal)
        return np.asarray(self.centre[which] + heavy * steps, dtype=np.float64)

    def log_density(self, at: Array) -> Array:
        """Return the logarithm of the density at ``(N, D)``, shape ``(N,)``."""
        d = self.centre.shape[1]
        parts = []
        for share, centre, root in zip(self.share, self.centre, self.root, strict=True):
            scaled = np.linalg.solve(root, (at - centre).T)
            size = np.sum(scaled**2, axis=0)
            norm = gammaln(0.5 * (_FREEDOM + d)) - gammaln(0.5 * _FREEDOM)
            norm -= 0.5 * d * np.log(_FREEDOM * np.pi) + np.sum(np.log(np.diag(root)))
            tail = -0.5 * (_FREEDOM + d) * np.log1p(size / _FREEDOM)
            parts.append(np.log(share) + norm + tail)
        return np.asarray(logsumexp(parts, axis=0), dtype=np.float64)


def log_prior(dials: Array, normal: NDArray[np.bool_]) -> Array:
    """Return the logarithm of the dials' prior density within their range.

    Parameters
    ----------
    dials : array
        Shape ``(N, D)``.
    normal : array of bool
        Which are standard normal, ``(D,)``; the others are uniform on [0, 1].
    """
    bells = dials[:, normal]
    return np.asarray(-0.5 * np.sum(bells**2 + np.log(2.0 * np.pi), axis=1), dtype=np.float64)
