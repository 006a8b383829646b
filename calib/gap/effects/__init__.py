"""The effects a diagnosis knows by name: one class each, grouped by what they come from."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from calib.gap.effects.base import Effect, View
from calib.gap.effects.instruments import (
    ConeIndexBias,
    ForceOffset,
    PressureGaugeBias,
    SensorDrift,
    SlipZeroShift,
    WaterContentBias,
)
from calib.gap.effects.soil import MoistureSoftening, MultipassCompaction, RateEffect
from calib.gap.effects.wheel import (
    BulldozingResistance,
    LoadTransfer,
    LugThrust,
    PostPeakSoftening,
    RutRebound,
    SlipSinkage,
)

__all__ = ["EFFECTS", "Effect", "View"]

EFFECTS: Mapping[str, Effect] = MappingProxyType(
    {
        effect.name: effect
        for effect in (
            SlipZeroShift(),
            ForceOffset(),
            SensorDrift(),
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
        )
    }
)
