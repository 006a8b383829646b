"""How probable field readings are under two causes at once.

The gap of two causes is the sum of their gaps and a remainder, which one exact simulation at the
best fit gives; about it the remainder is taken to grow with the product of the two gaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.challenge.build import OWN_GAP, PAIR_FLOOR, PAIR_SPAN, PAIR_SPREAD, SMALLEST_GAP
from calib.challenge.oracle.bank import Bank
from calib.challenge.oracle.climb import Coordinates, Peak, climb
from calib.challenge.oracle.evidence import Places, places
from calib.challenge.oracle.finding import NEVER
from calib.challenge.oracle.lab import View
from calib.challenge.oracle.site import Site

type Array = NDArray[np.float64]

_PLACES = 48
_MIDDLE = float(np.log(2.5))
_CUT, _MOST, _EXACT = 12.0, 200, 40


@dataclass(frozen=True)
class Half:
    """One of two causes: its bank and what pairs need of it, M readings.

    Attributes
    ----------
    bank : Bank
        The nodes.
    raw : array
        Shapes at a middling size, ``(J, M)``.
    middle : array
        The same whitened.
    along : array
        ``middle`` times the whitened residual, ``(J,)``.
    own : array
        Squared norm of ``middle``, ``(J,)``.
    low, high : array
        Smallest and largest gap in a pair, in noise sd, ``(J,)``; ``high`` below ``low`` where
        the cause cannot be as strong as that.
    places : Places
        Gap sizes as they are drawn.
    """

    bank: Bank
    raw: Array
    middle: Array
    along: Array
    own: Array
    low: Array
    high: Array
    places: Places

    def strength(self, node: int, size: float) -> float:
        """Return the logarithm of the strength at which a node has a gap."""
        knots = self.bank.between(np.full((len(self.bank.dials), 1), np.log(size)))[node, 0]
        return float(knots @ self.bank.strength[node])

    def gap(self, node: int, size: float) -> Array:
        """Return a node's gap of a size, in noise sd, ``(M,)``."""
        knots = self.bank.between(np.full((len(self.bank.dials), 1), np.log(size)))[node, 0]
        return np.asarray(size * (knots @ self.bank.shape[node]), dtype=np.float64)


def half(bank: Bank, view: View) -> Half:
    """Return what pairs need of a bank."""
    at = places(bank, PAIR_FLOOR, PAIR_SPAN, _PLACES)
    middle = np.clip(_MIDDLE, bank.size[:, 0], bank.size[:, -1])[:, None]
    shape = np.einsum("jpk,jkm->jm", bank.between(middle), bank.shape)
    seen = view.seen(shape)
    possible = at.possible.any(axis=1)
    return Half(
        bank=bank,
        raw=shape,
        middle=seen,
        along=seen @ view.residual,
        own=np.sum(seen**2, axis=1),
        low=np.where(possible, np.exp(at.size[:, 0]), 1.0),
        high=np.where(possible, np.exp(at.size[:, -1]), 0.0),
        places=at,
    )


@dataclass(frozen=True)
class Fit:
    """The best sizes of two nodes' gaps, by node of the first and the second cause.

    Attributes
    ----------
    value : array
        Log-likelihood ratio to no gap, ``(J1, J2)``.
    first, second : array
        Sizes in noise sd, ``(J1, J2)``.
    """

    value: Array
    first: Array
    second: Array

    @property
    def best(self) -> tuple[int, int]:
        """The best nodes."""
        i, j = np.unravel_index(int(np.argmax(self.value)), self.value.shape)
        return int(i), int(j)


def fit(a: Half, b: Half, remainder: Array, view: View) -> Fit:
    """Return the best sizes for all nodes, shapes and the whitened remainder held fixed."""
    along_a = (a.along - a.middle @ remainder)[:, None]
    along_b = (b.along - b.middle @ remainder)[None, :]
    own_a, own_b, cross = a.own[:, None], b.own[None, :], a.middle @ b.middle.T
    low_a, high_a, low_b, high_b = a.low[:, None], a.high[:, None], b.low[None, :], b.high[None, :]
    fixed = float(remainder @ view.residual - 0.5 * remainder @ remainder)
    best = np.full(cross.shape, -np.inf)
    first, second = np.zeros_like(best), np.zeros_like(best)

    def consider(x: Array, y: Array) -> None:
        value = fixed + x * along_a + y * along_b
        value = value - 0.5 * (x**2 * own_a + y**2 * own_b) - x * y * cross
        ahead = value > best
        for kept, new in ((best, value), (first, x), (second, y)):
            np.copyto(kept, new, where=ahead)

    # The box's edges, then the inside: a concave quadratic has its top at one of these.
    for x in (low_a, high_a):
        y = (along_b - x * cross) / np.maximum(own_b, 1e-9)
        consider(x + 0.0 * y, np.clip(y, low_b, np.maximum(high_b, low_b)))
    for y in (low_b, high_b):
        x = (along_a - y * cross) / np.maximum(own_a, 1e-9)
        consider(np.clip(x, low_a, np.maximum(high_a, low_a)), y + 0.0 * x)
    bulk = np.maximum(own_a * own_b - cross**2, 1e-9)
    x, y = (along_a * own_b - along_b * cross) / bulk, (along_b * own_a - along_a * cross) / bulk
    inside = (x >= low_a) & (x <= high_a) & (y >= low_b) & (y <= high_b)
    consider(np.where(inside, x, low_a + 0.0 * x), np.where(inside, y, low_b + 0.0 * y))
    # Where the two cancel, the generator draws again: go out to where together they show.
    alike = a.raw @ b.raw.T / a.raw.shape[1]
    shown = np.sqrt(np.maximum(first**2 + second**2 + 2.0 * first * second * alike, 1e-6))
    grow = np.maximum(1.0, SMALLEST_GAP / shown)
    x, y = np.clip(grow * first, low_a, high_a), np.clip(grow * second, low_b, high_b)
    best[grow > 1.0] = -np.inf
    consider(x, y)
    best = np.where((high_a >= low_a) & (high_b >= low_b), best, -np.inf)
    return Fit(best, first, second)


