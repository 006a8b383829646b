"""Modes of hypotheses' posteriors by Gauss-Newton steps from several starting points at once.

The simulator costs as much for one vector of parameters as for a hundred, and for matrices as small
as these the overhead of an operation is most of its cost: several iterates take their steps
together, whichever hypothesis they belong to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
        """Noise scales that maximise the marginal likelihood, parameters allowed for."""
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


# Steps of a truncated fit, which is not ended before.
FIRST_STEPS = 3
# What is taken of coordinates that one hypothesis lacks and others have: nothing depends on them.
_LACKING = {"loc": 0.0, "precision": 1.0, "width": 1.0, "lower": -np.inf, "upper": np.inf}


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
    """Where iterates stand, in arrays as wide as that of the most coordinates, D.

    Attributes
    ----------
    psi : ndarray, shape (m, D)
    raw : ndarray, shape (m, N)
    dampings : ndarray, shape (m, 1)
    """

    def __init__(self, iterates: Sequence[Iterate]) -> None:
        super().__init__(iterates[0].problem.data)
        self.iterates = iterates
        for name, value in _LACKING.items():
            setattr(self, name, _wide([getattr(a.problem, name) for a in iterates], value))
        self.psi = _wide([a.psi for a in iterates], 0.0)
        self.raw = np.stack([a.raw for a in iterates])
        self.dampings = np.array([[a.damping] for a in iterates])
        self._parts: list[tuple[Residuals, slice]] = []
        start = 0
        for problem, some in groupby(a.problem for a in iterates):
            end = start + len(list(some))
            self._parts.append((problem, slice(start, end)))
            start = end

    def kept(self) -> Array:
        """Derivatives where the last step of each began, shape (m, D, N)."""
        found = np.zeros((*self.psi.shape, self.raw.shape[1]))
        for wide, iterate in zip(found, self.iterates, strict=True):
            wide[: iterate.psi.size] = iterate.jacobian
        return found

    @property
    def each(self) -> Coordinates:
        """The same for several points of each, whose arrays are (m, t, D)."""
        other = copy(self)
        for name in _LACKING:
            setattr(other, name, getattr(self, name)[:, None])
        return other

    def residuals(self, points: Array) -> Array:
        """Evaluate at several points of each, shapes (m, t, D) to (m, t, N)."""
        asked = [(p, points[rows, :, : p.loc.size]) for p, rows in self._parts]
        found = residuals_of_all([(p, some.reshape(-1, p.loc.size)) for p, some in asked])
        return np.concatenate([a.reshape(-1, points.shape[1], a.shape[1]) for a in found])

    def derivatives(self) -> Array:
        """Derivatives of the residuals where each stands, shape (m, D, N)."""
        points = self.around(self.psi).reshape(*self.psi.shape, -1)
        asked = [(p, points[rows, p.curved, : p.loc.size]) for p, rows in self._parts]
        answers = residuals_of_all([(p, some.reshape(-1, p.loc.size)) for p, some in asked])
        moved = np.repeat(self.raw[:, None], points.shape[1], axis=1)
        for (p, rows), answer in zip(self._parts, answers, strict=True):
            moved[rows, p.curved] = answer.reshape(-1, p.curved.size, answer.shape[1])
        found = self.jacobian(self.psi, self.raw, moved)
        for p, rows in self._parts:
            if p.curved.size < p.loc.size:
                found[rows, p.linear] = p.linear_jacobian(self.psi[rows, : p.loc.size])
        return found


def batches(iterates: Sequence[Iterate]) -> list[Batch]:
    """Batches of iterates of about as many coordinates."""
    alike = sorted(iterates, key=lambda a: a.psi.size)
    return [Batch(list(some)) for some in batched(alike, 16)]


def _wide(rows: Sequence[Array], value: float) -> Array:
    """Rows one below the other, the shorter ones filled up, shape (m, D)."""
    found = np.full((len(rows), max(row.size for row in rows)), value)
    for wide, row in zip(found, rows, strict=True):
        wide[: row.size] = row
    return found


@dataclass(frozen=True)
class Slope:
    """Derivatives of iterates where they stand.

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


def gauss_newton(iterates: Sequence[Iterate]) -> None:
    """Climb from guesses to the modes beside them; the iterates are moved in place."""
    going = iterates
    while going := [a for a in going if a.steps and a.quiet < 2]:
        for batch in batches(going):
            _advance(batch)


