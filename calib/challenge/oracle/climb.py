"""Find where a cause fits a field best, by Gauss-Newton steps from several places at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]
type Predict = Callable[[Array], Array]

_STEP = 0.01
_STEPS = 7
_EDGE = 1e-3
_WIDE = 6.0
_EVEN_SD = 12.0**-0.5  # of a uniform dial


@dataclass(frozen=True)
class Coordinates:
    """What the coordinates of a fit are: dials and logarithms of strengths.

    Attributes
    ----------
    low, high : array
        Their range, ``(n,)``.
    normal : array of bool
        Which have a standard normal prior; the others' is even.
    """

    low: Array
    high: Array
    normal: NDArray[np.bool_]

    @staticmethod
    def of_dials(normal: NDArray[np.bool_]) -> Coordinates:
        """Return those of dials alone."""
        low = np.where(normal, -_WIDE, _EDGE)
        return Coordinates(low, np.where(normal, _WIDE, 1.0 - _EDGE), normal)

    def and_strength(self, low: float, high: float) -> Coordinates:
        """Return these and the logarithm of a strength after them."""
        return self.joined(Coordinates(np.array([low]), np.array([high]), np.array([False])))

    def joined(self, other: Coordinates) -> Coordinates:
        """Return these and others after them."""
        return Coordinates(
            np.concatenate([self.low, other.low]),
            np.concatenate([self.high, other.high]),
            np.concatenate([self.normal, other.normal]),
        )


@dataclass(frozen=True)
class Peak:
    """A best fit.

    Attributes
    ----------
    at : array
        Coordinates, ``(n,)``.
    value : float
        Logarithm of likelihood times the normal dials' prior, relative to no gap.
    covariance : array
        Of the coordinates about it, ``(n, n)``, where even dials are taken as normal ones.
    """

    at: Array
    value: float
    covariance: Array


def climb(predict: Predict, residual: Array, coordinates: Coordinates, starts: Array) -> list[Peak]:
    """Return the best fit reached from each start, the best first.

    Parameters
    ----------
    predict : callable
        Whitened gaps ``(B, M)`` at coordinates ``(B, n)``.
    residual : array
        Whitened readings less their expectation without gap, ``(M,)``.
    coordinates : Coordinates
        Ranges and priors.
    starts : array
        Shape ``(S, n)``.
    """
    low, high = coordinates.low, coordinates.high
    ridge = coordinates.normal.astype(np.float64)
    count, n = starts.shape
    here = np.clip(starts, low, high)
    miss, slopes = _derivatives(predict, residual, here, low, high)
    value = _objective(miss, here, ridge)
    damping = np.full(count, 1e-2)
    for _ in range(_STEPS):
        square = np.einsum("smi,smj->sij", slopes, slopes) + np.diag(ridge)
        pull = np.einsum("smi,sm->si", slopes, miss) - ridge * here
        diagonal = np.einsum("sii->si", square) + 1e-9
        held = square + (damping[:, None] * diagonal)[:, :, None] * np.eye(n)
        step = np.linalg.solve(held, pull[:, :, None])[:, :, 0]
        there = np.clip(here + step, low, high)
        new_miss, new_slopes = _derivatives(predict, residual, there, low, high)
        new_value = _objective(new_miss, there, ridge)
        better = new_value < value
        here = np.where(better[:, None], there, here)
        miss = np.where(better[:, None], new_miss, miss)
        slopes = np.where(better[:, None, None], new_slopes, slopes)
        gain = np.where(better, value - new_value, 0.0)
        value, damping = np.where(better, new_value, value), damping * np.where(better, 0.2, 6.0)
        if gain.max() < 0.05 and better.any():
            break
    prior = np.where(coordinates.normal, 1.0, _EVEN_SD**-2)
    square = np.einsum("smi,smj->sij", slopes, slopes) + np.diag(prior)
    nothing = 0.5 * float(residual @ residual)
    peaks = [
        Peak(here[i], nothing - float(value[i]), np.linalg.inv(square[i])) for i in range(count)
    ]
    return sorted(peaks, key=lambda peak: -peak.value)


def _objective(miss: Array, here: Array, ridge: Array) -> Array:
    return np.asarray(0.5 * (np.sum(miss**2, axis=1) + here**2 @ ridge), dtype=np.float64)


def _derivatives(
    predict: Predict, residual: Array, here: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """Return what is left of the residual, ``(S, M)``, and the gaps' slopes, ``(S, M, n)``."""
    count, n = here.shape
    steps = np.where(here + _STEP > high, -_STEP, _STEP)
    moved = here[:, None, :] + np.concatenate([np.zeros((1, n)), np.eye(n)]) * steps[:, None, :]
    gaps = predict(moved.reshape(-1, n)).reshape(count, n + 1, -1)
    slopes = (gaps[:, 1:] - gaps[:, :1]) / steps[:, :, None]
    return residual - gaps[:, 0], slopes.transpose(0, 2, 1)