@dataclass(frozen=True)
class Point:
    """Two nodes with their gaps' sizes, and what their gap together is beyond the sum.

    Attributes
    ----------
    nodes : tuple of int
        Of the first and the second cause.
    sizes : tuple of float
        In noise sd.
    remainder : array
        In noise sd, ``(M,)``.
    """

    nodes: tuple[int, int]
    sizes: tuple[float, float]
    remainder: Array


def remainders(
    site: Site, wanted: Sequence[tuple[Half, Half, tuple[int, int], tuple[float, float]]]
) -> list[Point]:
    """Simulate pairs of nodes exactly and return what is beyond the sum of their gaps."""
    realities, sums = [], []
    for a, b, nodes, sizes in wanted:
        mechanisms, total = [], np.zeros(site.size)
        for one, node, size in zip((a, b), nodes, sizes, strict=True):
            strength = np.exp(one.strength(node, size))
            mechanisms.append(one.bank.cause.mechanism(one.bank.dials[node], float(strength)))
            total += one.gap(node, size)
        realities.append(site.stage.reality.with_mechanisms(*mechanisms))
        sums.append(total)
    gaps = site.gaps(realities) if realities else np.zeros((0, site.size))
    return [
        Point(nodes, sizes, gap - total)
        for (_, _, nodes, sizes), gap, total in zip(wanted, gaps, sums, strict=True)
    ]


def place_shares(count: int = _PLACES) -> Array:
    """Return how probable the places of two gaps in their ranges are, ``(count, count)``.

    The second place is the first's give or take an even amount, kept within the range.
    """
    edges = np.linspace(0.0, 1.0, count + 1)
    middle = (np.arange(count) + 0.5)[:, None] / count
    below = np.clip((edges - (middle - PAIR_SPREAD)) / (2.0 * PAIR_SPREAD), 0.0, 1.0)
    below[:, 0], below[:, -1] = 0.0, 1.0
    return np.asarray(np.diff(below, axis=1) / count, dtype=np.float64)


_SHARES = place_shares()


def _likelihoods(a: Half, b: Half, point: Point, view: View | None) -> tuple[Array, Array]:
    """Return log-likelihood ratios and where the generator goes on, over both gaps' sizes.

    Shapes ``(P, P)``; without a view the ratios are zero.
    """
    i, j = point.nodes
    size_a, size_b = np.exp(a.places.size[i]), np.exp(b.places.size[j])
    first = size_a[:, None] * (a.places.between[i] @ a.bank.shape[i])
    second = size_b[:, None] * (b.places.between[j] @ b.bank.shape[j])
    grown = np.outer(size_a, size_b) / (point.sizes[0] * point.sizes[1])
    m = first.shape[1]
    c = point.remainder
    one, two, cross = np.sum(first**2, 1)[:, None], np.sum(second**2, 1), first @ second.T
    with_c = grown * (2.0 * (first @ c)[:, None]) + grown**2 * (c @ c)
    with_c2 = grown * (2.0 * (second @ c)[None, :]) + grown**2 * (c @ c)
    both = one + two + 2.0 * cross + with_c + with_c2 - grown**2 * (c @ c)
    on = (both >= m * SMALLEST_GAP**2) & (one + with_c >= m * OWN_GAP**2)
    on &= two + with_c2 >= m * OWN_GAP**2
    on &= np.outer(a.places.possible[i] > 0.0, b.places.possible[j] > 0.0)
    if view is None:
        return np.zeros_like(both), on
    first, second, c = view.seen(first), view.seen(second), view.seen(c)
    ratio = (first @ view.residual - 0.5 * np.sum(first**2, 1))[:, None]
    ratio = ratio + (second @ view.residual - 0.5 * np.sum(second**2, 1)) - first @ second.T
    beside = (c @ view.residual) - (first @ c)[:, None] - (second @ c)[None, :]
    return ratio + grown * beside - 0.5 * grown**2 * (c @ c), on