def _advance(batch: Batch) -> None:
    """One step of each."""
    iterates = batch.iterates
    jacobian = batch.derivatives()
    for iterate, own in zip(iterates, jacobian, strict=True):
        iterate.jacobian = own[: iterate.psi.size]
    slope = slopes(batch, jacobian)
    _end_beside_modes(batch, slope)
    gains = _step(batch, slope)
    raw = np.stack([a.raw for a in iterates])
    noises = batch.update_noises(raw, slope.left)
    for iterate, gained, noise in zip(iterates, gains, noises, strict=True):
        # At a kink or a bound nothing is gained of what the slope promises: that ends as well.
        quiet = gained < 1e-3 and _change(iterate.noise, noise) < 1e-2
        iterate.noise, iterate.quiet = noise, iterate.quiet + 1 if quiet else 0
        iterate.steps -= 1


def _end_beside_modes(batch: Batch, slope: Slope) -> None:
    """Allow one more step to iterates that are close to their modes."""
    if all(a.steps <= FIRST_STEPS for a in batch.iterates):
        return
    left = _left_to_gain(batch, slope)
    if not (left < 1e-2).any():
        return
    noises = batch.update_noises(batch.raw, slope.left)
    for iterate, nats, noise in zip(batch.iterates, left.tolist(), noises, strict=True):
        if nats < 1e-2 and _change(iterate.noise, noise) < 1e-2:
            iterate.steps = 1


def slopes(batch: Batch, jacobian: Array) -> Slope:
    """Slope and curvature of iterates where they stand, by derivatives, shape (m, d, N)."""
    sds = np.stack([a.problem.sds(a.noise) for a in batch.iterates])
    scaled = jacobian / sds[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        gradient = (scaled @ (batch.raw / sds)[:, :, None])[..., 0]
        gradient += (batch.psi - batch.loc) * batch.precision**2
        hessian = scaled @ scaled.swapaxes(1, 2)
    hessian += diagonal(batch.precision**2)
    return Slope(sds, scaled, gradient, hessian, 1e-6 / batch.width**2)


def _step(batch: Batch, slope: Slope) -> list[float]:
    """One Levenberg-Marquardt step of each: several dampings tried in one batched call.

    Returns what each gained; without a step the next dampings are larger.
    """
    psi, each = batch.psi, batch.each
    dampings = batch.dampings * np.array([0.1, 10.0, 1000.0])
    tried = each.clip(psi[:, None] + _directions(batch, psi, slope, dampings))
    there = batch.residuals(tried)
    cost = batch.costs(psi, batch.raw, slope.sds)
    costs = each.costs(tried, there, slope.sds[:, None])
    costs = np.where(np.isfinite(costs), costs, np.inf)
    gains = []
    for i, best in enumerate(costs.argmin(axis=1).tolist()):
        iterate, better = batch.iterates[i], bool(costs[i, best] < cost[i])
        if better:
            iterate.psi, iterate.raw = tried[i, best, : iterate.psi.size], there[i, best]
            iterate.damping = max(float(dampings[i, best]), 1e-9)
        else:
            iterate.damping = min(float(dampings[i, -1]) * 10.0, 1e6)
        gains.append(float(cost[i] - costs[i, best]) if better else 0.0)
    return gains


def _directions(batch: Coordinates, psi: Array, slope: Slope, dampings: Array) -> Array:
    """Damped steps, shape (m, dampings, D)."""
    # A coordinate that nothing depends on at this point still needs a finite step.
    size = np.diagonal(slope.hessian, axis1=1, axis2=2) + 1e-2 / batch.width**2
    # At a bound, a coordinate that would leave is held there.
    free = ~batch.blocked(psi, -slope.gradient)
    hessian = slope.hessian * (free[:, :, None] & free[:, None])
    added = np.where(free[:, None], dampings[..., None] * size[:, None], 1.0)
    gradient = np.where(free, slope.gradient, 0.0)
    damped = np.repeat(hessian[:, None], dampings.shape[1], axis=1)
    np.einsum("mtii->mti", damped)[...] += added
    return np.asarray(-np.linalg.solve(damped, gradient[:, None, :, None])[..., 0])


def _left_to_gain(batch: Batch, slope: Slope) -> Array:
    """What a whole step would gain in nats, if all were linear, shape (m,)."""
    step = _directions(batch, batch.psi, slope, np.full((len(batch.psi), 1), 1e-9))[:, 0]
    return np.asarray(-0.5 * (step * slope.gradient).sum(axis=1))


def _change(old: dict[str, Noise], new: dict[str, Noise]) -> float:
    """The most that an output's noise has changed."""
    return max(
        abs(log(new[o].sigma / old[o].sigma))
        + abs(new[o].rho - old[o].rho)
        + abs(new[o].kappa - old[o].kappa)
        for o in old
    )
