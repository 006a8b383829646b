"""Which measurement would best separate hypotheses that are still in play."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.data.quantities import QUANTITIES, role_of
from calib.gap.campaigns import Campaigns
from calib.gap.effects import View
from calib.gap.fit import Fit
from calib.gap.noise import noise_conditions
from calib.gap.which import Ranking
from calib.inference.random import generator
from calib.models.base import Array

_IN_PLAY = 0.03
_MOST = 3
_N_CANDIDATES = 400
_N_DRAWS = 200


@dataclass(frozen=True)
class NextMeasurement:
    """Conditions at which one more measurement separates two hypotheses best.

    Parameters
    ----------
    conditions : mapping of str to float
        Canonical columns.
    gain_nats : float
        Expected log Bayes factor in favour of whichever is true, averaged over the two.
    """

    separates: tuple[str, str]
    conditions: Mapping[str, float]
    gain_nats: float


def next_measurements(data: Campaigns, ranking: Ranking, seed: int) -> tuple[NextMeasurement, ...]:
    """Search the conditions of both campaigns for the most telling ones."""
    in_play = [n for n in ranking.order if ranking.probability[n] >= _IN_PLAY][:_MOST]
    if len(in_play) < 2:
        return ()
    candidates = _candidates(data, generator(seed, "gap", "candidates"))
    view = data.at_conditions(candidates)
    moments = {name: _moments(data, _best(ranking, name), view, seed) for name in in_play}
    found = []
    for a, b in combinations(in_play, 2):
        gain = _gain(moments[a], moments[b])
        best = int(np.nanargmax(np.where(np.isfinite(gain), gain, -np.inf)))
        conditions = {name: float(values[best]) for name, values in candidates.items()}
        found.append(NextMeasurement((a, b), conditions, float(gain[best])))
    return tuple(found)


def _best(ranking: Ranking, name: str) -> Fit:
    return ranking.best(name)


def _candidates(data: Campaigns, rng: np.random.Generator) -> dict[str, Array]:
    """Combinations of values that either campaign has, slips evenly over their range."""
    candidates = {}
    lab = data.case.lab.columns
    for name, values in data.view.conditions.items():
        role = role_of(name)
        if name in QUANTITIES and QUANTITIES[name].role != "condition" and role != "order":
            continue
        both = np.concatenate([values, lab.get(name, values)])
        if role == "slip":
            candidates[name] = rng.uniform(both.min(), both.max(), _N_CANDIDATES)
        elif role == "order":
            candidates[name] = np.full(_N_CANDIDATES, data.view.order_range[1])
        else:
            candidates[name] = rng.choice(np.unique(both), _N_CANDIDATES)
    pressures = [data.view.column(role) or "" for role in ("pressure", "ground_pressure")]
    if all(p in candidates for p in pressures):
        # The two go together: pick rows, not values.
        row = rng.integers(len(data.case.field), size=_N_CANDIDATES)
        for p in pressures:
            candidates[p] = data.view.conditions[p][row]
    return candidates


def _moments(data: Campaigns, fit: Fit, view: View, seed: int) -> dict[str, tuple[Array, Array]]:
    """Predictive mean and variance of each output on the scale of the response, (n,) each."""
    psi = fit.draws(generator(seed, "gap", "moments", fit.forward.hypothesis.name), _N_DRAWS)
    with np.errstate(all="ignore"):
        location = fit.forward.field(psi, view)
    found = {}
    for o in data.outputs:
        noise = fit.noise[o.name].sd(noise_conditions(view))
        found[o.name] = (
            np.nanmean(location[o.name], axis=0),
            np.nanvar(location[o.name], axis=0) + noise**2,
        )
    return found


def _gain(a: dict[str, tuple[Array, Array]], b: dict[str, tuple[Array, Array]]) -> Array:
    """Half the symmetric Kullback-Leibler divergence of two normal predictions, (n,)."""
    total: Array = np.zeros(_N_CANDIDATES)
    for name, (mean_a, var_a) in a.items():
        mean_b, var_b = b[name]
        squared = np.square(mean_a - mean_b)
        total = total + 0.25 * ((var_a + squared) / var_b + (var_b + squared) / var_a - 2.0)
    return total
