"""Mechanisms that the contract does not list: a diagnosis should say ``unknown``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.challenge.contact import Contact
from calib.challenge.mechanism import (
    DENSITY,
    DRAWBAR,
    RUT,
    Conditions,
    EffectKind,
    Family,
    Mechanism,
    Readings,
)
from calib.challenge.soil import Soil

type Array = NDArray[np.float64]
type Draw = Callable[[np.random.Generator], Family]

_UNKNOWN = "unknown"
_FULL_SCALE_KN = 2.2
_LOOSE_KN = 0.5


def _hard_pan(rng: np.random.Generator) -> Family:
    """Stop the deeper ruts by a hard layer below the loose soil."""
    depth = float(rng.uniform(0.012, 0.045))

    def at(strength: float) -> Mechanism:
        def layered(soil: Soil, conditions: Conditions) -> Soil:
            del conditions
            return replace(soil, pan_depth_m=depth, pan_stiffness=2e4 * strength)

        text = f"a hard pan {1e3 * depth:.0f} mm down stops the deeper ruts ({strength:.2f})"
        return Mechanism(_UNKNOWN, text, soil=layered)

    return Family(_UNKNOWN, "hard_pan", at, 0.02, 4.0)


def _ripple(rng: np.random.Generator) -> Family:
    """Rock the wheel by lug passing: the pull rises and falls with slip."""
    period, phase = float(rng.uniform(0.08, 0.25)), float(rng.uniform(0.0, 2.0 * np.pi))

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            wave = np.sin(2.0 * np.pi * conditions.slip / period + phase)
            return {
                **readings,
                DRAWBAR: readings[DRAWBAR] + strength * wave,
                RUT: readings[RUT] * (1.0 - 0.4 * strength * wave),
            }

        text = f"lug passing ripples the pull with slip, period {period:.2f}, {strength:.2f} kN"
        return Mechanism(_UNKNOWN, text, readings=shown)

    return Family(_UNKNOWN, "ripple", at, 0.02, 0.6)


def _clipping(rng: np.random.Generator) -> Family:
    """Saturate the amplifier: readings above a ceiling are pressed down to it."""
    softness = float(rng.uniform(0.01, 0.05))

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del conditions, contact
            pull = readings[DRAWBAR]
            ceiling = _FULL_SCALE_KN * (1.0 - strength)
            # Soft minimum, so that the corner is as round as an amplifier's.
            over = np.logaddexp(0.0, (pull - ceiling) / softness) * softness
            return {**readings, DRAWBAR: pull - over}

        text = f"the amplifier saturates at {_FULL_SCALE_KN * (1.0 - strength):.2f} kN"
        return Mechanism(_UNKNOWN, text, readings=shown)

    return Family(_UNKNOWN, "clipping", at, 0.02, 0.85)


def _crust(rng: np.random.Generator) -> Family:
    """Let a crust carry the wheel until shear and pressure break through it."""
    threshold, width = float(rng.uniform(0.1, 0.35)), float(rng.uniform(0.004, 0.02))

    def at(strength: float) -> Mechanism:
        def crusted(soil: Soil, conditions: Conditions) -> Soil:
            broken = 1.0 / (1.0 + np.exp(-(conditions.slip - threshold) / width))
            support = 1.0 + strength * (0.5 - broken)
            return soil.scaled(support=np.maximum(support, 0.15), cohesion=1.0 - 0.3 * broken)

        text = f"a crust gives way at a slip of {threshold:.2f} ({strength:.2f})"
        return Mechanism(_UNKNOWN, text, soil=crusted)

    return Family(_UNKNOWN, "crust", at, 0.1, 1.6)


def _rolling_terrain(rng: np.random.Generator) -> Family:
    """Roll the lane: its grade, and with it the pull, goes up and down along the campaign."""
    waves, phase = float(rng.uniform(1.5, 3.0)), float(rng.uniform(0.0, 2.0 * np.pi))

    def at(strength: float) -> Mechanism:
        def grade(contact: Contact, conditions: Conditions) -> Array:
            angle = strength * np.sin(2.0 * np.pi * waves * conditions.elapsed() + phase)
            return np.asarray(-contact.load_kn * np.sin(angle), dtype=np.float64)

        text = f"the lane rolls by {np.degrees(strength):.1f} degrees, {waves:.1f} waves"
        return Mechanism(_UNKNOWN, text, force=grade)

    return Family(_UNKNOWN, "rolling_terrain", at, 0.003, 0.12)


def _resonance(rng: np.random.Generator) -> Family:
    """Let the carcass resonate in a band of slip and grip better or worse there."""
    centre, width = float(rng.uniform(0.2, 0.5)), float(rng.uniform(0.03, 0.08))

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            bump = np.exp(-0.5 * ((conditions.slip - centre) / width) ** 2)
            return {
                **readings,
                DRAWBAR: readings[DRAWBAR] + strength * bump,
                RUT: readings[RUT] * np.exp(0.6 * np.abs(strength) * bump),
            }

        text = f"the carcass resonates around a slip of {centre:.2f}: {strength:+.2f} kN"
        return Mechanism(_UNKNOWN, text, readings=shown)

    return Family(_UNKNOWN, "resonance", at, 0.03, 0.9, (-1.0, 1.0))


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
        return Mechanism(_UNKNOWN, text, soil=patchy)

    return Family(_UNKNOWN, "patch", at, 0.05, 1.2, (-1.0, 1.0))


def _bead_slip(rng: np.random.Generator) -> Family:
    """Let the bead slip on the rim at low inflation once the pull is high."""
    pressure, width = float(rng.uniform(140.0, 180.0)), 12.0

    def at(strength: float) -> Mechanism:
        def slipping(contact: Contact, conditions: Conditions) -> Array:
            loose = 1.0 / (1.0 + np.exp((conditions.inflation_kpa - pressure) / width))
            over = np.maximum(contact.pull_kn - _LOOSE_KN, 0.0)
            return np.asarray(-strength * loose * over, dtype=np.float64)

        text = f"below {pressure:.0f} kPa the bead slips under high pull ({strength:.2f})"
        return Mechanism(_UNKNOWN, text, force=slipping)

    return Family(_UNKNOWN, "bead_slip", at, 0.05, 1.0)


def _lag(rng: np.random.Generator) -> Family:
    """Let the recorder lag: each reading keeps a part of the reading of the run before."""
    del rng

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            kept = {}
            order = np.argsort(conditions.run_order, kind="stable")
            for name, reading in readings.items():
                before = np.empty_like(reading)
                before[order] = reading[order][np.maximum(np.arange(order.size) - 1, 0)]
                kept[name] = reading + strength * (before - reading)
            return {**kept, DENSITY: readings[DENSITY]}

        text = f"each reading keeps {strength:.2f} of the run before (recorder hysteresis)"
        return Mechanism(_UNKNOWN, text, readings=shown)

    return Family(_UNKNOWN, "lag", at, 0.03, 0.8)


def _probe_cycle(rng: np.random.Generator) -> Family:
    """Let the density gauge follow the warmth of the day: it swings with the run order."""
    waves, phase = float(rng.uniform(1.0, 2.5)), float(rng.uniform(0.0, 2.0 * np.pi))

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            wave = np.sin(2.0 * np.pi * waves * conditions.elapsed() + phase)
            return {**readings, DENSITY: readings[DENSITY] + strength * wave}

        text = f"the density gauge swings {waves:.1f} times through {strength:.3f} g/cm3"
        return Mechanism(_UNKNOWN, text, readings=shown)

    return Family(_UNKNOWN, "probe_cycle", at, 0.005, 0.2)


def _hard_setting(rng: np.random.Generator) -> Family:
    """Set soil drier than a threshold hard, so that its cone index overstates its density."""
    threshold = float(rng.uniform(0.045, 0.06))

    def at(strength: float) -> Mechanism:
        def true(conditions: Conditions) -> Conditions:
            set_hard = 1.0 / (1.0 + np.exp((conditions.water_content - threshold) / 0.002))
            index = conditions.cone_index_kpa * np.exp(strength * (0.5 - set_hard))
            return replace(conditions, cone_index_kpa=index)

        text = f"soil drier than {threshold:.3f} has set hard ({strength:.2f})"
        return Mechanism(_UNKNOWN, text, conditions=true)

    return Family(_UNKNOWN, "hard_setting", at, 0.1, 3.0)


KINDS: tuple[EffectKind, ...] = (
    EffectKind(_UNKNOWN, _hard_pan, (RUT,), ("slip",)),
    EffectKind(_UNKNOWN, _ripple, (DRAWBAR,), ("slip",)),
    EffectKind(_UNKNOWN, _clipping, (DRAWBAR,), ("slip",)),
    EffectKind(_UNKNOWN, _crust, (DRAWBAR, RUT), ("slip",)),
    EffectKind(_UNKNOWN, _rolling_terrain, (DRAWBAR,), ("run_order",)),
    EffectKind(_UNKNOWN, _resonance, (DRAWBAR,), ("slip",)),
    EffectKind(_UNKNOWN, _patch, (RUT,), ("run_order",)),
    EffectKind(_UNKNOWN, _bead_slip, (DRAWBAR,), ("inflation_kpa",)),
    EffectKind(_UNKNOWN, _lag, (DRAWBAR,), ("run_order",)),
    EffectKind(_UNKNOWN, _probe_cycle, (DENSITY,), ("run_order",)),
    EffectKind(_UNKNOWN, _hard_setting, (DENSITY,), ("water_content",)),
)
