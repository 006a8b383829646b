"""Where fits of hypotheses begin: at the lab's calibration, or where parts of them have led."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.discrepancy import Bases
from calib.gap.effects import Effect
from calib.gap.fit import Fit, Start, finished, truncated_fits
from calib.gap.forward import Forward
from calib.gap.hypotheses import joined
from calib.gap.hypothesis import Hypothesis
from calib.gap.noise import Noise
from calib.gap.odds import Odds, with_prior
from calib.gap.residuals import Residuals, residuals_of_all
from calib.inference.random import even_points
from calib.models.base import Array

_N_SCREEN = 64
_N_BEGUN = 5
_N_THRESHOLDS = 24
# Guesses at one more effect of a set, how many of them all others take a step from, and how many
# of these a fit begins from.
_N_ADDED, _N_STEPPED, _N_ADDED_BEGUN = 64, 4, 2
# Parts of a Gauss-Newton step that are tried, for where a whole one goes too far.
_STEPS = (1.0, 0.3, 0.0)


@dataclass(frozen=True)
class Promise:
    """A set of causes that may be worth a fit.

    Parameters
    ----------
    expected : float
        Log of evidence times prior, by the best guess and one step of the other parameters, if the
        posterior is as broad as that of the set it was made from.
    starts : ndarray, shape (k, d)
        Guesses, the best first.
    first : int
        How many of the guesses are the best of a part that the set was made from.
    """

    forward: Forward
    expected: float
    starts: Array
    noise: Mapping[str, Noise]
    first: int = 1

    @property
    def hypothesis(self) -> Hypothesis:
        """Which causes."""
        return self.forward.hypothesis

    @property
    def start(self) -> Start:
        """Where a fit begins."""
        return Start(self.forward, self.starts, self.noise, len(self.starts))

    def with_starts_of(self, other: Promise) -> Promise:
        """Return the better of two promises of a set, with the guesses of both."""
        one, two = sorted((self, other), key=lambda p: -p.expected)
        parts = (one.starts[: one.first], two.starts[: two.first],
                 one.starts[one.first :], two.starts[two.first :])  # fmt: skip
        return replace(one, starts=np.concatenate(parts), first=one.first + two.first)

    def parted(self) -> tuple[Promise, Promise]:
        """Part a promise: the best guesses of the parts it was made from, and the others."""
        first, others = self.starts[: self.first], self.starts[self.first :]
        return replace(self, starts=first), replace(self, starts=others)


class Guesses:
    """Begins fits of hypotheses of one case.

    Parameters
    ----------
    lab_mode : mapping of str to ndarray
        Internal parameters of each simulator as the lab calibrated it.
    noise : mapping of str to Noise
        Of the laboratory.
    """

    def __init__(
        self, data: Campaigns, lab_mode: Mapping[str, Array], noise: Mapping[str, Noise], odds: Odds
    ) -> None:
        self.data, self.lab_mode, self.noise = data, lab_mode, noise
        self.odds = odds
        self._bases: Bases = {}

    def fit(self, hypotheses: Sequence[Hypothesis]) -> dict[str, tuple[Fit, ...]]:
        """Fit from the lab's calibration, by name."""
        truncated = truncated_fits([self.begun(h) for h in hypotheses])
        fits: dict[str, tuple[Fit, ...]] = {}
        for found in finished(truncated):
            name = found.forward.hypothesis.name
            fits[name] = (*fits.get(name, ()), found)
        return fits

    def begun(self, hypothesis: Hypothesis) -> Start:
        """Begin at the lab's calibration, effects at several guesses of their prior."""
        forward, start = self._forward(hypothesis)
        if hypothesis.onset_over is not None:
            start = self._onset_start(forward, start)
        if not hypothesis.effects:
            return Start(forward, start[None], self.noise)
        starts = self._spread(forward, start, _N_SCREEN, range(len(hypothesis.effects)))
        return Start(forward, np.concatenate([start[None], starts]), self.noise, _N_BEGUN)

    def begun_jointly(self, hypothesis: Hypothesis, members: Sequence[Fit], count: int) -> Start:
        """Begin where parts of a hypothesis have led, the effects they lack by their prior."""
        if not members:
            return self.begun(hypothesis)
        forward, start = self._forward(hypothesis)
        parts = [start[None]]
        for member in members:
            led = _led(forward, start, member)
            known = {e.name for e in member.forward.hypothesis.effects}
            lacking = [i for i, e in enumerate(hypothesis.effects) if e.name not in known]
            size = _N_SCREEN // len(members) if lacking else 1
            parts.append(self._spread(forward, led, size, lacking))
        return Start(forward, np.concatenate(parts), self.noise, count)

    def beside(
        self, kept: Hypothesis, found: Fit, added: Sequence[Hypothesis], size: int = _N_ADDED
    ) -> list[Promise]:
        """Guess at sets of what is kept of one that was fitted and one effect more.

        All other parameters take a Gauss-Newton step from each guess, or part of one where a whole
        one goes too far: what they can take up is no reason to add an effect. What is kept of a
        larger set is guessed at by itself as well.

        Parameters
        ----------
        kept : Hypothesis
            Some of the effects that were fitted, or all of them.
        added : sequence of Hypothesis
            Single effects.
        size : int
            How many guesses at the effect that is added are compared.
        """
        forward, start = self._forward(kept)
        psi = _led(forward, start, found)[None]
        problem, ended = Residuals(self.data, forward), Residuals(self.data, found.forward)
        sets = []
        for h in added:
            larger, larger_start = self._forward(joined(kept, h))
            last = [e.name for e in larger.hypothesis.effects].index(h.name)
            begun = self._spread(larger, _led(larger, larger_start, found), size, [last])
            there = Residuals(self.data, larger)
            sets.append((there, there.clip(begun)))
        if 1 < len(kept.effects) < len(found.forward.hypothesis.effects):
            sets.append((problem, problem.clip(psi)))
        asked = [
            (ended, found.psi[None]),
            (problem, problem.clip(psi)),
            (problem, problem.around(psi)),
        ]
        at_end, raw, moved, *guessed = residuals_of_all([*asked, *sets])
        sds = problem.sds(found.noise)
        slope = problem.jacobian(psi, raw, moved)[0] / sds
        hessian = slope @ slope.T + np.diag(problem.precision**2 + 1e-6 / problem.width**2)
        off = (psi[0] - problem.loc) * problem.precision**2
        stepped = []
        for (there, begun), left in zip(sets, guessed, strict=True):
            gradient = (left / sds) @ slope.T + off
            step = -np.linalg.solve(hessian, gradient.T).T
            costs = there.costs(begun, left, sds) + 0.5 * (gradient * step).sum(axis=1)
            best = there.best(costs, begun, _N_STEPPED)
            own, here = _places(forward, there.forward)
            starts = np.repeat(begun[best][None], len(_STEPS), axis=0)
            starts[:, :, here] += np.array(_STEPS)[:, None, None] * step[best][:, own]
            stepped.append((there, there.clip(starts.reshape(-1, starts.shape[-1]))))
        cost = float(ended.costs(found.psi[None], at_end, sds)[0])
        promises = []
        for (there, starts), left in zip(stepped, residuals_of_all(stepped), strict=True):
            costs = there.costs(starts, left, sds)
            best = there.best(costs, starts, _N_ADDED_BEGUN)
            least = float(costs[best[0]])
            gained = cost - least if np.isfinite(least) else -np.inf
            expected = self._expected(there.forward.hypothesis, found, gained)
            promises.append(Promise(there.forward, expected, starts[best], found.noise))
        return promises

    def _expected(self, hypothesis: Hypothesis, found: Fit, gained: float) -> float:
        """Log of evidence times prior of a set with a density so much higher than one's fitted."""
        was, odds = found.forward.hypothesis, self.odds
        share = float(np.log(hypothesis.share / was.share))
        prior = odds.ln_prior(hypothesis.name) - odds.ln_prior(was.name)
        return with_prior(found, odds) + gained + prior + share

    def _forward(self, hypothesis: Hypothesis) -> tuple[Forward, Array]:
        scale = {o: n.sigma for o, n in self.noise.items()}
        forward = Forward(self.data, hypothesis, scale, self.lab_mode, bases=self._bases)
        start = np.array([p.loc for p in forward.priors.free])
        for o in self.data.outputs:
            start[forward.theta_slices[o.name]] = self.lab_mode[o.name]
        return forward, start

    def _onset_start(self, forward: Forward, start: Array) -> Array:
        """The threshold, and the step and bend there, that the lab's residuals show best."""
        lower, upper = (
            getattr(forward.priors.free[forward.threshold], e) for e in ("lower", "upper")
        )
        thresholds = np.linspace(lower, upper, _N_THRESHOLDS)
        plain = forward.simulator(start[None], self.data.view)
        left = np.zeros(_N_THRESHOLDS)
        starts = np.repeat(start[None], _N_THRESHOLDS, axis=0)
        starts[:, forward.threshold] = thresholds
        for o in self.data.outputs:
            if o.name not in forward.smooth_slices:
                continue
            sigma = self.noise[o.name].sigma
            residual = (o.field - plain[o.name][0, o.rows]) / sigma
            shapes = np.stack(
                forward.discrepancy.onset(self.data.view, o.name, thresholds), axis=-1
            )
            part = forward.smooth_slices[o.name]
            precision = np.diag(
                [forward.priors.free[i].scale ** -2.0 for i in range(part.start, part.stop)]
            )
            for i, basis in enumerate(shapes[:, o.rows] / sigma):
                found = np.linalg.solve(basis.T @ basis + precision, basis.T @ residual)
                starts[i, part] = found
                left[i] += np.square(residual - basis @ found).sum() + found @ precision @ found
        best: Array = starts[int(np.argmin(left))]
        return best

    def _spread(self, forward: Forward, start: Array, size: int, which: Sequence[int]) -> Array:
        """Guesses that differ in the parameters of some of the effects, by their priors."""
        hypothesis = forward.hypothesis
        ends = np.cumsum([0, *(len(hypothesis.effect_priors[i].free) for i in which)]).tolist()
        even = even_points(size, ends[-1])
        starts = np.repeat(start[None], size, axis=0)
        for i, first, last in zip(which, ends[:-1], ends[1:], strict=True):
            effect, priors = hypothesis.effects[i], hypothesis.effect_priors[i]
            drawn = priors.ppf(even[:, first:last])
            if type(effect).begun is not Effect.begun:
                natural = effect.begun(
                    priors.to_natural(drawn), self._left(forward, start), self.data.view
                )
                drawn = priors.to_internal(natural)
            starts[:, forward.phi_slices[i]] = drawn
        return starts

    def _left(self, forward: Forward, start: Array) -> dict[str, Array]:
        """What a guess leaves of the field's readings, by the role of the output."""
        predicted = forward.field(start[None], self.data.view)
        left = {}
        for o in self.data.outputs:
            left[o.role] = np.full(predicted[o.name].shape[1], np.nan)
            left[o.role][o.rows] = o.field - predicted[o.name][0, o.rows]
        return left


def _led(forward: Forward, start: Array, member: Fit) -> Array:
    """Return a start, moved to where a fit of some parts of a hypothesis has led."""
    theirs, ours = _places(member.forward, forward)
    led = start.copy()
    led[ours] = member.psi[theirs]
    return led


def _places(old: Forward, new: Forward) -> tuple[Array, Array]:
    """Places of the parameters that two hypotheses share, in the psi of each."""
    pairs = [(slice(0, old.n_shared), slice(0, new.n_shared))]
    place = {e.name: i for i, e in enumerate(new.hypothesis.effects)}
    for i, e in enumerate(old.hypothesis.effects):
        if e.name in place:
            j = place[e.name]
            pairs.append((old.phi_slices[i], new.phi_slices[j]))
            pairs += [(old.form_slices[o][i], new.form_slices[o][j]) for o in old.form_slices]
    if old.shift is not None and new.shift is not None:
        pairs.append((old.shift_slice, new.shift_slice))
    theirs, ours = (
        np.concatenate([np.arange(pair[k].start, pair[k].stop) for pair in pairs]) for k in (0, 1)
    )
    return theirs, ours
