"""What can have happened in a field: every branch of every mechanism, its dials left open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.challenge.effects import LISTED, UNLISTED
from calib.challenge.mechanics import Reality
from calib.challenge.mechanism import SHIFT, UNKNOWN, EffectKind, Family, Mechanism
from calib.challenge.oracle.script import Branch, branches
from calib.challenge.shift import LARGEST_AMOUNT, SMALLEST_AMOUNT, draw_shift, shifted

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cause:
    """One variant and direction of one mechanism, with dials and strength left open.

    Attributes
    ----------
    state : str
        A listed effect, ``parameter_shift``, or ``unknown:`` and the unlisted mechanism.
    share : float
        Its probability within the state.
    branch : Branch
        Of the mechanism's family, or of the shift's direction.
    sign : float
        Direction of the strength.
    dials : tuple of int
        Dials that matter; the others stay at their middles.
    """

    state: str
    share: float
    branch: Branch[Any]
    sign: float
    dials: tuple[int, ...]

    @property
    def normal(self) -> NDArray[np.bool_]:
        """For each dial that matters whether it is standard normal, else uniform on [0, 1]."""
        return np.array([self.branch.normal[i] for i in self.dials], dtype=bool)

    @property
    def strengths(self) -> tuple[float, float]:
        """Smallest and largest strength."""
        if self.state == SHIFT:
            return SMALLEST_AMOUNT, LARGEST_AMOUNT
        family: Family = self.branch.at()
        return family.low, family.high

    def _drawn(self, dials: Array) -> Any:
        every = [0.0 if normal else 0.5 for normal in self.branch.normal]
        for i, value in zip(self.dials, dials, strict=True):
            every[i] = float(value)
        return self.branch.at(every)

    def mechanism(self, dials: Array, strength: float) -> Mechanism:
        """Return the mechanism at some dials and strength."""
        family: Family = self._drawn(dials)
        return family.at(self.sign * strength)

    def reality(self, base: Reality, dials: Array, strength: float) -> Reality:
        """Return the reality in which this happened."""
        if self.state == SHIFT:
            change, _ = self._drawn(dials)
            return shifted(base, change, strength)
        return base.with_mechanisms(self.mechanism(dials, strength))

    def with_dials(self, dials: Sequence[int]) -> Cause:
        """Return the cause with only these dials open."""
        return replace(self, dials=tuple(dials))


@cache
def causes_of(state: str) -> tuple[Cause, ...]:
    """Return all variants and directions of a state, every dial open.

    Parameters
    ----------
    state : str
        As in `Cause`.
    """
    if state == SHIFT:
        return tuple(
            Cause(state, b.probability, b, 1.0, tuple(range(len(b.normal))))
            for b in branches(draw_shift)
        )
    found = []
    for branch in branches(kind_of_state(state).draw):
        signs = branch.at().signs
        for sign in dict.fromkeys(signs):
            share = branch.probability * signs.count(sign) / len(signs)
            found.append(Cause(state, share, branch, sign, tuple(range(len(branch.normal)))))
    return tuple(found)


def unlisted_states() -> dict[str, EffectKind]:
    """Return the unlisted mechanisms by the name of their state."""
    return {f"{UNKNOWN}:{next(branches(k.draw)).at().variant}": k for k in UNLISTED}


def kind_of_state(state: str) -> EffectKind:
    """Return the effect of a state, listed or not."""
    return LISTED[state] if state in LISTED else unlisted_states()[state]
