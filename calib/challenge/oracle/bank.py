"""Gaps of a cause along its strength, at many settings of its dials.

A node is one setting of the dials. Along it the gap is known at a few strengths, its knots, and
interpolated between them in the logarithm of its size. The nodes of a cause are a weighted sample
of the dials' prior: spread evenly at first, then added where a field asks for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from calib.challenge.build import LARGEST_GAP
from calib.challenge.oracle.causes import Cause
from calib.challenge.oracle.proposal import Proposal, log_prior
from calib.challenge.oracle.site import Site

type Array = NDArray[np.float64]

_COARSE = 3
_LARGEST = 1.05 * LARGEST_GAP
_ROUNDS, _NEAR = 3, 0.15
_KNOTS = (3, 5, 9)
_SPAN = 0.1
_APART = 1e-4
_NO_GAP = 1e-6
_SMOOTH = 0.04  # noise sds, rms: how well knots have to give the gaps between them
_EVEN = {0: 1, 1: 8, 2: 16, 3: 32}
_MANY = 64
_CHEAP = 8  # times as many where the wheel stands as it stood


@dataclass(frozen=True)
class Bank:
    """The nodes of a cause on a site; J nodes, D dials, K knots, M readings.

    Attributes
    ----------
    cause : Cause
        With the dials that matter here.
    dials : array
        Shape ``(J, D)``.
    weight : array
        Prior weights of the nodes, ``(J,)``, which sum to about one.
    size : array
        Logarithm of the gap's rms at the knots, in noise sd, increasing, ``(J, K)``.
    strength : array
        Logarithm of the strength at the knots, ``(J, K)``.
    shape : array
        Gap over its rms at the knots, ``(J, K, M)``.
    bottom, top : array
        Logarithm of the gap's rms at the smallest and the largest strength, ``(J,)``.
    drawn : tuple of (int, Proposal or None)
        How many nodes came from which distribution of the dials, None for the prior.
    """

    cause: Cause
    dials: Array
    weight: Array
    size: Array
    strength: Array
    shape: Array
    bottom: Array
    top: Array
    drawn: tuple[tuple[int, Proposal | None], ...]

    def between(self, size: Array) -> Array:
        """Return what the knots weigh at gap sizes, shapes ``(J, P)`` to ``(J, P, K)``.

        Floater and Hormann's rational interpolation [1]_, of third degree where there are knots
        enough: smooth, without poles, and of the same weights for every reading.

        References
        ----------
        .. [1] M. S. Floater, K. Hormann, Numer. Math. 107 (2007) 315-331,
           doi 10.1007/s00211-007-0093-y.
        """
        away = size[:, :, None] - self.size[:, None, :]
        away = np.where(np.abs(away) < 1e-9, 1e-9, away)
        weights = _rational(self.size)[:, None, :] / away
        return np.asarray(weights / weights.sum(axis=2, keepdims=True), dtype=np.float64)


def _rational(knots: Array) -> Array:
    """Return Floater and Hormann's weights for each row of knots, ``(J, K)``."""
    n = knots.shape[1]
    degree = min(3, n - 1)
    weights = np.zeros_like(knots)
    for first in range(n - degree):
        inside = range(first, first + degree + 1)
        for k in inside:
            others = [j for j in inside if j != k]
            gaps = np.prod(np.abs(knots[:, [k]] - knots[:, others]), axis=1)
            weights[:, k] += 1.0 / np.maximum(gaps, 1e-12)
    return weights * (-1.0) ** np.arange(n)


def open_bank(
    site: Site, cause: Cause, smallest: float, rng: np.random.Generator, more: int = 1
) -> Bank:
    """Return a bank whose nodes are spread evenly over the prior of the dials that matter here.

    Parameters
    ----------
    site : Site
        The field.
    cause : Cause
        With every dial open.
    smallest : float
        Logarithm of the smallest gap wanted.
    rng : numpy.random.Generator
        Source of randomness.
    more : int
        Multiplies the number of nodes.
    """
    cause = cause.with_dials(_dials_that_matter(site, cause))
    d = len(cause.dials)
    count = _EVEN.get(d, _MANY) * more
    middles = np.array([0.0 if normal else 0.5 for normal in cause.normal])
    count *= 1 if site.moves(cause.reality(site.stage.reality, middles, 1e-3)) else _CHEAP
    dials = np.zeros((1, 0))
    if d:
        even = np.clip(qmc.Sobol(d, rng=rng).random(count), 1e-6, 1.0 - 1e-6)
        dials = np.where(cause.normal, ndtri(even), even)
    traced = _trace(site, cause, dials, smallest, _knots_needed(site, cause, dials, smallest))
    return Bank(cause, dials, np.full(len(dials), 1.0 / len(dials)), *traced, ((len(dials), None),))


def add_nodes(
    site: Site, bank: Bank, proposal: Proposal, count: int, smallest: float,
    rng: np.random.Generator,
) -> Bank:  # fmt: skip
    """Return a bank with more nodes, all weighted by the mixture they were drawn from [1]_.

    Parameters
    ----------
    site, bank : Site, Bank
        Where, and what is there.
    proposal : Proposal
        Where more are wanted. Draws outside the dials' range count, but have no node.
    count : int
        How many to draw.
    smallest, rng
        As for `open_bank`.

    References
    ----------
    .. [1] E. Veach, L. J. Guibas, SIGGRAPH 95, 419-428, doi 10.1145/218380.218498.
    """
    new = proposal.draw(count, rng)
    uniform = ~bank.cause.normal
    inside = np.all((new[:, uniform] > 0.0) & (new[:, uniform] < 1.0), axis=1)
    dials = np.concatenate([bank.dials, new[inside]])
    drawn = (*bank.drawn, (count, proposal))
    prior = log_prior(dials, bank.cause.normal)
    density = sum(n * np.exp(prior if p is None else p.log_density(dials)) for n, p in drawn)
    weight = np.exp(prior) / density
    if not inside.any():
        return replace(bank, weight=weight, drawn=drawn)
    traced = _trace(site, bank.cause, new[inside], smallest, bank.size.shape[1])
    size, strength, shape, bottom, top = traced
    return Bank(
        cause=bank.cause,
        dials=dials,
        weight=weight,
        size=np.concatenate([bank.size, size]),
        strength=np.concatenate([bank.strength, strength]),
        shape=np.concatenate([bank.shape, shape]),
        bottom=np.concatenate([bank.bottom, bottom]),
        top=np.concatenate([bank.top, top]),
        drawn=drawn,
    )


