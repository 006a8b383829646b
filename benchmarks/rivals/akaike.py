"""A plain search by AIC over the effects that the diagnosis lists, with its own formulas.

Nothing, a parameter shift, every effect and every pair (of those that the diagnosis combines too)
are fitted to both campaigns by maximum likelihood, with the simulator's parameters; each output has
a noise of its own. Explanations have Akaike weights by AICc, and predictions are averaged by them
(Burnham & Anderson 2002, doi 10.1007/b97636). There are no priors but bounds, no errors of
formulas, and nothing that is not listed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import softmax

from calib.gap.effects import EFFECTS
from calib.gap.fit import Residuals
from calib.gap.forward import Forward
from calib.gap.hypotheses import (
    Hypothesis,
    joined,
    prior_share,
    singles,
    split_testable,
    with_case_effects,
)
from calib.inference.priors import Prior
from rivals.common import Answer, Array, Curve, Prepared

_KEPT = 1e-3  # weight below which an explanation is left out of predictions


@dataclass(frozen=True)
class Likeliest:
    """An explanation where its likelihood is greatest; `free` are the coordinates of psi fitted."""

    forward: Forward
    psi: Array
    free: NDArray[np.int64]
    covariance: Array
    sds: dict[str, float]
    aicc: float


def _forward(p: Prepared, h: Hypothesis) -> Forward:
    modes = {lab.name: lab.mode for lab in p.labs}
    return Forward(p.data, h, {lab.name: lab.sd for lab in p.labs}, modes)


def _start(p: Prepared, forward: Forward, sign: float = 1.0) -> Array:
    """The laboratory's fit, with effects of their priors' sizes."""
    psi, free = np.zeros(forward.n_dim), forward.priors.free
    for lab in p.labs:
        psi[forward.theta_slices[lab.name]] = lab.mode
    for i in (i for part in forward.phi_slices for i in range(part.start, part.stop)):
        prior, size = free[i], _scale(free[i])
        psi[i] = np.clip(prior.loc + sign * (not prior.log) * size, prior.lower, prior.upper)
    return psi


def _scale(prior: Prior) -> float:
    return prior.scale if np.isfinite(prior.scale) else 0.25 * (prior.upper - prior.lower)


def _singles(p: Prepared) -> tuple[list[Hypothesis], list[Hypothesis]]:
    """Effects that the data can show, and those of them that pairs are made of."""
    able, _ = split_testable(p.data, with_case_effects(p.data, EFFECTS))
    single = singles(p.data, able)
    return single, [h for h in single if prior_share(h.effects[0], able) is None]


def acting_alone(p: Prepared) -> Iterator[tuple[Forward, Array]]:
    """Every testable effect by itself, at its prior's size, with the laboratory's parameters."""
    for forward in (_forward(p, h) for h in _singles(p)[0]):
        yield forward, _start(p, forward)


def fit(p: Prepared, forward: Forward, starts: Sequence[Array]) -> Likeliest | None:
    """Maximise the likelihood; None with more parameters than AICc allows."""
    residuals = Residuals(p.data, forward)
    moved = [*forward.theta_slices.values(), *forward.phi_slices, forward.shift_slice]
    free = np.concatenate([np.arange(s.start, s.stop) for s in moved]).astype(np.int64)
    n, k = p.data.observed.size, free.size + len(p.labs)
    if n - k - 1 < 1:
        return None
    priors = [forward.priors.free[i] for i in free]
    scale = np.array([*map(_scale, priors)])
    low = np.array([max(q.lower, q.loc - 10.0 * s) for q, s in zip(priors, scale, strict=True)])
    high = np.array([min(q.upper, q.loc + 10.0 * s) for q, s in zip(priors, scale, strict=True)])
    noise = np.ones(n)

    def evaluate(some: Array) -> Array:
        psi = np.zeros((len(some), forward.n_dim))
        psi[:, free] = some
        return np.nan_to_num(residuals.raw(psi) / noise, nan=1e6, posinf=1e6, neginf=-1e6)

    def jacobian(t: Array) -> Array:
        step = 1e-5 * np.where(t + 1e-5 * scale > high, -scale, scale)
        both = evaluate(np.concatenate([t[None], t + np.diag(step)]))
        return np.asarray((both[1:] - both[0]).T / step)

    best = None
    for start in starts:
        t = np.clip(start[free], low + 1e-6 * scale, high - 1e-6 * scale)
        for lab in p.labs:
            noise[residuals.parts[lab.name]] = lab.sd
        for _ in p.labs:  # with several outputs their noise is found on the way
            t = least_squares(
                lambda t: evaluate(t[None])[0], t, jacobian, (low, high), x_scale=scale, max_nfev=40
            ).x
            raw = evaluate(t[None])[0] * noise
            sds = {o: float(np.sqrt(np.square(raw[s]).mean())) for o, s in residuals.parts.items()}
            for o, s in residuals.parts.items():
                noise[s] = max(sds[o], 1e-9)
        aicc = float(2.0 * np.log(noise).sum() + 2.0 * k * n / (n - k - 1))
        if best is None or aicc < best.aicc:
            psi, j = np.zeros(forward.n_dim), jacobian(t)
            psi[free] = t
            covariance = np.linalg.pinv(j.T @ j, rcond=1e-8, hermitian=True)
            best = Likeliest(forward, psi, free, covariance, sds, aicc)
    return best


def diagnose(p: Prepared) -> Answer:
    """Diagnose a case by AICc."""
    single, combined = _singles(p)
    found: dict[str, Likeliest] = {}
    for h in [Hypothesis("none"), Hypothesis("parameter_shift", shift=1.0), *single]:
        forward = _forward(p, h)
        end = fit(p, forward, [_start(p, forward, sign) for sign in (1.0, -1.0)])
        found |= {} if end is None else {h.name: end}
    for pair in combinations(combined, 2):
        both = _forward(p, joined(*pair))
        alone = [found[h.name] for h in pair if h.name in found]
        end = fit(p, both, [_from(p, both, alone, first) for first in alone])
        found |= {} if end is None else {both.hypothesis.name: end}
    weights = softmax([-0.5 * end.aicc for end in found.values()])
    probability = dict(zip(found, weights.tolist(), strict=True))
    kept = [name for name in found if probability[name] > _KEPT]
    share, curves = np.array([probability[name] for name in kept]), {}
    share /= share.sum()
    for lab in p.labs:
        parts = [_predict(p, found[name], lab.name) for name in kept]
        (field, sd), after = (_average([part[i] for part in parts], share) for i in (0, 1))
        noise = np.sqrt(share @ np.square([found[name].sds[lab.name] for name in kept]))
        gap, rows = field - lab.predict(lab.mode[None], p.field)[0], lab.output.rows
        curves[lab.name] = Curve(gap[rows], sd[rows], *after, float(noise))
    return Answer(probability, curves)


def _from(p: Prepared, forward: Forward, alone: Sequence[Likeliest], first: Likeliest) -> Array:
    """Begin a pair where its parts ended, with the simulator's parameters of one of them."""
    psi, names = _start(p, forward), [e.name for e in forward.hypothesis.effects]
    for name, part in forward.theta_slices.items():
        psi[part] = first.psi[first.forward.theta_slices[name]]
    for end in alone:
        place = names.index(end.forward.hypothesis.name)
        psi[forward.phi_slices[place]] = end.psi[end.forward.phi_slices[0]]
    return psi


def _predict(p: Prepared, end: Likeliest, output: str) -> list[tuple[Array, Array]]:
    """Mean and sd of an output at all field rows and at the target, by the delta method."""
    moves = 1e-5 * np.array([_scale(end.forward.priors.free[i]) for i in end.free])
    psi = np.tile(end.psi, (1 + moves.size, 1))
    psi[1 + np.arange(moves.size), end.free] += moves
    found = []
    for view in (p.data.view, p.data.at_conditions(p.target)):
        at = end.forward.field(psi, view)[output]
        j = np.nan_to_num((at[1:] - at[0]).T / moves)
        variance = np.einsum("ij,jk,ik->i", j, end.covariance, j)
        found.append((at[0], np.sqrt(np.maximum(variance, 0.0))))
    return found


def _average(parts: Sequence[tuple[Array, Array]], share: Array) -> tuple[Array, Array]:
    """Average predictions (n,) with Burnham and Anderson's unconditional variance."""
    means, sds = (np.stack([part[i] for part in parts]) for i in (0, 1))
    mean = share @ means
    return mean, np.sqrt(share @ (sds**2 + (means - mean) ** 2))
