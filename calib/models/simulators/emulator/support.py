"""Where a simulator has a value at all, learned from the runs that failed."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array

__all__ = ["Support", "learn_support"]

_LENGTHS = (0.2, 10.0)


@dataclass(frozen=True)
class Support:
    """The probability that a run has a value, by a Gaussian process behind a logistic curve.

    Parameters
    ----------
    x : ndarray, shape (n, d)
    weights : ndarray, shape (n,)
        At its mode the latent function is the kernel times these (Rasmussen & Williams 2006,
        Eq 3.21).
    lengths : ndarray, shape (d,)
    amplitude : float
    """

    x: Array
    weights: Array
    lengths: Array
    amplitude: float

    def latent(self, at: Array) -> Array:
        """Return what is positive where a value is the likelier outcome, (k, d) to (k,)."""
        a, b = at / self.lengths, self.x / self.lengths
        squared = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2.0 * (a @ b.T)
        # Far from all runs it is zero: nothing speaks against a value there.
        return np.asarray(self.amplitude * np.exp(-0.5 * np.maximum(squared, 0.0)) @ self.weights)


def learn_support(x: Array, ok: NDArray[np.bool_]) -> Support | None:
    """Learn from runs; None where none failed.

    Parameters
    ----------
    x : ndarray, shape (n, d)
        Parameters in units of the prior's sds.
    ok : ndarray of bool, shape (n,)
    """
    if ok.all() or not ok.any():
        return None
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessClassifier
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    kernel = ConstantKernel(10.0, (1.0, 1e3)) * RBF(np.full(x.shape[1], 1.5), _LENGTHS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted = GaussianProcessClassifier(kernel).fit(x, ok).base_estimator_
    found = fitted.kernel_
    weights = fitted.y_train_ - fitted.pi_
    return Support(
        x, np.asarray(weights), np.atleast_1d(found.k2.length_scale) * np.ones(x.shape[1]),
        float(found.k1.constant_value),
    )  # fmt: skip
