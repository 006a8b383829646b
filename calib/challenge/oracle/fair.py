"""The generator's rules of fairness, as the probability that a gap is kept and not drawn again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.challenge.build import ABSORBABLE_NATS, ISOLABLE_NATS, RIVAL_NATS, UNLISTED_NATS
from calib.challenge.effects import ABSORBABLE, LISTED
from calib.challenge.identify import can_rival, lab_uncertainty, whitener
from calib.challenge.mechanism import SHIFT, UNKNOWN
from calib.challenge.oracle.bank import Bank
from calib.challenge.stage import Stage
from calib.challenge.surrogate import recalibration_span

type Array = NDArray[np.float64]

_SIZES = np.log([2.3, 3.6, 5.5])
_SIGNATURES = 24
_ALONG = 12


@dataclass(frozen=True)
class Kept:
    """How probably a draw is kept, along the nodes of a bank.

    Attributes
    ----------
    size : array
        Logarithms of gap sizes, increasing, ``(J, S)``.
    share : array
        Probability at them, ``(J, S)``.
    """

    size: Array
    share: Array

    def at(self, size: Array) -> Array:
        """Return the probability at other sizes, ``(J, P)``, linearly between."""
        rows = zip(size, self.size, self.share, strict=True)
        return np.array([np.interp(*row) for row in rows])


class Fairness:
    """The rules of `calib.challenge.build` on a stage, the rivals' variants averaged over.

    Parameters
    ----------
    stage : Stage
        Design and undisturbed reality.
    banks : mapping of str to sequence of Bank
        Those of every listed effect that can act, by its name, as they were opened.
    """

    def __init__(self, stage: Stage, banks: Mapping[str, Sequence[Bank]]) -> None:
        self._stage = stage
        span = recalibration_span(stage.simulator, stage.field, stage.field_sd)
        self._plausible = _root(whitener(span))
        self._lab = _root(whitener(lab_uncertainty(stage)))
        self._signatures = {name: self._signature(banks[name]) for name in banks}

    def _signature(self, banks: Sequence[Bank]) -> tuple[Array, list[Array]]:
        """Return weights and, per size, whitened directions of an effect in its first sense."""
        weights: list[Array] = []
        directions: list[list[Array]] = [[] for _ in _SIZES]
        for bank in banks:
            if bank.cause.sign < 0.0:
                continue
            first = bank.drawn[0][0]
            few = np.arange(0, first, max(1, first // _SIGNATURES))
            weights.append(np.full(few.size, bank.cause.share / few.size))
            for found, size in zip(directions, _SIZES, strict=True):
                inside = np.clip(size, bank.size[:, 0], bank.size[:, -1])[:, None]
                shape = np.einsum("jpk,jkm->jm", bank.between(inside)[few], bank.shape[few])
                white = shape @ self._lab
                norm = np.maximum(np.linalg.norm(white, axis=1, keepdims=True), 1e-9)
                found.append(white / norm)
        share = np.concatenate(weights)
        return share / share.sum(), [np.concatenate(found) for found in directions]

    def accepts(self, state: str, bank: Bank) -> Kept:
        """Return the probability that the gaps of a bank are kept, along each node."""
        tier, unlisted = self._stage.design.tier, state.startswith(UNKNOWN)
        if state == SHIFT or (tier == "hard" and not unlisted):
            return Kept(bank.size[:, [0, -1]], np.ones((len(bank.size), 2)))
        truth = UNKNOWN if unlisted else state
        least = UNLISTED_NATS[tier] if unlisted else RIVAL_NATS
        isolable = least
        if not unlisted:
            isolable = ABSORBABLE_NATS if state in ABSORBABLE else ISOLABLE_NATS
        size = np.linspace(bank.size[:, 0], bank.size[:, -1], _ALONG, axis=1)
        shape = bank.between(size) @ bank.shape
        kept = np.empty(size.shape)
        for k in range(_ALONG):
            gaps = np.exp(size[:, [k]]) * shape[:, k]
            alone = 0.5 * np.sum((gaps @ self._plausible) ** 2, axis=1)
            kept[:, k] = (alone >= isolable) * self._ahead(gaps, size[:, k], truth, least)
        return Kept(size, kept)

    def _ahead(self, gaps: Array, size: Array, truth: str, least: float) -> Array:
        """Return the probability that no rival comes nearer than so many nats, ``(J,)``."""
        white, which = gaps @ self._lab, int(np.argmin(np.abs(_SIZES - np.median(size))))
        own = np.sum(white**2, axis=1)
        kept = np.ones(len(gaps))
        for name, (weight, directions) in self._signatures.items():
            if can_rival(self._stage, LISTED[name], truth):
                left = 0.5 * (own[:, None] - (white @ directions[which].T) ** 2)
                kept *= (left >= least) @ weight
        return kept


def _root(precision: Array) -> Array:
    """Return a square root, so that ``g @ root`` has the squared norm ``g @ precision @ g``."""
    return np.asarray(np.linalg.cholesky(precision), dtype=np.float64)
