"""How probable field readings are under one cause, its strength and dials averaged over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.challenge.build import CLOSE, LARGEST_GAP, SINGLE_FLOOR
from calib.challenge.oracle.bank import Bank, gaps_at
from calib.challenge.oracle.climb import Coordinates, Peak, climb
from calib.challenge.oracle.fair import Kept
from calib.challenge.oracle.lab import View
from calib.challenge.oracle.proposal import Proposal
from calib.challenge.oracle.site import Site

type Array = NDArray[np.float64]

PLACES = 64
_STARTS = 3
_INFLATED = 1.3
_BROAD = 2.0
_DISTANT = 12.0  # nats


@dataclass(frozen=True)
class Places:
    """Gap sizes as the generator draws them, evenly in the logarithm, at the nodes of a bank.

    Attributes
    ----------
    size : array
        Logarithm of the gap's rms, ``(J, P)``.
    possible : array
        One where the generator would go on with it, else zero, ``(J, P)``.
    between : array
        What the knots weigh there, ``(J, P, K)``.
    """

    size: Array
    possible: Array
    between: Array


def places(bank: Bank, floor: float, span: float = 1.0, count: int = PLACES) -> Places:
    """Return gap sizes evenly spread from a floor over a part of the range.

    Parameters
    ----------
    bank : Bank
        The nodes.
    floor : float
        Smallest gap in noise sd.
    span : float
        Part of the logarithmic range above it.
    count : int
        How many sizes.
    """
    ceiling = np.minimum(np.log(LARGEST_GAP), bank.top - CLOSE)
    share = span * (np.arange(count) + 0.5) / count
    low = float(np.log(floor))
    size = low + share * np.maximum(ceiling - low, 0.0)[:, None]
    possible = (ceiling >= low)[:, None] & (bank.bottom[:, None] <= size)
    # What cannot be is looked up at a size that can, so that nothing overflows.
    looked_up = np.clip(size, bank.size[:, :1] - 0.2, bank.size[:, -1:] + 0.2)
    return Places(looked_up, possible.astype(np.float64), bank.between(looked_up))


@dataclass(frozen=True)
class Singles:
    """Evidence of a bank's nodes, relative to that of no gap.

    Attributes
    ----------
    node : array
        Weight times mean likelihood over gap sizes, ``(J,)``, over ``exp(scale)``.
    scale : float
        Logarithm of what was taken out.
    kept : float
        Probability that the generator keeps a draw.
    best : float
        Largest log-likelihood ratio met.
    start : array
        Logarithm of the best strength at each node, ``(J,)``.
    likely : array
        The best log-likelihood ratio at each node, ``(J,)``.
    """

    node: Array
    scale: float
    kept: float
    best: float
    start: Array
    likely: Array

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence."""
        return self.scale + float(np.log(max(self.node.sum(), 1e-300)))

    @property
    def error(self) -> float:
        """Relative standard error of the evidence."""
        total, count = self.node.sum(), self.node.size
        if count == 1 or total <= 0.0:
            return 0.0
        spread = np.sum((self.node - total / count) ** 2) * count / (count - 1)
        return float(np.sqrt(spread) / total)


def singles(bank: Bank, view: View, kept: Kept) -> Singles:
    """Return the evidence of a cause alone.

    Parameters
    ----------
    bank : Bank
        Its nodes.
    view : View
        The field.
    kept : Kept
        How probably the generator keeps a draw.
    """
    at = places(bank, SINGLE_FLOOR)
    seen = view.seen(bank.shape)
    along = np.einsum("jpk,jk->jp", at.between, seen @ view.residual)
    square = np.einsum("jkm,jlm->jkl", seen, seen)
    own = np.einsum("jpk,jkl,jpl->jp", at.between, square, at.between, optimize=True)
    size = np.exp(at.size)
    ratio = size * along - 0.5 * size**2 * own
    keep = at.possible * kept.at(at.size)
    scale = float(np.max(np.where(keep > 0.0, ratio, -np.inf), initial=-1e4))
    node = bank.weight * np.mean(keep * np.exp(np.minimum(ratio - scale, 0.0)), axis=1)
    reached = np.where(at.possible > 0.0, ratio, -1e4)
    top = np.argmax(reached, axis=1)[:, None]
    knots = np.take_along_axis(at.between, top[:, :, None], axis=1)[:, 0]
    return Singles(
        node=node,
        scale=scale,
        kept=float(np.sum(bank.weight * np.mean(keep, axis=1)) / np.sum(bank.weight)),
        best=float(reached.max()),
        start=np.sum(knots * bank.strength, axis=1),
        likely=np.take_along_axis(reached, top, axis=1)[:, 0],
    )


