"""Unlisted mechanisms of instruments: they saturate, lag or follow the day."""

from __future__ import annotations

import numpy as np

from challenge.contact import Contact
from challenge.mechanism import (
    DENSITY,
    DRAWBAR,
    UNKNOWN,
    Conditions,
    EffectKind,
    Family,
    Mechanism,
    Readings,
)

_FULL_SCALE_KN = 2.2


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
        return Mechanism(UNKNOWN, text, readings=shown)

    return Family(UNKNOWN, "clipping", at, 0.02, 0.85)


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
        return Mechanism(UNKNOWN, text, readings=shown)

    return Family(UNKNOWN, "lag", at, 0.03, 0.8)


def _probe_cycle(rng: np.random.Generator) -> Family:
    """Let the density gauge follow the warmth of the day: it swings with the run order."""
    waves, phase = float(rng.uniform(1.0, 2.5)), float(rng.uniform(0.0, 2.0 * np.pi))

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            wave = np.sin(2.0 * np.pi * waves * conditions.elapsed() + phase)
            return {**readings, DENSITY: readings[DENSITY] + strength * wave}

        text = f"the density gauge swings {waves:.1f} times through {strength:.3f} g/cm3"
        return Mechanism(UNKNOWN, text, readings=shown)

    return Family(UNKNOWN, "probe_cycle", at, 0.005, 0.2)


KINDS = (
    EffectKind(UNKNOWN, _clipping, (DRAWBAR,), ("slip",)),
    EffectKind(UNKNOWN, _lag, (DRAWBAR,), ("run_order",)),
    EffectKind(UNKNOWN, _probe_cycle, (DENSITY,), ("run_order",)),
)
