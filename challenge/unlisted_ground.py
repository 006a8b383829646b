"""Unlisted mechanisms of the ground: layers, crusts, patches and grades."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from challenge.contact import Contact
from challenge.mechanism import (
    DENSITY,
    DRAWBAR,
    RUT,
    UNKNOWN,
    Conditions,
    EffectKind,
    Family,
    Mechanism,
)
from challenge.soil import Soil

type Array = NDArray[np.float64]


def _hard_pan(rng: np.random.Generator) -> Family:
    """Stop the deeper ruts by a hard layer below the loose soil."""
    depth = float(rng.uniform(0.012, 0.045))

    def at(strength: float) -> Mechanism:
        def layered(soil: Soil, conditions: Conditions) -> Soil:
            del conditions
            return replace(soil, pan_depth_m=depth, pan_stiffness=2e4 * strength)

        text = f"a hard pan {1e3 * depth:.0f} mm down stops the deeper ruts ({strength:.2f})"
        return Mechanism(UNKNOWN, text, soil=layered)

    return Family(UNKNOWN, "hard_pan", at, 0.02, 4.0)


def _crust(rng: np.random.Generator) -> Family:
    """Let a crust carry the wheel until shear and pressure break through it."""
    threshold, width = float(rng.uniform(0.1, 0.35)), float(rng.uniform(0.004, 0.02))

    def at(strength: float) -> Mechanism:
        def crusted(soil: Soil, conditions: Conditions) -> Soil:
            broken = 1.0 / (1.0 + np.exp(-(conditions.slip - threshold) / width))
            support = 1.0 + strength * (0.5 - broken)
            return soil.scaled(support=np.maximum(support, 0.15), cohesion=1.0 - 0.3 * broken)

        text = f"a crust gives way at a slip of {threshold:.2f} ({strength:.2f})"
        return Mechanism(UNKNOWN, text, soil=crusted)

    return Family(UNKNOWN, "crust", at, 0.1, 1.6)


def _patch(rng: np.random.Generator) -> Family:
    """Put other soil under a stretch of the lane, met in the middle of the campaign."""
    first, last = float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.55, 0.8))

    def at(strength: float) -> Mechanism:
        def patchy(soil: Soil, conditions: Conditions) -> Soil:
            time = conditions.elapsed()
            inside = (time > first) & (time < last)
            support = np.where(inside, np.exp(strength), 1.0)
            return soil.scaled(support=support, cohesion=support**0.5)

        text = f"runs {first:.2f} to {last:.2f} of the campaign met other soil ({strength:+.2f})"
        return Mechanism(UNKNOWN, text, soil=patchy)

    return Family(UNKNOWN, "patch", at, 0.05, 1.2, (-1.0, 1.0))


def _rolling_terrain(rng: np.random.Generator) -> Family:
    """Roll the lane: its grade, and with it the pull, goes up and down along the campaign."""
    waves, phase = float(rng.uniform(1.5, 3.0)), float(rng.uniform(0.0, 2.0 * np.pi))

    def at(strength: float) -> Mechanism:
        def grade(contact: Contact, conditions: Conditions) -> Array:
            angle = strength * np.sin(2.0 * np.pi * waves * conditions.elapsed() + phase)
            return np.asarray(-contact.load_kn * np.sin(angle), dtype=np.float64)

        text = f"the lane rolls by {np.degrees(strength):.1f} degrees, {waves:.1f} waves"
        return Mechanism(UNKNOWN, text, force=grade)

    return Family(UNKNOWN, "rolling_terrain", at, 0.003, 0.12)


def _to_and_fro(rng: np.random.Generator) -> Family:
    """Drive every second pass back along a lane that slopes: uphill one way, downhill the other."""
    del rng

    def at(strength: float) -> Mechanism:
        def grade(contact: Contact, conditions: Conditions) -> Array:
            way = np.where(conditions.pass_number % 2 == 1, 1.0, -1.0)
            return np.asarray(-contact.load_kn * np.sin(strength) * way, dtype=np.float64)

        text = f"every second pass came back along a grade of {np.degrees(strength):.1f} degrees"
        return Mechanism(UNKNOWN, text, force=grade)

    return Family(UNKNOWN, "to_and_fro", at, 0.003, 0.12, (-1.0, 1.0))


def _hard_setting(rng: np.random.Generator) -> Family:
    """Set soil drier than a threshold hard, so that its cone index overstates its density."""
    threshold = float(rng.uniform(0.045, 0.06))

    def at(strength: float) -> Mechanism:
        def true(conditions: Conditions) -> Conditions:
            set_hard = 1.0 / (1.0 + np.exp((conditions.water_content - threshold) / 0.002))
            index = conditions.cone_index_kpa * np.exp(strength * (0.5 - set_hard))
            return replace(conditions, cone_index_kpa=index)

        text = f"soil drier than {threshold:.3f} has set hard ({strength:.2f})"
        return Mechanism(UNKNOWN, text, conditions=true)

    return Family(UNKNOWN, "hard_setting", at, 0.1, 3.0)


KINDS = (
    EffectKind(UNKNOWN, _hard_pan, (RUT,), ("slip",)),
    EffectKind(UNKNOWN, _crust, (DRAWBAR, RUT), ("slip",)),
    EffectKind(UNKNOWN, _patch, (RUT,), ("run_order",)),
    EffectKind(UNKNOWN, _rolling_terrain, (DRAWBAR,), ("run_order",)),
    EffectKind(UNKNOWN, _to_and_fro, (DRAWBAR,), ("pass_number",)),
    EffectKind(UNKNOWN, _hard_setting, (DENSITY,), ("water_content",)),
)
