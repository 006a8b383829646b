"""Which causes act, whatever acts besides, and what part of the gap each of them is.

The probability that a cause acts is the sum over all explanations that it is a part of. Its share
is found from draws of them: with g_i what goes from the field's prediction when cause i is taken
away with the others in place, in noise sds over the field rows of all outputs,

    share_i = rms(g_i) / sum_j rms(g_j),

the free discrepancy being one of the j, the remainder. A cause has share 0 where it does not act;
draws without a gap have no shares. So the shares' means sum to one with the remainder's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.fit import Fit
from calib.gap.mixture import Mixture
from calib.gap.noise import noise_conditions
from calib.gap.where import Region, regions, row_gaps
from calib.gap.which import Ranking
from calib.inference.random import generator
from calib.models.base import Array

UNLISTED = "unknown"
_N_DRAWS = 800
# What a cause alone is said to do is wrong by so much (relative): what fits the sum of several as
# well may go to another of them, by more than a formula is wrong about a cause alone. It changes no
# share of a cause that acts alone. Of 347 causes of development cases (large gaps of 4243 and 4244)
# 90 % intervals hold 290 with 0.2, 301 with 0.3, 307 with 0.4; of 78 (hard, 4244) 69, 70 and 70.
_SIZE_ERROR = 0.35
# Below this the remainder's place is nowhere.
_SOMEWHERE = 0.1


@dataclass(frozen=True)
class Included:
    """One cause: the probability that it acts, and its share of the gap with a 90 % interval."""

    probability: float
    share: float
    share_interval: tuple[float, float]


@dataclass(frozen=True)
class Inclusion:
    """All causes that were tested, and what is left to something that is not listed.

    Parameters
    ----------
    causes : mapping of str to Included
        Effects, dependences and ``parameter_shift``, the most probable first.
    remainder : Included
        Something unlisted, alone or beside listed causes.
    where : tuple of Region
        Where the remainder lies.
    """

    causes: Mapping[str, Included]
    remainder: Included
    where: tuple[Region, ...]

    @property
    def acting(self) -> list[str]:
        """Causes that are more likely to act than not, the largest share first."""
        found = [name for name, c in self.causes.items() if c.probability >= 0.5]
        return sorted(found, key=lambda name: -self.causes[name].share)


def inclusion_probability(probability: Mapping[str, float]) -> dict[str, float]:
    """Return for every cause that is a part of some explanation how probable it is to act.

    Parameters
    ----------
    probability : mapping of str to float
        Of each explanation, by the names of its causes joined by ``+``.
    """
    found: dict[str, float] = {}
    for name, p in probability.items():
        for cause in name.split("+"):
            if cause != "none":
                found[cause] = found.get(cause, 0.0) + p
    return {name: min(p, 1.0) for name, p in found.items()}


def inclusion(mixed: Mixture, ranking: Ranking) -> Inclusion:
    """Work out which causes act, and their shares.

    Parameters
    ----------
    ranking : Ranking
        That it was made from.
    """
    data = mixed.data
    found = inclusion_probability(ranking.probability)
    names = sorted((n for n in found if n != UNLISTED), key=lambda n: -found[n])
    shares, weight = _shares(mixed, [*names, UNLISTED])
    included = {
        name: Included(found.get(name, 0.0), *_mean_and_interval(shares[:, i], weight))
        for i, name in enumerate([*names, UNLISTED])
    }
    remainder = included.pop(UNLISTED)
    where = _where(data, mixed) if remainder.probability >= _SOMEWHERE else ()
    return Inclusion(included, remainder, where)


def _shares(mixed: Mixture, names: list[str]) -> tuple[Array, Array]:
    """Share of each cause in each draw that has a gap, shape (draws, causes), and weights."""
    shares, weights = [np.zeros((0, len(names)))], [np.zeros(0)]
    for i, (fit, probability) in enumerate(zip(mixed.fits, mixed.probability, strict=True)):
        causes = fit.forward.causes
        if not causes:
            continue
        size = max(60, int(_N_DRAWS * probability))
        rng = generator(mixed.seed, "gap", "shares", fit.forward.hypothesis.name, i)
        rms = _sizes(mixed.data, fit, fit.draws(rng, size))
        rms *= np.exp(_SIZE_ERROR * rng.standard_normal(rms.shape))
        rms = rms[np.isfinite(rms).all(axis=1) & (rms.sum(axis=1) > 0.0)]
        part = np.zeros((rms.shape[0], len(names)))
        part[:, [names.index(c) for c in causes]] = rms / rms.sum(axis=1, keepdims=True)
        shares.append(part)
        weights.append(np.full(rms.shape[0], probability / max(rms.shape[0], 1)))
    weight = np.concatenate(weights)
    return np.concatenate(shares), weight / weight.sum()


def _sizes(data: Campaigns, fit: Fit, psi: Array) -> Array:
    """Rms of what goes with each cause over all field rows, in noise sds, shape (k, causes)."""
    forward, at = fit.forward, noise_conditions(data.view)
    full = forward.field(psi, data.view)
    columns = []
    for cause in forward.causes:
        other = forward.without(psi, data.view, cause)
        gone = [
            (full[o.name] - other[o.name])[:, o.rows] / fit.noise[o.name].sd(at.rows(o.rows))
            for o in data.outputs
        ]
        columns.append(np.sqrt(np.square(np.concatenate(gone, axis=1)).mean(axis=1)))
    return np.stack(columns, axis=1)


def _mean_and_interval(share: Array, weight: Array) -> tuple[float, tuple[float, float]]:
    if not share.size:
        return 0.0, (0.0, 0.0)
    order = np.argsort(share)
    cumulative = np.cumsum(weight[order])
    low, high = (float(share[order][np.searchsorted(cumulative, q)]) for q in (0.05, 0.95))
    mean = float(weight @ share)
    return mean, (min(low, mean), max(high, mean))


def _where(data: Campaigns, mixed: Mixture) -> tuple[Region, ...]:
    """Where what is not listed lies: the gap that is left once the listed causes are in."""
    unlisted = [
        (fit, p)
        for fit, p in zip(mixed.fits, mixed.probability, strict=True)
        if UNLISTED in fit.forward.causes
    ]
    if not unlisted:
        return ()
    total = sum(p for _, p in unlisted)
    of_these = replace(
        mixed,
        fits=tuple(fit for fit, _ in unlisted),
        probability=tuple(p / total for _, p in unlisted),
    )
    truth = of_these.at(data.view, without=UNLISTED)
    return regions(data, truth, row_gaps(data, truth))