def gaps_at(site: Site, cause: Cause, dials: Array, strength: Array) -> Array:
    """Return gaps at dials ``(B, D)`` and logarithms of strengths ``(B,)``, shape ``(B, M)``."""
    base = site.stage.reality
    pairs = zip(dials, np.exp(strength), strict=True)
    return site.gaps([cause.reality(base, d, float(s)) for d, s in pairs])


def _log_rms(gaps: Array) -> Array:
    return np.asarray(np.log(np.sqrt(np.mean(gaps**2, axis=-1)) + _NO_GAP), dtype=np.float64)


def _dials_that_matter(site: Site, cause: Cause) -> list[int]:
    """Return the dials that change the gap at one or another strength."""
    low, high = (float(np.log(s)) for s in cause.strengths)
    middles = np.array([0.0 if normal else 0.5 for normal in cause.branch.normal])
    n = middles.size
    if not n:
        return []
    moved = np.concatenate([middles[None], middles + 0.31 * np.eye(n), middles - 0.23 * np.eye(n)])
    matters = np.zeros(n, dtype=bool)
    for share in (0.5, 0.8):
        found = gaps_at(site, cause, moved, np.full(len(moved), low + share * (high - low)))
        change = np.max(np.abs(found - found[0]), axis=1)[1:].reshape(2, n)
        matters |= np.max(change, axis=0) > 1e-4 * max(1.0, float(np.max(np.abs(found[0]))))
    return [i for i in range(n) if matters[i]]


def _knots_needed(site: Site, cause: Cause, dials: Array, smallest: float) -> int:
    """Return how many knots give the gaps between them well enough, judged at a few nodes."""
    few = dials[:: max(1, len(dials) // 3)][:3]
    size, strength, shape, bottom, top = _trace(site, cause, few, smallest, _KNOTS[-1])
    every = Bank(cause, few, np.ones(len(few)), size, strength, shape, bottom, top, ())
    for knots in _KNOTS[:-1]:
        keep = np.arange(0, _KNOTS[-1], (_KNOTS[-1] - 1) // (knots - 1))
        fewer = replace(every, size=size[:, keep], shape=shape[:, keep])
        miss = (fewer.between(size) @ fewer.shape - shape) * np.exp(size)[:, :, None]
        if np.sqrt(np.mean(miss**2, axis=2)).max() < _SMOOTH:
            return knots
    return _KNOTS[-1]


def _trace(
    site: Site, cause: Cause, dials: Array, smallest: float, knots: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Return size, strength, shape, bottom and top of nodes (see `Bank`)."""
    j = len(dials)
    low, high = (float(np.log(s)) for s in cause.strengths)
    tried = np.tile(np.linspace(low, high, _COARSE), (j, 1))
    sizes = _log_rms(_at_many(site, cause, dials, tried))
    bottom, top = sizes[:, 0], sizes[:, -1]
    end = np.minimum(top, np.log(_LARGEST))
    begin = np.minimum(np.maximum(bottom, smallest), end - _SPAN)
    place = 0.5 - 0.5 * np.cos(np.pi * np.arange(knots) / (knots - 1))
    goal = begin[:, None] + place * (end - begin)[:, None]
    for _ in range(_ROUNDS):
        chosen = np.array([_inverse(*each) for each in zip(tried, sizes, goal, strict=True)])
        gaps = _at_many(site, cause, dials, chosen)
        got = _log_rms(gaps)
        tried, sizes = np.concatenate([tried, chosen], 1), np.concatenate([sizes, got], 1)
        reached = (goal <= top[:, None]) & (goal >= bottom[:, None])
        if np.max(np.abs(got - goal) * reached, initial=0.0) < _NEAR:
            break
    order = np.argsort(got, axis=1)
    shape = np.take_along_axis(gaps / np.exp(got)[..., None], order[..., None], 1)
    got, chosen = np.take_along_axis(got, order, 1), np.take_along_axis(chosen, order, 1)
    # Knots of one place, where the gap cannot be as large as wanted, are set apart a little.
    got = np.maximum.accumulate(got + _APART * np.arange(knots), axis=1)
    return got, chosen, shape, bottom, top


def _at_many(site: Site, cause: Cause, dials: Array, strength: Array) -> Array:
    """Return gaps at each node's strengths, shapes ``(J, K)`` to ``(J, K, M)``."""
    j, k = strength.shape
    found = gaps_at(site, cause, np.repeat(dials, k, axis=0), strength.ravel())
    return found.reshape(j, k, -1)


def _inverse(strength: Array, size: Array, goal: Array) -> Array:
    """Return strengths at which a node's gap has the sizes wanted, from those tried."""
    order = np.argsort(strength)
    rising = np.maximum.accumulate(size[order] + 1e-9 * np.arange(order.size))
    return np.asarray(np.interp(goal, rising, strength[order]), dtype=np.float64)
