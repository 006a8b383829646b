"""The effects a diagnosis knows by name: one class each, grouped by what they come from."""

from __future__ import annotations

from calib.data.registry import Registry
from calib.gap.effects.base import Effect, Known, View
from calib.gap.effects.instruments import (
    ConeIndexBias,
    ForceOffset,
    PressureGaugeBias,
    SensorDrift,
    SensorStep,
    SlipZeroShift,
    WaterContentBias,
)
from calib.gap.effects.wheel import (
    BulldozingResistance,
    LoadTransfer,
    LugThrust,
    MoistureSoftening,
    MultipassCompaction,
    PostPeakSoftening,
    RateEffect,
    RutRebound,
    SlipSinkage,
)

__all__ = ["EFFECTS", "Effect", "Known", "View"]

EFFECTS: Registry[Effect] = Registry(
    "effect",
    lambda effect: effect.name,
    SlipZeroShift(),
    ForceOffset(),
    SensorDrift(),
    SensorStep(),
    PressureGaugeBias(),
    MultipassCompaction(),
    RateEffect(),
    MoistureSoftening(),
    BulldozingResistance(),
    LugThrust(),
    SlipSinkage(),
    RutRebound(),
    PostPeakSoftening(),
    LoadTransfer(),
    ConeIndexBias(),
    WaterContentBias(),
    group="terracalib.effects",
)
