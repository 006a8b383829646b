"""Which measurement would best separate hypotheses that are still in play.

What a design could show, worked out before any field outcome is looked at.

Each effect is drawn from its prior and its signature computed on the field's conditions, in noise
sds of the laboratory. What the simulator's parameters could take up instead, given how well the
lab determined them, is projected out with the metric C^-1, C = I + J S J', where J is the
simulator's sensitivity and S the lab's posterior covariance. Left are: the part that is absorbed,
the smallest size that is told from noise, and the effects that look alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag

from calib.data.quantities import QUANTITIES, role_of
from calib.gap.campaigns import Campaigns
from calib.gap.constants import ALIKE, MIN_EFFECT_SIZE, PRIOR
from calib.gap.effects import View
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.gap.noise import Noise, noise_conditions
from calib.inference.mode import hessian_scale, prior_widths
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array


@dataclass(frozen=True)
class Identifiability:
    """What the design can show.

    Parameters
    ----------
    absorbed : mapping of str to float
        Part of each effect's signature (squared) that the simulator's parameters take up.
    detectable : mapping of str to float
        Smallest size that is told from noise with 80 % power, in noise sds rms over the field rows
        of the output where it is largest; infinite if no believable size is.
    cosine_similarity : mapping of (str, str) to float
        Cosine between what is left of two effects, best match over their priors.
    idle : tuple of str
        Effects that change nothing the models of this case predict.
    """

    absorbed: Mapping[str, float]
    detectable: Mapping[str, float]
    cosine_similarity: Mapping[tuple[str, str], float]
    idle: tuple[str, ...] = ()

    @property
    def alike(self) -> list[tuple[str, str]]:
        """Pairs that this design cannot tell apart."""
        return [pair for pair, value in self.cosine_similarity.items() if value >= ALIKE]


def identifiability(
    data: Campaigns,
    single: list[Hypothesis],
    lab_mode: Mapping[str, Array],
    noise: Mapping[str, Noise],
    seed: int,
) -> Identifiability:
    """Work out what each effect would do on a design.

    Parameters
    ----------
    data : Campaigns
        Of which only conditions and lab outcomes are used.
    lab_mode, noise : mapping
        Of the simulators, from the lab alone.
    """
    root = _metric_root(data, lab_mode, noise)
    raw = {h.name: _signatures(data, h, lab_mode, noise, seed) for h in single}
    idle = tuple(name for name, g in raw.items() if not (np.abs(g) > 1e-6).any())
    raw = {name: g for name, g in raw.items() if name not in idle}
    left = {name: g @ root.T for name, g in raw.items()}
    rows = [o.rows.size for o in data.outputs]
    # An effect shows when it is ten times as probable as none.
    ln_odds = np.log(10.0 * PRIOR["none"] / PRIOR["single"] * max(len(single), 1))
    absorbed, detectable = {}, {}
    for name, g in raw.items():
        total = np.square(g).sum(axis=1)
        seen = total > 1e-12
        kept = np.square(left[name]).sum(axis=1)
        absorbed[name] = 1.0 - float(np.median((kept / np.maximum(total, 1e-300))[seen]))
        parts = np.split(np.square(g), np.cumsum(rows)[:-1], axis=1)
        size = np.sqrt(np.max([part.mean(axis=1) for part in parts], axis=0))
        sd = size[seen] / np.sqrt(np.maximum(kept[seen], 1e-300))
        detectable[name] = smallest_shown(size, float(np.median(sd)), float(ln_odds))
    return Identifiability(absorbed, detectable, _cosine_similarities(left), idle)


def smallest_shown(prior: Array, sd: float, ln_odds: float) -> float:
    """Find the size of an effect that is told from noise in 80 % of campaigns.

    An effect counts from `calib.gap.odds.MIN_EFFECT_SIZE` on, so its evidence is that of a prior
    without smaller sizes.
    """
    relevant = prior[prior >= MIN_EFFECT_SIZE]
    if not relevant.size:
        return float("inf")

    def beyond(estimate: float) -> tuple[float, float]:
        exponent = relevant * (estimate - 0.5 * relevant) / sd**2
        top = float(exponent.max())
        weights = np.exp(exponent - top)
        slope = float(weights @ relevant) / float(weights.sum()) / sd**2
        return top + float(np.log(weights.mean())) - ln_odds, slope

    first = float(relevant.max()) + 4.0 * sd
    value, slope = beyond(first)
    if value < 0.0:
        return float("inf")
    # The evidence grows with the estimate, faster and faster: Newton's steps come down to the root
    # and never pass it. (SciPy's search comes with all its optimisers: a tenth of a second.)
    while first > 0.0 and value / slope > 1e-4:
        first = max(first - value / slope, 0.0)
        value, slope = beyond(first)
    return max(first + 0.8416 * sd, MIN_EFFECT_SIZE)  # 80 % power


def _cosine_similarities(left: Mapping[str, Array]) -> dict[tuple[str, str], float]:
    unit = {}
    for name, g in left.items():
        length = np.linalg.norm(g, axis=1, keepdims=True)
        unit[name] = (g / np.maximum(length, 1e-300))[length[:, 0] > 1e-6][:64]
    names = sorted(unit)
    found = {}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            if unit[a].size and unit[b].size:
                cosine = unit[a] @ unit[b].T
                found[a, b] = float(
                    max(np.median(cosine.max(axis=1)), np.median(cosine.max(axis=0)))
                )
    return found


def _signatures(
    data: Campaigns,
    h: Hypothesis,
    lab_mode: Mapping[str, Array],
    noise: Mapping[str, Noise],
    seed: int,
) -> Array:
    """Signatures of prior draws over all field rows and outputs, shape (draws, N)."""
    forward = Forward(data, h, {o: n.sigma for o, n in noise.items()})
    psi = forward.priors.sample(generator(seed, "gap", "isolability", h.name), 512)
    for o in data.outputs:
        psi[:, forward.theta_slices[o.name]] = lab_mode[o.name]
    full, plain = forward.field_and_plain(psi, data.view)
    change = {name: full[name] - plain[name] for name in full}
    g = np.hstack([*data.in_noise(change, noise).values()])
    return g[np.isfinite(g).all(axis=1)]


def _metric_root(
    data: Campaigns, lab_mode: Mapping[str, Array], noise: Mapping[str, Noise]
) -> Array:
    """A root R of C^-1 (R'R = C^-1) for changes in noise sds, block by output, shape (N, N)."""
    blocks = []
    for o in data.outputs:
        own, found, mode = len(o.priors.free), noise[o.name], lab_mode[o.name]
        of_noise = [found.sigma] if o.along is None else [found.correlation, found.sigma]
        natural = np.append(o.priors.to_natural(mode[None]), of_noise)
        at = np.append(mode, o.problem.priors.to_internal(natural[None])[0, own:])
        width = prior_widths(o.problem.priors)
        covariance = hessian_scale(o.problem.log_prob, at, width)[:own, :own]
        step = 1e-4 * width[:own]
        points = lab_mode[o.name] + np.concatenate([np.diag(step), -np.diag(step)])
        conditions = o.problem.bound.model.select(data.view.conditions)
        mean = o.problem.bound.mean_response(o.priors.to_natural(points), conditions)[:, o.rows]
        change = (mean[: step.size] - mean[step.size :]) / (2.0 * step[:, None])
        _, white = data.whitenings(o, found)
        sensitivity = white(np.nan_to_num(change)).T
        c = np.eye(o.rows.size) + sensitivity @ covariance @ sensitivity.T
        own_noise = white.decorrelated(np.eye(o.rows.size)).T
        blocks.append(np.linalg.solve(np.linalg.cholesky(c), own_noise))
    return np.asarray(block_diag(*blocks))


@dataclass(frozen=True)
class NextMeasurement:
    """Conditions at which one more measurement separates two hypotheses best.

    Parameters
    ----------
    conditions : mapping of str to float
        Canonical columns.
    gain_nats : float
        Expected log Bayes factor in favour of whichever is true, averaged over the two.
    output : str
        The one that tells most there.
    expected : pair of pairs of float
        Mean and sd of one reading of it under the first and the second hypothesis, in its unit.
    """

    separates: tuple[str, str]
    conditions: Mapping[str, float]
    gain_nats: float
    output: str
    expected: tuple[tuple[float, float], tuple[float, float]]


def next_measurements(
    data: Campaigns, in_play: Mapping[str, Fit], seed: int
) -> tuple[NextMeasurement, ...]:
    """Search the conditions of both campaigns for the most telling ones.

    Parameters
    ----------
    in_play : mapping of str to Fit
        The hypotheses to separate.
    """
    if len(in_play) < 2:
        return ()
    candidates = _candidates(data, generator(seed, "gap", "candidates"))
    view = data.at_conditions(candidates)
    moments = {name: _moments(data, fit, view, seed) for name, fit in in_play.items()}
    found = []
    for a, b in combinations(in_play, 2):
        gains = {o.name: _gain(moments[a][o.name], moments[b][o.name]) for o in data.outputs}
        gain = np.sum([*gains.values()], axis=0)
        best = int(np.nanargmax(np.where(np.isfinite(gain), gain, -np.inf)))
        conditions = {name: float(values[best]) for name, values in candidates.items()}
        telling = max(data.outputs, key=lambda o: gains[o.name][best])
        of_first, of_second = (
            _reading(telling.problem, moments[h][telling.name], best) for h in (a, b)
        )
        found.append(
            NextMeasurement(
                (a, b), conditions, float(gain[best]), telling.name, (of_first, of_second)
            )
        )
    return tuple(found)


def _reading(problem: Problem, moments: tuple[Array, Array], i: int) -> tuple[float, float]:
    """Mean and sd of a reading in the output's unit, from those of responses (n,)."""
    mean, sd = float(moments[0][i]), float(np.sqrt(moments[1][i]))
    if problem.bound.model.response != "log":
        return mean, sd
    middle = float(problem.bound.from_response(np.array([mean]))[0])
    return middle, middle * sd


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
            candidates[name] = rng.uniform(both.min(), both.max(), 400)
        elif role == "order":
            candidates[name] = np.full(400, data.view.order_range[1])
        else:
            candidates[name] = rng.choice(np.unique(both), 400)
    pressures = [data.view.column(role) or "" for role in ("pressure", "ground_pressure")]
    if all(p in candidates for p in pressures):
        # The two go together: pick rows, not values.
        row = rng.integers(len(data.case.field), size=400)
        for p in pressures:
            candidates[p] = data.view.conditions[p][row]
    return candidates


def _moments(data: Campaigns, fit: Fit, view: View, seed: int) -> dict[str, tuple[Array, Array]]:
    """Predictive mean and variance of each output on the scale of the response, (n,) each."""
    psi = fit.draws(generator(seed, "gap", "moments", fit.forward.hypothesis.name), 200)
    with np.errstate(all="ignore"):
        mean = fit.forward.field(psi, view)
    found = {}
    for o in data.outputs:
        noise = fit.noise[o.name].sd(noise_conditions(view))
        found[o.name] = (
            np.nanmean(mean[o.name], axis=0),
            np.nanvar(mean[o.name], axis=0) + noise**2,
        )
    return found


def _gain(a: tuple[Array, Array], b: tuple[Array, Array]) -> Array:
    """Half the symmetric Kullback-Leibler divergence of two normal predictions, (n,)."""
    (mean_a, var_a), (mean_b, var_b) = a, b
    squared = np.square(mean_a - mean_b)
    return np.asarray(0.25 * ((var_a + squared) / var_b + (var_b + squared) / var_a - 2.0))
