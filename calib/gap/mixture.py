"""Draws of the truth under all hypotheses at once, each as often as it is probable."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.effects import View
from calib.gap.fit import Fit
from calib.gap.noise import noise_conditions
from calib.gap.which import Ranking
from calib.inference.random import generator
from calib.models.base import Array

N_DRAWS = 1200
# Hypotheses less probable than this are not drawn from.
_NEGLIGIBLE = 2e-3
# Draws of each that are kept.
_KEPT = 500


@dataclass(frozen=True)
class Truth:
    """Draws at some conditions, on the outputs' own scales (kN, mm, g/cm^3).

    Parameters
    ----------
    simulator : mapping of str to ndarray, shape (draws, n)
        What the simulator says with the drawn parameters.
    truth : mapping of str to ndarray, shape (draws, n)
        What happens in the field.
    noise : mapping of str to ndarray, shape (draws, n)
        Sd of a measurement there.
    measured : mapping of str to ndarray, shape (draws, n)
        The truth with noise.
    weight : ndarray, shape (draws,)
        Of each draw; they sum to one.
    """

    simulator: Mapping[str, Array]
    truth: Mapping[str, Array]
    noise: Mapping[str, Array]
    measured: Mapping[str, Array]
    weight: Array

    def quantile(self, values: Array, q: float) -> Array:
        """Weighted quantile over the draws, shape (draws, n) to (n,)."""
        order = np.argsort(values, axis=0)
        ordered = np.take_along_axis(values, order, axis=0)
        cumulative = np.cumsum(self.weight[order], axis=0)
        index = np.argmax(cumulative >= q - 1e-12, axis=0)
        return np.asarray(ordered[index, np.arange(values.shape[1])])

    @property
    def means(self) -> dict[str, Array]:
        """Mean of the truth of every output, shapes (n,)."""
        return {name: self.mean(values) for name, values in self.truth.items()}

    def mean(self, values: Array) -> Array:
        """Weighted mean over the draws, shape (n,)."""
        return np.asarray(self.weight @ values)


@dataclass(frozen=True)
class Mixture:
    """Fits and how often each is drawn from."""

    data: Campaigns
    fits: tuple[Fit, ...]
    probability: tuple[float, ...]
    seed: int

    def at(self, view: View, without: str | None = None, left_out: Collection[str] = ()) -> Truth:
        """Draw the truth at conditions.

        Parameters
        ----------
        view : View
            From `Campaigns.at` for conditions other than the field's.
        without : str, optional
            A cause, part of every fit: what is predicted without it is in the simulator's place.
        left_out : collection of str, optional
            Causes that no longer act, in the fits that have them.
        """
        parts = [
            self._part(fit, probability, view, i, without, left_out)
            for i, (fit, probability) in enumerate(zip(self.fits, self.probability, strict=True))
        ]
        weight = np.concatenate([part.weight for part in parts])
        names = self.data.names
        return Truth(
            {n: np.concatenate([part.simulator[n] for part in parts]) for n in names},
            {n: np.concatenate([part.truth[n] for part in parts]) for n in names},
            {n: np.concatenate([part.noise[n] for part in parts]) for n in names},
            {n: np.concatenate([part.measured[n] for part in parts]) for n in names},
            weight / weight.sum(),
        )

    def _part(
        self, fit: Fit, probability: float, view: View, index: int, without: str | None,
        left_out: Collection[str],
    ) -> Truth:  # fmt: skip
        """Draw under one hypothesis; the weights carry its probability."""
        size = max(100, int(N_DRAWS * probability))
        rng = generator(self.seed, "gap", "truth", fit.forward.hypothesis.name, index)
        psi = fit.draws(rng, size)
        full, plain = fit.forward.field_and_plain(psi, view)
        if left_out:
            full = fit.forward.without(psi, view, *left_out)
        if without is not None:
            plain = fit.forward.without(psi, view, without)
        # Draws for which a model has no value somewhere are left out for all outputs.
        good = np.ones(size, dtype=np.bool_)
        for o in self.data.outputs:
            good &= np.isfinite(plain[o.name]).all(axis=1) & np.isfinite(full[o.name]).all(axis=1)
        simulator, truth, noise, measured = {}, {}, {}, {}
        for o in self.data.outputs:
            bound, location = o.problem.bound, full[o.name][good]
            sd = fit.noise[o.name].sd(noise_conditions(view)) * np.ones_like(location)
            simulator[o.name] = bound.from_response(plain[o.name][good])
            truth[o.name] = bound.from_response(location)
            noise[o.name] = sd * truth[o.name] if bound.model.response == "log" else sd
            measured[o.name] = bound.from_response(location + sd * rng.standard_normal(sd.shape))
        n = int(good.sum())
        return Truth(simulator, truth, noise, measured, np.full(n, probability / max(n, 1)))


def mixture(data: Campaigns, ranking: Ranking, seed: int) -> Mixture:
    """Gather the fits that matter, hypotheses by probability, their variants by evidence."""
    fits: list[Fit] = []
    weights: list[float] = []
    for name in ranking.order:
        if ranking.probability[name] < _NEGLIGIBLE and fits:
            continue
        group = ranking.fits[name]
        score = np.array(ranking.scores[name])
        share = np.exp(score - score.max())
        share /= share.sum()
        for f, s in zip(group, share, strict=True):
            if s > 0.05:
                fits.append(_thinned(f))
                weights.append(ranking.probability[name] * float(s))
    total = sum(weights)
    return Mixture(data, tuple(fits), tuple(w / total for w in weights), seed)


def _thinned(fit: Fit) -> Fit:
    """A fit with as many draws as predictions need and a file should hold.

    They are in the order of the pool that they were picked from: every third stands for all.
    """
    if fit.sample is None:
        return fit
    return replace(fit, sample=fit.sample[:: max(len(fit.sample) // _KEPT, 1)])
