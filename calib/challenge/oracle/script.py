"""The generator's own draws made to order: every branch it can take, and its dials at any value.

A drawing function is given a stand-in for `numpy.random.Generator`. Its choices (`choice`, and
`random` compared with a threshold) are taken from a list, its continuous numbers (`uniform`,
`normal`) from dials. So the generator is enumerated and integrated over, and never written twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]
type Draw[T] = Callable[[np.random.Generator], T]


class _Coin(float):
    """A uniform number that is only ever asked whether it lies below a threshold."""

    script: Script

    def __lt__(self, threshold: object) -> bool:
        share = float(cast(float, threshold))
        return self.script.turn((share, 1.0 - share)) == 0


class Script:
    """Stands in for a random generator.

    Parameters
    ----------
    outcomes : sequence of int
        Which option each choice takes; the first possible one beyond their end.
    dials : sequence of float
        Values of the continuous numbers: in [0, 1] for a uniform one, standard normal for a
        normal one; their middles beyond the end.
    """

    def __init__(self, outcomes: Sequence[int] = (), dials: Sequence[float] = ()) -> None:
        self._outcomes, self._dials = outcomes, dials
        self.turns: list[tuple[float, ...]] = []
        self.taken: list[int] = []
        self.bell: list[bool] = []

    def turn(self, shares: tuple[float, ...]) -> int:
        """Take a choice among options of these probabilities."""
        i = len(self.taken)
        first = next(k for k, share in enumerate(shares) if share > 0.0)
        self.turns.append(shares)
        self.taken.append(self._outcomes[i] if i < len(self._outcomes) else first)
        return self.taken[-1]

    def _dial(self, *, normal: bool) -> float:
        i = len(self.bell)
        self.bell.append(normal)
        middle = 0.0 if normal else 0.5
        return float(self._dials[i]) if i < len(self._dials) else middle

    def random(self) -> float:
        """Return a uniform number that is to be compared with a threshold."""
        coin = _Coin(0.5)
        coin.script = self
        return coin

    def choice(self, options: Any, p: Any = None) -> Any:
        """Return one of some options, or of so many numbers from 0."""
        listed = list(range(options)) if isinstance(options, int) else list(options)
        shares = np.full(len(listed), 1.0 / len(listed)) if p is None else np.asarray(p)
        return listed[self.turn(tuple(float(share) for share in shares))]

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Return a number between two."""
        return low + (high - low) * self._dial(normal=False)

    def normal(self, loc: float = 0.0, scale: float = 1.0) -> float:
        """Return a normal number."""
        return loc + scale * self._dial(normal=True)


@dataclass(frozen=True)
class Branch[T]:
    """One way through the choices of a drawing function, its dials left open.

    Attributes
    ----------
    draw : callable
        The drawing function.
    outcomes : tuple of int
        What each choice came out as.
    probability : float
        How often.
    normal : tuple of bool
        For each dial whether it is a standard normal one, else uniform on [0, 1].
    """

    draw: Draw[T]
    outcomes: tuple[int, ...]
    probability: float
    normal: tuple[bool, ...]

    def at(self, dials: Sequence[float] | Array = ()) -> T:
        """Return what is drawn with the dials at these values, the middles by default."""
        return self.draw(cast(np.random.Generator, Script(self.outcomes, list(dials))))


def branches[T](draw: Draw[T]) -> Iterator[Branch[T]]:
    """Yield every branch of a drawing function whose probability is not nil.

    Parameters
    ----------
    draw : callable
        Draws by `choice`, `uniform` and `normal`, one number each, and by `random` compared with
        a threshold.
    """
    left: list[tuple[int, ...]] = [()]
    while left:
        prefix = left.pop()
        script = Script(prefix)
        draw(cast(np.random.Generator, script))
        shares = [turn[k] for turn, k in zip(script.turns, script.taken, strict=True)]
        taken = tuple(script.taken)
        yield Branch(draw, taken, float(np.prod(shares)), tuple(script.bell))
        for i in range(len(prefix), len(taken)):
            others = range(taken[i] + 1, len(script.turns[i]))
            left += [(*taken[:i], k) for k in others if script.turns[i][k] > 0.0]
