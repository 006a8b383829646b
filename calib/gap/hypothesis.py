"""A hypothesis about a gap: which effects, shifts or free discrepancies act in the field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from calib.gap.effects import Effect
from calib.gap.shifts import ShiftAs
from calib.inference.priors import Priors

type Setting = Literal["pressure", "speed", "passes", "water"]
# Or the physical role of another condition that is recorded.
type SmoothOver = (
    Setting | Literal["slip", "level", "sinkage", "order", "before", "ripple", "all"] | str
)
type OnsetOver = Literal["slip", "level", "sinkage", "order", "water", "cone", "low_pressure"]


@dataclass(frozen=True)
class Hypothesis:
    """What may cause the gap.

    Parameters
    ----------
    name : str
        Contract name, pairs in alphabetical order.
    effects : tuple of Effect
        In alphabetical order, as in its name.
    shift : float
        Prior sd of parameter shifts in units of the parameters' own prior sds; 0 for none.
    shift_as : {"alone", "soil"}
        Whether parameters shift each by itself, or together as with another soil.
    smooth : float
        Prior sd of a free discrepancy, in units of the noise; 0 for none.
    smooth_outputs : tuple of str
        Outputs that have the free discrepancy.
    smooth_over : SmoothOver
        What it may vary with: slip, the level of the predicted output (as a saturating
        instrument would), the predicted rut depth (as layered soil would), the order of the runs
        (as weather or another stretch of ground would), how far the output is from that of the run
        before (as a recorder that lags would), slip in waves too short for the first (as lugs that
        pass would), one of inflation pressure, speed, passes and water content alone (as a wheel
        that hops at some pressure would), another recorded condition by its physical role, or
        every condition.
    smooth_decay : float
        Number of half waves from which the discrepancy's coefficients fall off.
    onset_over : OnsetOver, optional
        Instead of smooth, the discrepancy may set in beyond a threshold of one of these, water
        content and cone index among them: a step and a change of slope there. Below a threshold
        of inflation pressure, where an underinflated tyre may creep on its rim or buckle: a step,
        and a part of the output's level.
    share : float
        Part of the prior probability of its name.
    """

    name: str
    effects: tuple[Effect, ...] = ()
    effect_priors: tuple[Priors, ...] = ()
    shift: float = 0.0
    shift_as: ShiftAs = "alone"
    smooth: float = 0.0
    smooth_outputs: tuple[str, ...] = ()
    smooth_over: SmoothOver = "all"
    smooth_decay: float = 4.0
    onset_over: OnsetOver | None = None
    share: float = 1.0
