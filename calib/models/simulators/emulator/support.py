"""Where a simulator has a value at all, learned from the runs that failed."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array
from calib.models.simulators.emulator.kriging import AT_ONCE, correlation

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
        found = np.empty(len(at))
        for i in range(0, len(at), AT_ONCE):
            found[i : i + AT_ONCE] = (
                correlation(at[i : i + AT_ONCE], self.x, self.lengths) @ self.weights
            )
        # Far from all runs it is zero: nothing speaks against a value there.
        return self.amplitude * found


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
