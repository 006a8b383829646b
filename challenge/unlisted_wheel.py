"""Unlisted mechanisms of the wheel: how it rolls, bounces, hops, grips and clogs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from challenge.contact import Contact
from challenge.mechanism import (
    DRAWBAR,
    RUT,
    UNKNOWN,
    Conditions,
    EffectKind,
    Family,
    Mechanism,
    Readings,
)
from challenge.soil import Soil

type Array = NDArray[np.float64]

_LOOSE_KN = 0.5


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
        return Mechanism(UNKNOWN, text, readings=shown)

    return Family(UNKNOWN, "ripple", at, 0.02, 0.6)


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
        return Mechanism(UNKNOWN, text, readings=shown)

    return Family(UNKNOWN, "resonance", at, 0.03, 0.9, (-1.0, 1.0))


def _power_hop(rng: np.random.Generator) -> Family:
    """Let the wheel hop in a band of inflation pressure: less grip there, and deeper ruts."""
    centre, width = float(rng.uniform(150.0, 250.0)), float(rng.uniform(15.0, 35.0))

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            hop = strength * np.exp(-0.5 * ((conditions.inflation_kpa - centre) / width) ** 2)
            return {
                **readings,
                DRAWBAR: readings[DRAWBAR] * (1.0 - hop),
                RUT: readings[RUT] * (1.0 + 0.5 * hop),
            }

        text = f"the wheel hops at inflations around {centre:.0f} kPa ({strength:.2f})"
        return Mechanism(UNKNOWN, text, readings=shown)

    return Family(UNKNOWN, "power_hop", at, 0.02, 0.6)


def _bounce(rng: np.random.Generator) -> Family:
    """Let the wheel bounce on its carcass in a band of speed: less grip there, deeper ruts."""
    centre, width = (
        float(np.exp(rng.uniform(np.log(0.2), np.log(1.2)))),
        float(rng.uniform(0.3, 0.6)),
    )

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            off = np.log(conditions.speed_m_s / centre) / width
            bounce = strength * np.exp(-0.5 * off**2)
            return {
                **readings,
                DRAWBAR: readings[DRAWBAR] * (1.0 - bounce),
                RUT: readings[RUT] * (1.0 + 0.5 * bounce),
            }

        text = f"the wheel bounces at speeds around {centre:.2f} m/s ({strength:.2f})"
        return Mechanism(UNKNOWN, text, readings=shown)

    return Family(UNKNOWN, "bounce", at, 0.02, 0.6)


def _bead_slip(rng: np.random.Generator) -> Family:
    """Let the bead slip on the rim at low inflation once the pull is high."""
    pressure, width = float(rng.uniform(140.0, 180.0)), 12.0

    def at(strength: float) -> Mechanism:
        def slipping(contact: Contact, conditions: Conditions) -> Array:
            loose = 1.0 / (1.0 + np.exp((conditions.inflation_kpa - pressure) / width))
            over = np.maximum(contact.pull_kn - _LOOSE_KN, 0.0)
            return np.asarray(-strength * loose * over, dtype=np.float64)

        text = f"below {pressure:.0f} kPa the bead slips under high pull ({strength:.2f})"
        return Mechanism(UNKNOWN, text, force=slipping)

    return Family(UNKNOWN, "bead_slip", at, 0.05, 1.0)


def _clogging(rng: np.random.Generator) -> Family:
    """Clog the tread in a band of water content, where soil sticks: it then shears soil on soil."""
    centre, width = float(rng.uniform(0.045, 0.07)), float(rng.uniform(0.004, 0.01))

    def at(strength: float) -> Mechanism:
        def clogged(soil: Soil, conditions: Conditions) -> Soil:
            stuck = np.exp(-0.5 * ((conditions.water_content - centre) / width) ** 2)
            left = 1.0 - strength * stuck
            return replace(
                soil,
                tan_friction=soil.tan_friction * left,
                shear_modulus_m=soil.shear_modulus_m / left,
            )

        text = f"the tread clogs at water contents around {centre:.3f} ({strength:.2f})"
        return Mechanism(UNKNOWN, text, soil=clogged)

    return Family(UNKNOWN, "clogging", at, 0.03, 0.7)


KINDS = (
    EffectKind(UNKNOWN, _ripple, (DRAWBAR,), ("slip",)),
    EffectKind(UNKNOWN, _resonance, (DRAWBAR,), ("slip",)),
    EffectKind(UNKNOWN, _power_hop, (DRAWBAR, RUT), ("inflation_kpa",)),
    EffectKind(UNKNOWN, _bounce, (DRAWBAR, RUT), ("speed_m_s",)),
    EffectKind(UNKNOWN, _bead_slip, (DRAWBAR,), ("inflation_kpa",)),
    EffectKind(UNKNOWN, _clogging, (DRAWBAR,), ("water_content",)),
)