def peaks(site: Site, bank: Bank, view: View, found: Singles, count: int = _STARTS) -> list[Peak]:
    """Return the best fits reached from the best nodes, exactly simulated."""
    d = bank.dials.shape[1]
    low, high = (float(np.log(s)) for s in bank.cause.strengths)
    coordinates = Coordinates.of_dials(bank.cause.normal).and_strength(low, high)
    best = np.argsort(-found.likely)[:count]
    starts = np.column_stack([bank.dials[best], found.start[best]])

    def predict(at: Array) -> Array:
        return view.seen(gaps_at(site, bank.cause, at[:, :d], at[:, d]))

    return climb(predict, view.residual, coordinates, starts)


def around(tops: list[Peak], dials: slice, bank: Bank, node: Array) -> Proposal:
    """Return where more nodes are wanted: about the best fits, and about the good nodes.

    Parameters
    ----------
    tops : list of Peak
        Best fits, the best first.
    dials : slice
        Which of their coordinates are the bank's dials.
    bank : Bank
        The nodes.
    node : array
        What each has of the evidence, ``(J,)``.
    """
    near = [peak for peak in tops if peak.value > tops[0].value - _DISTANT]
    centres = [peak.at[dials] for peak in near]
    scales = [_INFLATED**2 * peak.covariance[dials, dials] for peak in near]
    weights = [np.exp(0.5 * (peak.value - tops[0].value)) for peak in near]
    centre, spread = _tempered(bank.dials, node, bank.cause.normal)
    centres, scales = [*centres, centre], [*scales, _BROAD**2 * spread]
    share = np.array([*weights, max(0.35 * sum(weights), 1e-3)])
    return Proposal(share / share.sum(), np.array(centres), np.linalg.cholesky(np.array(scales)))


def _tempered(dials: Array, node: Array, normal: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return mean and covariance of nodes, their weights evened out until enough of them count."""
    d = dials.shape[1]
    logs = np.log(np.maximum(node / max(node.max(), 1e-300), 1e-30))
    for power in (1.0, 0.5, 0.25, 0.1, 0.03, 0.0):
        weight = np.exp(power * logs)
        weight /= weight.sum()
        if 1.0 / np.sum(weight**2) >= 2.0 * (d + 1):
            break
    centre = weight @ dials
    floor = np.diag(np.where(normal, 0.05, 0.02) ** 2)
    away = dials - centre
    return centre, (weight[:, None] * away).T @ away + floor


def strength_at(bank: Bank, node: int, view: View | None, rng: np.random.Generator) -> float:
    """Return the logarithm of a strength of a node, drawn as probable as it is.

    Parameters
    ----------
    bank, node : Bank, int
        The node.
    view : View, optional
        The field; without one the strength is drawn as the generator does.
    rng : numpy.random.Generator
        Source of randomness.
    """
    at = places(bank, SINGLE_FLOOR)
    likely = at.possible[node] + 1e-12
    if view is not None:
        gaps = np.exp(at.size[node])[:, None] * (at.between[node] @ view.seen(bank.shape[node]))
        ratio = gaps @ view.residual - 0.5 * np.sum(gaps**2, axis=1)
        likely = likely * np.exp(ratio - ratio.max())
    place = int(rng.choice(PLACES, p=likely / likely.sum()))
    return float(at.between[node, place] @ bank.strength[node])