def kept_share(a: Half, b: Half, rng: np.random.Generator) -> float:
    """Return how probably the generator goes on with one random pair of nodes, remainder nil."""
    nodes = [
        int(rng.choice(len(h.bank.weight), p=h.bank.weight / h.bank.weight.sum())) for h in (a, b)
    ]
    none = np.zeros(a.middle.shape[1])
    _, on = _likelihoods(a, b, Point((nodes[0], nodes[1]), (1.0, 1.0), none), None)
    return float(np.sum(_SHARES * on))


@dataclass(frozen=True)
class PairEvidence:
    """Evidence of two causes, relative to no gap.

    Attributes
    ----------
    log_evidence : float
        Its logarithm.
    error : float
        Relative standard error.
    first, second : array
        What each node has of the evidence, ``(J1,)`` and ``(J2,)``.
    tops : tuple of Point
        Some of the best pairs of nodes.
    """

    log_evidence: float
    error: float
    first: Array
    second: Array
    tops: tuple[Point, ...]


def evidence(site: Site, a: Half, b: Half, about: Point, view: View) -> PairEvidence:
    """Return the evidence of two causes.

    Parameters
    ----------
    site : Site
        The field.
    a, b : Half
        The causes.
    about : Point
        A good fit, whose remainder serves where no exact one is simulated.
    view : View
        The field as it is seen.
    """
    found = fit(a, b, view.seen(about.remainder), view)
    weights = np.outer(a.bank.weight, b.bank.weight)
    worth = found.value + np.log(np.maximum(weights, 1e-300))
    order = np.argsort(-worth, axis=None)
    order = order[worth.ravel()[order] > worth.max() - _CUT]
    logs, spent, points = np.full(worth.shape, -np.inf), [], []
    for batch in (order[i : i + _MOST] for i in range(0, order.size, _MOST)):
        chosen = [tuple(map(int, np.unravel_index(k, worth.shape))) for k in batch]
        for point in _about(site, a, b, found, chosen, about):
            ratio, on = _likelihoods(a, b, point, view)
            top = float(np.max(np.where(on, ratio, -np.inf), initial=NEVER))
            mean = float(np.sum(_SHARES * on * np.exp(np.minimum(ratio - top, 0.0))))
            logs[point.nodes] = top + np.log(max(mean, 1e-300))
            if on.any():
                spent.append(logs[point.nodes] - found.value[point.nodes])
                points.append(point)
        if spent:
            break
    if not spent:
        nothing = np.zeros(a.bank.weight.size), np.zeros(b.bank.weight.size)
        return PairEvidence(NEVER, 0.0, *nothing, ())
    # Nodes that were left out have about as much less than their best fit as the others.
    rest = np.isneginf(logs) & np.isfinite(found.value)
    logs = np.where(rest, found.value + float(np.median(spent)), logs)
    logs = logs + np.log(np.maximum(weights, 1e-300))
    scale = float(logs.max())
    shares = np.exp(logs - scale)
    total = float(shares.sum())
    first, second = shares.sum(axis=1), shares.sum(axis=0)
    error = np.sqrt(_spread(first) + _spread(second)) / total
    return PairEvidence(
        scale + float(np.log(total)), float(error), first, second, tuple(points[:3])
    )


def _about(
    site: Site, a: Half, b: Half, found: Fit, chosen: list[tuple[int, ...]], about: Point
) -> list[Point]:
    """Return points at chosen nodes; the remainder is exact for the first, their mean after."""
    points = []
    for i, j in chosen:
        sizes = float(found.first[i, j]), float(found.second[i, j])
        points.append(replace(about, nodes=(i, j), sizes=sizes))
    exact = remainders(site, [(a, b, p.nodes, p.sizes) for p in points[:_EXACT]])
    common = np.mean([point.remainder for point in exact], axis=0)
    return exact + [replace(point, remainder=common) for point in points[_EXACT:]]


def _spread(parts: Array) -> float:
    if parts.size < 2:
        return 0.0
    return float(np.sum((parts - parts.mean()) ** 2) * parts.size / (parts.size - 1))


def pair_peaks(site: Site, a: Half, b: Half, view: View, starts: Sequence[Point]) -> list[Peak]:
    """Return the best fits of two causes, exactly simulated: dials and strength of each in turn."""
    halves, parts = (a, b), []
    for one in halves:
        low, high = (float(np.log(s)) for s in one.bank.cause.strengths)
        parts.append(Coordinates.of_dials(one.bank.cause.normal).and_strength(low, high))
    n = parts[0].low.size
    base = site.stage.reality

    def predict(at: Array) -> Array:
        realities = []
        for row in at:
            mechanisms = [
                one.bank.cause.mechanism(part[:-1], float(np.exp(part[-1])))
                for one, part in zip(halves, (row[:n], row[n:]), strict=True)
            ]
            realities.append(base.with_mechanisms(*mechanisms))
        return view.seen(site.gaps(realities))

    rows = []
    for point in starts:
        row: list[float] = []
        for one, node, size in zip(halves, point.nodes, point.sizes, strict=True):
            row += [*map(float, one.bank.dials[node]), one.strength(node, size)]
        rows.append(row)
    return climb(predict, view.residual, parts[0].joined(parts[1]), np.array(rows))
