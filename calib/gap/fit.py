"""A hypothesis fitted to both campaigns: draws of its posterior, and its evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.forward import Forward
from calib.gap.noise import Noise, Whitening, ln_averaged, most_probable
from calib.models.base import Array


@dataclass(frozen=True)
class Fit:
    """The posterior of a hypothesis.

    Parameters
    ----------
    noise : mapping of str to Noise
        The most probable one.
    log_evidence : float
        Of the prior with causes of any size.
    field_residuals : mapping of str to ndarray
        Standardised residuals of the field rows of each output, about the mean prediction.
    sample : ndarray, shape (draws, d)
        Draws of psi, all of the same weight.
    effective : float
        Number of independent draws that carry as much.
    """

    forward: Forward
    noise: Mapping[str, Noise]
    log_evidence: float
    field_residuals: Mapping[str, Array]
    sample: Array
    effective: float = np.inf

    @cached_property
    def psi(self) -> Array:
        """Posterior mean, shape (d,)."""
        return np.asarray(self.sample.mean(axis=0))

    @cached_property
    def covariance(self) -> Array:
        """Posterior covariance, shape (d, d)."""
        return np.atleast_2d(np.cov(self.sample, rowvar=False, bias=True))

    def draws(self, rng: np.random.Generator, size: int) -> Array:
        """Draw psi, each draw of the sample as often as any other, shape (size, d)."""
        return np.asarray(self.sample[np.resize(rng.permutation(len(self.sample)), size)])


class Residuals:
    """Observed minus predicted of lab then field rows, one output after the other.

    Attributes
    ----------
    parts : dict of str to slice
        Rows of each output.
    field : ndarray of int
        Places of the field rows.
    linear : slice
        Coordinates of a free discrepancy, which the residuals are linear in.
    """

    def __init__(self, data: Campaigns, forward: Forward) -> None:
        self.data, self.forward = data, forward
        ends = np.cumsum([at.slip.size for at in data.at_rows.values()]).tolist()
        starts = [0, *ends[:-1]]
        self.parts = {
            o.name: slice(a, b) for o, a, b in zip(data.outputs, starts, ends, strict=True)
        }
        self.field = np.concatenate(
            [np.arange(b - o.rows.size, b) for o, b in zip(data.outputs, ends, strict=True)]
        )
        self.linear = forward.smooth

    def raw(self, psi: Array) -> Array:
        """Evaluate, shape (k, d) to (k, N)."""
        return self.beside(*self.forward.campaigns(psi))

    def beside(self, lab: Mapping[str, Array], field: Mapping[str, Array]) -> Array:
        """Observed minus what is predicted for both campaigns."""
        both = [part for o in self.data.outputs for part in (lab[o.name], field[o.name][:, o.rows])]
        return np.asarray(self.data.observed - np.concatenate(both, axis=1))

    def of_field(self, values: Mapping[str, Array]) -> Array:
        """Predictions (k, n) of each output at the field rows that have it, shape (k, rows)."""
        return np.concatenate([values[o.name][:, o.rows] for o in self.data.outputs], axis=1)

    def linear_jacobian(self, psi: Array) -> Array:
        """Derivatives of the field rows' predictions by the linear coordinates, (linear, rows)."""
        forward, view = self.forward, self.data.view
        found = np.zeros((self.linear.stop - self.linear.start, self.field.size))
        end = 0
        for o in self.data.outputs:
            rows, end = slice(end, end + o.rows.size), end + o.rows.size
            if o.name in forward.smooth_slices:
                part = forward.smooth_slices[o.name]
                here = slice(part.start - self.linear.start, part.stop - self.linear.start)
                shapes = forward.discrepancy.shapes(psi[forward.threshold :], view, o.name)
                found[here, rows] = shapes.reshape(-1, shapes.shape[-1])[:, o.rows]
        return found

    def sds(self, noise: Mapping[str, Noise]) -> Array:
        """Noise sd of every row, shape (N,)."""
        return np.concatenate([noise[o].sd(at) for o, at in self.data.at_rows.items()])

    def whitening(self, noise: Mapping[str, Noise]) -> Whitening:
        """Return what makes the residuals of all rows independent standard normals."""
        return Whitening.joined([Whitening.of(noise[o], at) for o, at in self.data.at_rows.items()])

    def products(self, one: Array, other: Array) -> dict[str, Array]:
        """Products of residuals (..., N) of each output, as its noise needs them."""
        at = self.data.at_rows
        return {o: at[o].products(one[..., p], other[..., p]) for o, p in self.parts.items()}

    def ln_averaged(self, raw: Array) -> Array:
        """Log likelihood, averaged over the noise of each output, shape (m, N) to (m,)."""
        at = self.data.at_rows
        return np.sum([ln_averaged(p, at[o]) for o, p in self.products(raw, raw).items()], axis=0)

    def noise_of(self, products: Mapping[str, Array]) -> dict[str, Noise]:
        """Most probable noise, by the mean products of residuals of each output."""
        at = self.data.at_rows
        return {o: most_probable(p[None], at[o])[0] for o, p in products.items()}
