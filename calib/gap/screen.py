"""The evidence of every set of causes in closed form, to tell which are worth the exact one.

What a cause does to the field rows is drawn from its prior, at the simulator as the laboratory
calibrated it. The draws are split into parts of similar shape and size, each of them a normal; the
simulator is linear about its calibration, and causes add up. A choice of one part for each cause of
a set is then one multivariate normal of the field rows, with a noise that is as uncertain as the
laboratory leaves it. A set's evidence is the sum over its choices. The parameters of the draws,
conditioned on the rows as if they were normal too, are the first guess at the posterior (an
iterated ensemble Kalman update; Iglesias, Law & Stuart 2013, doi:10.1088/0266-5611/29/4/045001).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.linalg import block_diag

from calib.gap.campaigns import Campaigns
from calib.gap.constants import (
    BEAM,
    GUESS_SCALE,
    MIN_EFFECT_SIZE,
    MIN_EFFECT_SIZE_IN_PAIR,
    MOST_CAUSES,
    PARTS,
    PRIOR_DRAWS,
    RANK,
    STEPS,
)
from calib.gap.fit import Residuals
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.gap.noise import Noise
from calib.gap.odds import sizes
from calib.gap.posterior import DOF, as_normal, searched
from calib.inference.mode import prior_widths
from calib.inference.proposal import StudentT
from calib.inference.random import generator
from calib.models.base import Array


@dataclass(frozen=True)
class Part:
    """A normal of what a cause does to the white field rows: mean (n,), root (n, r).

    Parameters
    ----------
    ln_share : float
        Log of the part of the cause's relevant prior draws.
    psi : ndarray, shape (d,)
        Their mean, of the coordinates beyond the simulators'.
    slope : ndarray, shape (d, r)
        By how much psi changes with each direction.
    spread : ndarray, shape (d, d)
        Covariance of what is left of psi.
    """

    ln_share: float
    mean: Array
    root: Array
    psi: Array
    slope: Array
    spread: Array


@dataclass(frozen=True)
class Cause:
    """A hypothesis by itself as the screen sees it.

    Parameters
    ----------
    ln_relevant, ln_relevant_in_set : float
        Log prior probability that it is large enough to count, by itself and among several.
    """

    forward: Forward
    parts: tuple[Part, ...]
    ln_relevant: float
    ln_relevant_in_set: float

    @property
    def name(self) -> str:
        """Of the hypothesis."""
        return self.forward.hypothesis.name


# A part of each of some causes, by its place.
type Parts = tuple[tuple[Cause, int], ...]


@dataclass(frozen=True)
class Choice:
    """One part of each cause of a set, and the log evidence of the relevant prior."""

    parts: Parts
    ln_evidence: float


class Screen:
    """The closed form for one case.

    Parameters
    ----------
    lab_mode, noise
        Of the calibration.
    """

    def __init__(
        self, data: Campaigns, lab_mode: Mapping[str, Array], noise: Mapping[str, Noise], seed: int
    ) -> None:
        self.data, self.lab_mode, self.noise, self.seed = data, lab_mode, noise, seed
        none = self.forward(Hypothesis("none"))
        problem = Residuals(data, none)
        white, field = problem.whitening(noise), problem.field
        lab = np.setdiff1d(np.arange(white.sd.size), field)
        *_, lower, upper, _ = none.priors._arrays
        loc, precision = as_normal(none)
        mode = loc.copy()
        for name, t in lab_mode.items():
            mode[none.theta_slices[name]] = t
        step = 1e-4 * prior_widths(none.priors)
        step = np.where(mode + step > upper, -step, step)
        raw = white(problem.raw(np.concatenate([mode[None], mode + np.diag(step)])))
        slope = np.nan_to_num((raw[0] - raw[1:]) / step[:, None])
        self._precision = slope[:, lab] @ slope[:, lab].T + np.diag(precision**2)
        pull = slope[:, lab] @ raw[0, lab] + precision**2 * (loc - mode)
        moved = np.linalg.solve(self._precision, pull)
        self.shared, self.start = np.clip(mode + moved, lower, upper), mode
        self._slope, self._field_noise = slope[:, field], white.take(field)
        self._left = raw[0, field] - self._slope.T @ (self.shared - mode)
        variance = np.eye(field.size) + self._slope.T @ np.linalg.solve(
            self._precision, self._slope
        )
        self._whitening = np.linalg.inv(np.linalg.cholesky(variance))
        self.rows = self._whitening @ self._left
        # The noise is known by as many residuals of the laboratory as parameters have left.
        self.dof = max(float(lab.size - mode.size), 4.0)
        self._problem, self._unwhite = problem, np.linalg.inv(self._whitening)

    def forward(self, hypothesis: Hypothesis) -> Forward:
        """Return the joint model of a hypothesis."""
        return Forward(
            self.data, hypothesis, {o: n.sigma for o, n in self.noise.items()}, self.lab_mode
        )

    def cause(self, hypothesis: Hypothesis) -> Cause:
        """Draw a cause from its prior, and split the draws."""
        forward = self.forward(hypothesis)
        label = (hypothesis.name, hypothesis.smooth_over, hypothesis.onset_over or "")
        rng = generator(self.seed, "gap", "screen", *label, *hypothesis.smooth_outputs)
        psi = forward.prior_draws(rng, PRIOR_DRAWS)
        psi[:, : forward.n_shared] = self.start
        full, plain = forward.field_and_plain(psi, self.data.view)
        does = self._field_noise(self._problem.of_field({o: full[o] - plain[o] for o in full}))
        size = sizes(forward, self.noise, psi)[:, 0]
        known = np.isfinite(does).all(axis=1)
        relevant = known & (size >= MIN_EFFECT_SIZE_IN_PAIR)

        def ln_share(large: NDArray[np.bool_]) -> float:
            return float(np.log((large.sum() + 0.5) / (known.sum() + 1.0)))

        parts: tuple[Part, ...] = ()
        some = relevant if relevant.sum() > 2 * RANK else known  # a size that is known may be small
        if some.sum() > 2 * RANK:
            white = does[some] @ self._whitening.T
            parts = _parts(white, psi[some, forward.n_shared :], bool(hypothesis.effects), rng)
        return Cause(
            forward, parts, ln_share(known & (size >= MIN_EFFECT_SIZE)), ln_share(relevant)
        )

    def choice(self, chosen: Parts) -> Choice:
        """Evaluate the log density of the white rows, but for a constant."""
        parts = [cause.parts[i] for cause, i in chosen]
        left = self.rows - sum(p.mean for p in parts)
        root = np.concatenate([np.empty((left.size, 0)), *(p.root for p in parts)], axis=1)
        inner = np.eye(root.shape[1]) + root.T @ root
        lower = np.linalg.cholesky(inner)
        white = np.linalg.solve(lower, root.T @ left)
        squares = float(left @ left - white @ white)
        ln_share = sum(p.ln_share for p in parts)
        tail = float(self.ln_tail(np.array(squares)))
        return Choice(chosen, tail + ln_share - float(np.log(np.diag(lower)).sum()))

    def ln_tail(self, squares: Array) -> Array:
        """Student's t: the noise's scale is as uncertain as the laboratory leaves it."""
        power = 0.5 * (self.dof + self.rows.size)
        return np.asarray(-power * np.log1p(np.maximum(squares, 0.0) / self.dof))

    def choices(self, causes: Sequence[Cause], most: int = MOST_CAUSES) -> list[Choice]:
        """Evaluate choices of parts for up to four causes: all single ones and pairs.

        Of larger sets those that enlarge one of the `BEAM` best choices of one cause less.
        """
        return _Beam(self, causes).run(most) if any(c.parts for c in causes) else []

    def guess(self, forward: Forward, chosen: Parts) -> tuple[StudentT, dict[str, Noise]]:
        """Condition what is searched of a hypothesis on the rows, given a part of each cause.

        Returns
        -------
        StudentT
            A proposal.
        dict of str to Noise
            The most probable one there.
        """
        parts = [c.parts[i] for c, i in chosen]
        design = np.concatenate([self._slope.T, *(self._unwhite @ p.root for p in parts)], axis=1)
        left = self._left - self._unwhite @ sum((p.mean for p in parts), np.zeros(len(design)))
        d = forward.n_shared
        prior = block_diag(self._precision, np.eye(design.shape[1] - d))
        covariance = np.linalg.inv(prior + design.T @ design)
        there = covariance @ design.T @ left
        _, _, lower, upper, _ = forward.priors._arrays
        mean, maps = np.zeros(forward.n_dim), np.zeros((forward.n_dim, there.size))
        spread = np.zeros((forward.n_dim, forward.n_dim))
        maps[:d, :d], mean[:d], end = np.eye(d), self.shared, d
        for (cause, _), part in zip(chosen, parts, strict=True):
            theirs, ours = places(cause.forward, forward)
            at = slice(end, end := end + part.root.shape[1])
            maps[ours, at], mean[ours] = part.slope[theirs - d], part.psi[theirs - d]
            spread[np.ix_(ours, ours)] = part.spread[np.ix_(theirs - d, theirs - d)]
        u = searched(forward)
        mean, found, noise = self._conditioned(
            forward, np.clip(mean + maps @ there, lower, upper), maps @ covariance @ maps.T + spread
        )
        mean, found = mean[u], found[np.ix_(u, u)]
        return StudentT(mean, GUESS_SCALE * _root(found), DOF), noise

    def _conditioned(
        self, forward: Forward, mean: Array, covariance: Array
    ) -> tuple[Array, Array, dict[str, Noise]]:
        """Condition a guess at psi on all rows, by regressions of these on draws of the guess."""
        problem, d = Residuals(self.data, forward), forward.n_dim
        rng = generator(self.seed, "gap", "guess", forward.hypothesis.name)
        *_, lower, upper, _ = forward.priors._arrays
        loc, precision = as_normal(forward)
        noise = dict(self.noise)
        for _ in range(STEPS):
            root = _root(covariance)
            psi = mean + rng.standard_normal((12 * d, d)) @ root.T
            psi = np.clip(psi, lower, upper)
            white = problem.whitening(noise)
            raw = problem.raw(psi) / white.sd
            known = np.isfinite(raw).all(axis=1)
            if known.sum() < 3 * d:
                break
            raw, psi = np.clip(raw[known], -1e3, 1e3), psi[known]
            centre, left, width = psi.mean(axis=0), raw.mean(axis=0), psi.std(axis=0) + 1e-300
            away = (psi - centre) / width
            slope = np.linalg.lstsq(away, raw - left, rcond=1e-8)[0]
            # What is not linear about the rows counts as noise.
            curved = white.decorrelated(raw - left - away @ slope)
            variance = 1.0 + np.square(curved).mean(axis=0)
            of_row = slope / width[:, None]
            slope, distance = white.decorrelated(of_row), white.decorrelated(left)
            per_sd = slope / precision[:, None]  # of the prior: well conditioned
            inner = np.eye(d) + (per_sd / variance) @ per_sd.T
            covariance = np.linalg.inv(inner) / np.outer(precision, precision)
            pull = precision**2 * (loc - centre) - (slope / variance) @ distance
            mean = np.clip(centre + covariance @ pull, lower, upper)
            there, of_row = (left + (mean - centre) @ of_row) * white.sd, of_row * white.sd
            about = problem.products(of_row, covariance @ of_row)
            noise = problem.noise_of(
                {o: p + about[o].sum(axis=0) for o, p in problem.products(there, there).items()}
            )
        return mean, covariance, noise


def _root(covariance: Array) -> Array:
    """Cholesky factor of a covariance that may be flat in some direction."""
    sd = np.sqrt(np.diag(covariance)) + 1e-300
    alike = covariance / np.outer(sd, sd)
    return sd[:, None] * np.linalg.cholesky(0.5 * (alike + alike.T) + 1e-8 * np.eye(sd.size))


def _parts(white: Array, psi: Array, split: bool, rng: np.random.Generator) -> tuple[Part, ...]:
    """Split draws by what they do, white (k, n), in shape and size."""
    length = np.linalg.norm(white, axis=1, keepdims=True)
    where = np.zeros(len(white), dtype=int)
    if split:
        shape = white / np.maximum(length, 1e-300) * np.log1p(length)  # some may do nothing
        _, where = kmeans2(shape, PARTS, minit="++", seed=rng)
    found = []
    for label in np.unique(where):
        inside = where == label
        some, of_psi = white[inside], psi[inside]
        mean, psi_mean, n = some.mean(axis=0), of_psi.mean(axis=0), int(inside.sum())
        u, s, v = np.linalg.svd(some - mean, full_matrices=False)
        r = min(RANK, n - 1) if split else s.size
        scores = u[:, :r] * np.sqrt(n)
        slope = (of_psi - psi_mean).T @ scores / n
        left = of_psi - psi_mean - scores @ slope.T
        found.append(
            Part(
                float(np.log(n / len(white))),
                mean,
                v[:r].T * s[:r] / np.sqrt(n),
                psi_mean,
                slope,
                left.T @ left / n + np.diag(psi.var(axis=0)) / n,
            )
        )
    return tuple(found)


def places(old: Forward, new: Forward) -> tuple[Array, Array]:
    """Places of the parameters of causes that two hypotheses share, in the psi of each."""
    pairs = []
    place = {e.name: i for i, e in enumerate(new.hypothesis.effects)}
    for i, e in enumerate(old.hypothesis.effects):
        if (j := place.get(e.name)) is not None:
            pairs.append((old.phi_slices[i], new.phi_slices[j]))
            pairs += [(old.form_slices[o][i], new.form_slices[o][j]) for o in old.form_slices]
    if old.shift is not None and new.shift is not None:
        pairs.append((old.shift_slice, new.shift_slice))
    pairs += [
        (s, new.smooth_slices[o]) for o, s in old.smooth_slices.items() if o in new.smooth_slices
    ]
    if old.threshold < old.n_dim and new.threshold < new.n_dim:
        pairs.append((slice(old.threshold, old.n_dim), slice(new.threshold, new.n_dim)))
    theirs, ours = (
        np.concatenate([np.arange(0), *(np.arange(p[k].start, p[k].stop) for p in pairs)])
        for k in (0, 1)
    )
    return theirs, ours


def _go_together(one: Cause, other: Cause) -> bool:
    """Whether two are in one set: no variants of one name, and one shift of parameters at most."""
    shifts = one.forward.shift is not None and other.forward.shift is not None
    return one.name != other.name and not shifts


class _Beam:
    """Choices of parts, enlarged by one cause after the other."""

    def __init__(self, screen: Screen, causes: Sequence[Cause]) -> None:
        self._screen = screen
        every = [(j, i, p) for j, c in enumerate(causes) for i, p in enumerate(c.parts)]
        self._of = np.array([j for j, _, _ in every])
        self._go_together = np.array([[_go_together(a, b) for a in causes] for b in causes])
        self._labels = [(causes[j], i) for j, i, _ in every]
        self._ln_share = np.array([p.ln_share for _, _, p in every])
        roots = np.zeros((len(every), RANK, screen.rows.size))
        for root, (_, _, p) in zip(roots, every, strict=True):
            root[: p.root.shape[1]] = p.root.T
        means = np.stack([p.mean for _, _, p in every])
        # The rows, every part's mean, then every part's directions.
        columns = np.concatenate([screen.rows[None], means, roots.reshape(-1, screen.rows.size)])
        self._gram = columns @ columns.T
        self._means = 1 + np.arange(len(every))
        self._directions = 1 + len(every) + np.arange(len(every) * RANK).reshape(-1, RANK)
        self._inner = np.eye(RANK) + roots @ roots.swapaxes(1, 2)
        self._to_mean = (roots @ means[..., None])[..., 0]

    def _enlarge(self, parts: Sequence[int], allowed: NDArray[np.intp]) -> Array:
        """Log evidence of a choice with each of the allowed parts more."""
        gram, means, directions = self._gram, self._means[allowed], self._directions[allowed]
        chosen = self._means[list(parts)]
        # Products of the rows, less the means of the parts that are chosen.
        rows = gram[0] - gram[chosen].sum(axis=0)
        there = self._directions[list(parts)].ravel()
        lower = np.linalg.cholesky(np.eye(there.size) + gram[np.ix_(there, there)])
        white = np.linalg.solve(lower, gram[there])
        of_rows = np.linalg.solve(lower, rows[there])
        squares = rows[0] - rows[chosen].sum() - of_rows @ of_rows
        rows = rows - of_rows @ white
        to_means, to_others = white[:, means], white[:, directions]
        squares = squares - 2.0 * rows[means]
        squares += gram[means, means] - np.square(to_means).sum(axis=0)
        inner = self._inner[allowed] - np.einsum("spi,spj->pij", to_others, to_others)
        to_left = rows[directions] - self._to_mean[allowed]
        to_left += np.einsum("spi,sp->pi", to_others, to_means)
        root = np.linalg.cholesky(inner)
        squares -= np.square(np.linalg.solve(root, to_left[..., None])[..., 0]).sum(axis=1)
        ln_dets = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(self._screen.ln_tail(squares) - np.log(np.diag(lower)).sum() - ln_dets)

    def run(self, most: int) -> list[Choice]:
        """Evaluate choices of up to so many causes."""
        found: list[Choice] = []
        level: dict[tuple[int, ...], float] = {(): 0.0}
        for size in range(most):
            if size >= 2:
                level = dict(sorted(level.items(), key=lambda item: -item[1])[:BEAM])
            larger: dict[tuple[int, ...], float] = {}
            for parts in level:
                # Every pair once; larger sets from whichever of their parts is in the beam.
                later = self._of > self._of[parts[-1]] if size == 1 else True
                able = self._go_together[self._of[list(parts)]].all(axis=0)[self._of]
                allowed = np.flatnonzero(later & able)
                if allowed.size:
                    share = self._ln_share[list(parts)].sum() + self._ln_share[allowed]
                    values = (self._enlarge(parts, allowed) + share).tolist()
                    for part, value in zip(allowed.tolist(), values, strict=True):
                        larger[tuple(sorted((*parts, part)))] = value
            level = larger
            found += [Choice(tuple(self._labels[p] for p in c), v) for c, v in level.items()]
        return found
