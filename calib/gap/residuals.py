"""Residuals of both campaigns as functions of a hypothesis's parameters psi, many psi at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calib.gap.campaigns import Campaigns
from calib.gap.forward import Forward, fields_of_all
from calib.gap.noise import Noise, ln_averaged, most_probable
from calib.inference.sampling.mode import prior_widths
from calib.models.base import Array

# Guesses closer than this (in prior sds) climb to the same mode.
_APART = 0.7
# Step of differences, in prior sds.
_DIFFERENCE = 1e-4
# Vectors at once whose predictions stay in the processor's cache.
_AT_ONCE = 1024


class Coordinates:
    """The parameters of a hypothesis, or of several: what their priors say, shape (d,) or (m, d).

    Attributes
    ----------
    loc, precision : ndarray
        Means and inverse sds of normal priors; zeros of uniform ones.
    """

    loc: Array
    precision: Array
    width: Array
    lower: Array
    upper: Array

    def __init__(self, data: Campaigns) -> None:
        self.data = data
        sizes = [at.slip.size for at in data.at_rows.values()]
        ends = np.cumsum(sizes).tolist()
        self.parts = {
            o.name: slice(end - size, end)
            for o, end, size in zip(data.outputs, ends, sizes, strict=True)
        }

    def clip(self, psi: Array) -> Array:
        """Move psi inside its bounds."""
        margin = 1e-7 * self.width
        return np.clip(psi, self.lower + margin, self.upper - margin)

    def blocked(self, psi: Array, direction: Array) -> NDArray[np.bool_]:
        """Which coordinates are at a bound that the direction leads beyond, shape (k, d)."""
        tiny = 2e-7 * self.width
        return ((psi <= self.lower + tiny) & (direction < 0)) | (
            (psi >= self.upper - tiny) & (direction > 0)
        )

    def costs(self, psi: Array, raw: Array, sds: Array) -> Array:
        """Minus log posterior but for constants.

        Parameters
        ----------
        psi : ndarray, shape (..., d)
        raw, sds : ndarray, shape (..., N)

        Returns
        -------
        ndarray, shape (...)
        """
        with np.errstate(over="ignore"):  # a cost beyond all numbers is one as well
            squares = np.square(raw / sds).sum(axis=-1)
            squares += np.square((psi - self.loc) * self.precision).sum(axis=-1)
            return np.asarray(0.5 * squares + np.log(sds).sum(axis=-1))

    def around(self, psi: Array) -> Array:
        """Points beside psi that tell the derivatives there, shape (m, d) to (m d, d)."""
        return (psi[:, None] + self._steps(psi)[:, None] * np.eye(psi.shape[1])).reshape(
            -1, psi.shape[1]
        )

    def jacobian(self, psi: Array, raw: Array, moved: Array) -> Array:
        """Derivatives of the residuals.

        Parameters
        ----------
        psi : ndarray, shape (m, d)
        raw : ndarray, shape (m, N)
            Residuals there.
        moved : ndarray, shape (m d, N)
            Residuals at the points `around`.

        Returns
        -------
        ndarray, shape (m, d, N)
        """
        change = moved.reshape(*psi.shape, -1) - raw[:, None]
        # Beside ground where the model has no value nothing is known.
        change = np.where(np.isfinite(change), change, 0.0)
        return np.asarray(change / self._steps(psi)[:, :, None])

    def _steps(self, psi: Array) -> Array:
        step = _DIFFERENCE * self.width
        return np.where(psi + step > self.upper, -step, step)

    def update_noises(self, raw: Array, left: Array) -> list[dict[str, Noise]]:
        """Noise scales that maximise the marginal likelihood, parameters allowed for.

        Parameters
        ----------
        raw : ndarray, shape (m, N)
        left : ndarray, shape (m, N)
            The part of the variance of each that the parameters did not take up.
        """
        at = self.data.at_rows
        squared = np.square(raw) / left
        found = [most_probable(squared[:, part], at[o]) for o, part in self.parts.items()]
        return [dict(zip(self.parts, each, strict=True)) for each in zip(*found, strict=True)]

    def ln_averaged(self, raw: Array) -> Array:
        """Log likelihood, averaged over the noise of each output, shape (m, N) to (m,)."""
        at = self.data.at_rows
        return np.sum(
            [ln_averaged(np.square(raw[:, part]), at[o]) for o, part in self.parts.items()], axis=0
        )


def variance_left(scaled: Array, inverse: Array) -> Array:
    """The part of each residual's variance that parameters do not take up, shape (m, N).

    By derivatives over their sds (m, d, N) and covariances (m, d, d).
    """
    leverage = (scaled * (inverse @ scaled)).sum(axis=1)
    return np.minimum(np.maximum(1.0 - leverage, 0.1), 1.0)


def diagonal(values: Array) -> Array:
    """Return diagonal matrices, shape (..., d) to (..., d, d)."""
    return values[..., None] * np.eye(values.shape[-1])


class Residuals(Coordinates):
    """Observed minus predicted of lab then field rows, one output after the other.

    Attributes
    ----------
    curved, linear : ndarray of int, slice
        Coordinates whose derivatives are differences, and those of a free discrepancy, which the
        residuals are linear in.
    """

    def __init__(self, data: Campaigns, forward: Forward) -> None:
        super().__init__(data)
        self.forward = forward
        loc, _, self.lower, self.upper, self.precision = forward.priors._arrays
        self.loc = np.where(self.precision > 0, loc, 0.0)
        self.width = prior_widths(forward.priors)
        self.linear = forward.smooth
        self.curved = np.delete(np.arange(self.loc.size), self.linear)

    def raw(self, psi: Array) -> Array:
        """Evaluate, shape (k, d) to (k, N)."""
        return self.beside(*self.forward.campaigns(psi))

    def beside(self, lab: Mapping[str, Array], field: Mapping[str, Array]) -> Array:
        """Observed minus what is predicted for both campaigns."""
        predicted: list[Array] = []
        for o in self.data.outputs:
            there = field[o.name]
            predicted += lab[o.name], there if o.rows.size == there.shape[1] else there[:, o.rows]
        raw: Array = np.concatenate(predicted, axis=1)
        return np.subtract(self.data.observed, raw, out=raw)

    def linear_jacobian(self, psi: Array) -> Array:
        """Derivatives by the coordinates that residuals are linear in, shape (m, linear, N)."""
        forward, view = self.forward, self.data.view
        found = np.zeros((len(psi), self.linear.stop - self.linear.start, self.data.observed.size))
        threshold = psi[:, forward.threshold :].ravel()
        for o in self.data.outputs:
            if o.name in forward.smooth_slices:
                part, rows = forward.smooth_slices[o.name], self.parts[o.name]
                here = slice(part.start - self.linear.start, part.stop - self.linear.start)
                shapes = forward.discrepancy.shapes(threshold, view, o.name)[..., o.rows]
                found[:, here, rows.stop - o.rows.size : rows.stop] = -shapes
        return found

    def sds(self, noise: Mapping[str, Noise]) -> Array:
        """Noise sd of every row, shape (N,)."""
        return np.concatenate([noise[o].sd(at) for o, at in self.data.at_rows.items()])

    def best(self, costs: Array, candidates: Array, count: int) -> list[int]:
        """Return which candidates are best and lie apart from each other, at most `count`."""
        picked: list[int] = []
        for i in np.argsort(np.where(np.isfinite(costs), costs, np.inf), kind="stable").tolist():
            apart = np.abs((candidates[picked] - candidates[i]) / self.width).max(axis=1) > _APART
            if apart.all():
                picked.append(i)
            if len(picked) == count:
                break
        return picked


def residuals_of_all(asked: Sequence[tuple[Residuals, Array]]) -> list[Array]:
    """Evaluate problems on the same campaigns at psi of each, shapes (k, d) to (k, N).

    Hypotheses differ in what they add to the simulators: these are asked once for all of them.
    """
    found: dict[int, Array] = {}
    batch: list[int] = []
    size = 0
    for i, (_, psi) in enumerate(asked):
        if batch and size + len(psi) > _AT_ONCE:
            found |= _batched(asked, batch)
            batch, size = [], 0
        batch.append(i)
        size += len(psi)
    found |= _batched(asked, batch)
    return [found[i] for i in range(len(asked))]


def _batched(asked: Sequence[tuple[Residuals, Array]], batch: list[int]) -> dict[int, Array]:
    if not batch:
        return {}
    forward, view = asked[batch[0]][0].forward, asked[batch[0]][0].data.view
    parts = [(asked[i][0].forward, asked[i][1]) for i in batch]
    shared = np.concatenate([psi[:, : forward.n_shared] for _, psi in parts])
    lab, plain = forward.plain(shared)
    ends = np.cumsum([len(psi) for _, psi in parts])
    raw = asked[batch[0]][0].beside(lab, fields_of_all(parts, view, plain))
    return dict(zip(batch, np.split(raw, ends[:-1]), strict=True))
