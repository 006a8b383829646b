"""Climb to modes of hypotheses' posteriors: Gauss-Newton from several guesses in step.

The simulator costs as much for one vector of parameters as for a hundred, and of matrices as small
as these the overhead of an operation is most of its cost. All guesses at all hypotheses take their
steps together: a climb is a generator that asks for residuals.

Residuals of both campaigns as functions of a hypothesis's parameters psi, many psi at once.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import batched, groupby
from math import log

import numpy as np
from numpy.typing import NDArray

from calib.gap.campaigns import Campaigns
from calib.gap.forward import Forward, fields_of_all
from calib.gap.noise import Noise, ln_averaged, most_probable
from calib.inference.mode import prior_widths
from calib.models.base import Array


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
        step = 1e-4 * self.width
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
            apart = np.abs((candidates[picked] - candidates[i]) / self.width).max(axis=1) > 0.7
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
        if batch and size + len(psi) > 1024:  # predictions stay in the processor's cache
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


# Asks for problems' residuals at some psi (k, d), is sent them (k, N), until it has a result.
type Requests[T] = Generator[list[tuple[Residuals, Array]], list[Array], T]

# An ascent with so few nats to gain, and noise that changes by so little, is a step from its mode.
# One that keeps gaining nothing of what its slope promises, at a kink or a bound, ends as well.
_BESIDE, _NOTHING, _SETTLED = 1e-2, 1e-3, 1e-2
# Steps of a truncated fit, which is not ended before.
FIRST_STEPS = 3
# What is taken of coordinates that one hypothesis lacks and others have: nothing depends on them.
_LACKING = {"loc": 0.0, "precision": 1.0, "width": 1.0, "lower": -np.inf, "upper": np.inf}


def run_in_step[T](walks: Sequence[Requests[T]]) -> list[T]:
    """Run walks on the same campaigns in step and return their results."""
    results: dict[int, T] = {}
    asked: dict[int, list[tuple[Residuals, Array]]] = {}
    for i, walk in enumerate(walks):
        _go_on(i, walk, None, asked, results)
    while asked:
        found = iter(residuals_of_all([each for some in asked.values() for each in some]))
        answers = {i: [next(found) for _ in some] for i, some in asked.items()}
        asked = {}
        for i, raw in answers.items():
            _go_on(i, walks[i], raw, asked, results)
    return [results[i] for i in range(len(walks))]


def _go_on[T](
    i: int,
    walk: Requests[T],
    raw: list[Array] | None,
    asked: dict[int, list[tuple[Residuals, Array]]],
    results: dict[int, T],
) -> None:
    """Send one walk what it asked for; keep its next question or its result."""
    try:
        asked[i] = next(walk) if raw is None else walk.send(raw)
    except StopIteration as end:
        results[i] = end.value


@dataclass(eq=False)
class Iterate:
    """One guess on its way to the mode beside it.

    Parameters
    ----------
    psi : ndarray, shape (d,)
    raw : ndarray, shape (N,)
        Residuals at psi.
    steps : int
        That it may still take.
    jacobian : ndarray, shape (d, N), optional
        Derivatives of the residuals where its last step began.
    quiet : int
        Last steps in a row that gained nothing to speak of.
    """

    problem: Residuals
    psi: Array
    raw: Array
    noise: dict[str, Noise]
    steps: int
    damping: float = 1e-3
    jacobian: Array | None = None
    quiet: int = 0


class Batch(Coordinates):
    """Where ascents stand, in arrays as wide as that of the most coordinates, D.

    Attributes
    ----------
    psi : ndarray, shape (m, D)
    raw : ndarray, shape (m, N)
    dampings : ndarray, shape (m, 1)
    """

    def __init__(self, ascents: Sequence[Iterate]) -> None:
        super().__init__(ascents[0].problem.data)
        self.ascents = ascents
        for name, value in _LACKING.items():
            setattr(self, name, _wide([getattr(a.problem, name) for a in ascents], value))
        self.psi = _wide([a.psi for a in ascents], 0.0)
        self.raw = np.stack([a.raw for a in ascents])
        self.dampings = np.array([[a.damping] for a in ascents])
        self._parts: list[tuple[Residuals, slice]] = []
        start = 0
        for problem, some in groupby(a.problem for a in ascents):
            end = start + len(list(some))
            self._parts.append((problem, slice(start, end)))
            start = end

    def kept(self) -> Array:
        """Derivatives where the last step of each began, shape (m, D, N)."""
        found = np.zeros((*self.psi.shape, self.raw.shape[1]))
        for wide, ascent in zip(found, self.ascents, strict=True):
            wide[: ascent.psi.size] = ascent.jacobian
        return found

    @property
    def each(self) -> Coordinates:
        """The same for several points of each, whose arrays are (m, t, D)."""
        other = copy(self)
        for name in _LACKING:
            setattr(other, name, getattr(self, name)[:, None])
        return other

    def residuals(self, points: Array) -> Requests[Array]:
        """Evaluate at several points of each, shapes (m, t, D) to (m, t, N)."""
        asked = [(p, points[rows, :, : p.loc.size]) for p, rows in self._parts]
        answers = yield [(p, some.reshape(-1, p.loc.size)) for p, some in asked]
        return np.concatenate([a.reshape(-1, points.shape[1], a.shape[1]) for a in answers])

    def derivatives(self) -> Requests[Array]:
        """Derivatives of the residuals where each stands, shape (m, D, N)."""
        points = self.around(self.psi).reshape(*self.psi.shape, -1)
        answers = yield [
            (p, points[rows, p.curved, : p.loc.size].reshape(-1, p.loc.size))
            for p, rows in self._parts
        ]
        moved = np.repeat(self.raw[:, None], points.shape[1], axis=1)
        for (p, rows), answer in zip(self._parts, answers, strict=True):
            moved[rows, p.curved] = answer.reshape(-1, p.curved.size, answer.shape[1])
        found = self.jacobian(self.psi, self.raw, moved)
        for p, rows in self._parts:
            if p.curved.size < p.loc.size:
                found[rows, p.linear] = p.linear_jacobian(self.psi[rows, : p.loc.size])
        return found


def batches(ascents: Sequence[Iterate]) -> list[Batch]:
    """Stacks of ascents of about as many coordinates."""
    alike = sorted(ascents, key=lambda a: a.psi.size)
    return [Batch(list(some)) for some in batched(alike, 16)]


def _wide(rows: Sequence[Array], value: float) -> Array:
    """Rows one below the other, the shorter ones filled up, shape (m, D)."""
    found = np.full((len(rows), max(row.size for row in rows)), value)
    for wide, row in zip(found, rows, strict=True):
        wide[: row.size] = row
    return found


@dataclass(frozen=True)
class Slope:
    """Derivatives of ascents where they stand.

    Parameters
    ----------
    sds : ndarray, shape (m, N)
        Of the noise.
    scaled : ndarray, shape (m, d, N)
        Derivatives of the residuals over their sds.
    gradient : ndarray, shape (m, d)
        Of the cost, minus the log posterior.
    hessian : ndarray, shape (m, d, d)
        Gauss and Newton's.
    flat : ndarray, shape (m, d)
        Curvature of a coordinate that nothing depends on, so that the Hessian has an inverse.
    """

    sds: Array
    scaled: Array
    gradient: Array
    hessian: Array
    flat: Array

    @cached_property
    def left(self) -> Array:
        """The part of the variance of each residual that parameters do not take up, (m, N)."""
        return variance_left(self.scaled, np.linalg.inv(self.hessian + diagonal(self.flat)))


def gauss_newton(ascents: Sequence[Iterate]) -> None:
    """Climb from guesses to the modes beside them; the ascents are moved in place."""
    going = ascents
    while going := [a for a in going if a.steps and a.quiet < 2]:
        run_in_step([_advance(stack) for stack in batches(going)])


def _advance(stack: Batch) -> Requests[None]:
    """One step of each."""
    ascents = stack.ascents
    jacobian = yield from stack.derivatives()
    for ascent, own in zip(ascents, jacobian, strict=True):
        ascent.jacobian = own[: ascent.psi.size]
    slope = slopes(stack, jacobian)
    _end_beside_modes(stack, slope)
    gains = yield from _step(stack, slope)
    raw = np.stack([a.raw for a in ascents])
    noises = stack.update_noises(raw, slope.left)
    for ascent, gained, noise in zip(ascents, gains, noises, strict=True):
        quiet = gained < _NOTHING and _change(ascent.noise, noise) < _SETTLED
        ascent.noise, ascent.quiet = noise, ascent.quiet + 1 if quiet else 0
        ascent.steps -= 1


def _end_beside_modes(stack: Batch, slope: Slope) -> None:
    """Leave ascents that are beside their modes one more step."""
    if all(a.steps <= FIRST_STEPS for a in stack.ascents):
        return
    left = _left_to_gain(stack, slope)
    if not (left < _BESIDE).any():
        return
    noises = stack.update_noises(stack.raw, slope.left)
    for ascent, nats, noise in zip(stack.ascents, left.tolist(), noises, strict=True):
        if nats < _BESIDE and _change(ascent.noise, noise) < _SETTLED:
            ascent.steps = 1


def slopes(stack: Batch, jacobian: Array) -> Slope:
    """Slope and curvature of ascents where they stand, by derivatives, shape (m, d, N)."""
    sds = np.stack([a.problem.sds(a.noise) for a in stack.ascents])
    scaled = jacobian / sds[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        gradient = (scaled @ (stack.raw / sds)[:, :, None])[..., 0]
        gradient += (stack.psi - stack.loc) * stack.precision**2
        hessian = scaled @ scaled.swapaxes(1, 2)
    hessian += diagonal(stack.precision**2)
    return Slope(sds, scaled, gradient, hessian, 1e-6 / stack.width**2)


def _step(stack: Batch, slope: Slope) -> Requests[list[float]]:
    """One Levenberg-Marquardt step of each: several dampings tried in one batched call.

    Returns what each gained; without a step the next dampings are larger.
    """
    psi, each = stack.psi, stack.each
    dampings = stack.dampings * np.array([0.1, 10.0, 1000.0])
    tried = each.clip(psi[:, None] + _directions(stack, psi, slope, dampings))
    there = yield from stack.residuals(tried)
    cost = stack.costs(psi, stack.raw, slope.sds)
    costs = each.costs(tried, there, slope.sds[:, None])
    costs = np.where(np.isfinite(costs), costs, np.inf)
    gains = []
    for i, best in enumerate(costs.argmin(axis=1).tolist()):
        ascent, better = stack.ascents[i], bool(costs[i, best] < cost[i])
        if better:
            ascent.psi, ascent.raw = tried[i, best, : ascent.psi.size], there[i, best]
            ascent.damping = max(float(dampings[i, best]), 1e-9)
        else:
            ascent.damping = min(float(dampings[i, -1]) * 10.0, 1e6)
        gains.append(float(cost[i] - costs[i, best]) if better else 0.0)
    return gains


def _directions(stack: Coordinates, psi: Array, slope: Slope, dampings: Array) -> Array:
    """Damped steps, shape (m, dampings, D)."""
    # A coordinate that nothing depends on at this point still needs a finite step.
    size = np.diagonal(slope.hessian, axis1=1, axis2=2) + 1e-2 / stack.width**2
    # At a bound, a coordinate that would leave is held there.
    free = ~stack.blocked(psi, -slope.gradient)
    hessian = slope.hessian * (free[:, :, None] & free[:, None])
    added = np.where(free[:, None], dampings[..., None] * size[:, None], 1.0)
    gradient = np.where(free, slope.gradient, 0.0)
    damped = np.repeat(hessian[:, None], dampings.shape[1], axis=1)
    np.einsum("mtii->mti", damped)[...] += added
    return np.asarray(-np.linalg.solve(damped, gradient[:, None, :, None])[..., 0])


def _left_to_gain(stack: Batch, slope: Slope) -> Array:
    """What a whole step would gain in nats, if all were linear, shape (m,)."""
    step = _directions(stack, stack.psi, slope, np.full((len(stack.psi), 1), 1e-9))[:, 0]
    return np.asarray(-0.5 * (step * slope.gradient).sum(axis=1))


def _change(old: dict[str, Noise], new: dict[str, Noise]) -> float:
    """The most that an output's noise has changed."""
    return max(
        abs(log(new[o].sigma / old[o].sigma))
        + abs(new[o].rho - old[o].rho)
        + abs(new[o].kappa - old[o].kappa)
        for o in old
    )
