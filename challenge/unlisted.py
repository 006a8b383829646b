"""Unlisted mechanisms of ground, wheel and instruments, which no effect of the diagnosis names."""

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
    Readings,
    bump,
    step,
)  # fmt: skip
from challenge.soil import Soil

type Array = NDArray[np.float64]

_LOOSE_KN, _FULL_SCALE_KN = 0.5, 2.2
_TURN = 2.0 * np.pi


def _hard_pan(rng: np.random.Generator) -> Family:
    """Stop the deeper ruts by a hard layer below the loose soil."""
    depth = float(rng.uniform(0.012, 0.045))

    def layered(strength: float, soil: Soil, _: Conditions) -> Soil:
        return replace(soil, pan_depth_m=depth, pan_stiffness=2e4 * strength)

    def text(strength: float) -> str:
        return f"a hard pan {1e3 * depth:.0f} mm down stops the deeper ruts ({strength:.2f})"

    return Family("hard_pan", text, 0.02, 4.0, soil=layered)


def _crust(rng: np.random.Generator) -> Family:
    """Let a crust carry the wheel until shear and pressure break through it."""
    threshold, width = float(rng.uniform(0.1, 0.35)), float(rng.uniform(0.004, 0.02))

    def crusted(strength: float, soil: Soil, conditions: Conditions) -> Soil:
        broken = step(conditions.slip, threshold, width)
        support = 1.0 + strength * (0.5 - broken)
        return soil.scaled(support=np.maximum(support, 0.15), cohesion=1.0 - 0.3 * broken)

    def text(strength: float) -> str:
        return f"a crust gives way at a slip of {threshold:.2f} ({strength:.2f})"

    return Family("crust", text, 0.1, 1.6, soil=crusted)


def _patch(rng: np.random.Generator) -> Family:
    """Put other soil under a stretch of the lane, met in the middle of the campaign."""
    first, last = float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.55, 0.8))

    def patchy(strength: float, soil: Soil, conditions: Conditions) -> Soil:
        time = conditions.elapsed()
        support = np.where((time > first) & (time < last), np.exp(strength), 1.0)
        return soil.scaled(support=support, cohesion=support**0.5)

    def text(strength: float) -> str:
        return f"runs {first:.2f} to {last:.2f} of the campaign met other soil ({strength:+.2f})"

    return Family("patch", text, 0.05, 1.2, (-1.0, 1.0), soil=patchy)


def _rolling_terrain(rng: np.random.Generator) -> Family:
    """Roll the lane: its grade, and with it the pull, goes up and down along the campaign."""
    waves, phase = float(rng.uniform(1.5, 3.0)), float(rng.uniform(0.0, _TURN))

    def grade(strength: float, contact: Contact, conditions: Conditions) -> Array:
        angle = strength * np.sin(_TURN * waves * conditions.elapsed() + phase)
        return np.asarray(-contact.load_kn * np.sin(angle), dtype=np.float64)

    def text(strength: float) -> str:
        return f"the lane rolls by {np.degrees(strength):.1f} degrees, {waves:.1f} waves"

    return Family("rolling_terrain", text, 0.003, 0.12, force=grade)


def _to_and_fro(_: np.random.Generator) -> Family:
    """Drive every second pass back along a lane that slopes: uphill one way, downhill the other."""

    def grade(strength: float, contact: Contact, conditions: Conditions) -> Array:
        way = np.where(conditions.pass_number % 2 == 1, 1.0, -1.0)
        return np.asarray(-contact.load_kn * np.sin(strength) * way, dtype=np.float64)

    def text(strength: float) -> str:
        return f"every second pass came back along a grade of {np.degrees(strength):.1f} degrees"

    return Family("to_and_fro", text, 0.003, 0.12, (-1.0, 1.0), force=grade)


def _hard_setting(rng: np.random.Generator) -> Family:
    """Set soil drier than a threshold hard, so that its cone index overstates its density."""
    threshold = float(rng.uniform(0.045, 0.06))

    def true(strength: float, conditions: Conditions) -> Conditions:
        set_hard = step(-conditions.water_content, -threshold, 0.002)
        index = conditions.cone_index_kpa * np.exp(strength * (0.5 - set_hard))
        return replace(conditions, cone_index_kpa=index)

    def text(strength: float) -> str:
        return f"soil drier than {threshold:.3f} has set hard ({strength:.2f})"

    return Family("hard_setting", text, 0.1, 3.0, conditions=true)


def _ripple(rng: np.random.Generator) -> Family:
    """Rock the wheel by lug passing: the pull rises and falls with slip."""
    period, phase = float(rng.uniform(0.08, 0.25)), float(rng.uniform(0.0, _TURN))

    def shown(strength: float, readings: Readings, conditions: Conditions, _: Contact) -> Readings:
        wave = np.sin(_TURN * conditions.slip / period + phase)
        rut = readings[RUT] * (1.0 - 0.4 * strength * wave)
        return {DRAWBAR: readings[DRAWBAR] + strength * wave, RUT: rut}

    def text(strength: float) -> str:
        return f"lug passing ripples the pull with slip, period {period:.2f}, {strength:.2f} kN"

    return Family("ripple", text, 0.02, 0.6, readings=shown)


def _resonance(rng: np.random.Generator) -> Family:
    """Let the carcass resonate in a band of slip and grip better or worse there."""
    centre, width = float(rng.uniform(0.2, 0.5)), float(rng.uniform(0.03, 0.08))

    def shown(strength: float, readings: Readings, conditions: Conditions, _: Contact) -> Readings:
        band = bump(conditions.slip, centre, width)
        rut = readings[RUT] * np.exp(0.6 * np.abs(strength) * band)
        return {DRAWBAR: readings[DRAWBAR] + strength * band, RUT: rut}

    def text(strength: float) -> str:
        return f"the carcass resonates around a slip of {centre:.2f}: {strength:+.2f} kN"

    return Family("resonance", text, 0.03, 0.9, (-1.0, 1.0), readings=shown)


def _less_grip(readings: Readings, lost: Array) -> Readings:
    """Return less pull and deeper ruts, of a wheel that loses contact for a part of the time."""
    return {DRAWBAR: readings[DRAWBAR] * (1.0 - lost), RUT: readings[RUT] * (1.0 + 0.5 * lost)}


def _power_hop(rng: np.random.Generator) -> Family:
    """Let the wheel hop in a band of inflation pressure: less grip there, and deeper ruts."""
    centre, width = float(rng.uniform(150.0, 250.0)), float(rng.uniform(15.0, 35.0))

    def shown(strength: float, readings: Readings, conditions: Conditions, _: Contact) -> Readings:
        return _less_grip(readings, strength * bump(conditions.inflation_kpa, centre, width))

    def text(strength: float) -> str:
        return f"the wheel hops at inflations around {centre:.0f} kPa ({strength:.2f})"

    return Family("power_hop", text, 0.02, 0.6, readings=shown)


def _bounce(rng: np.random.Generator) -> Family:
    """Let the wheel bounce on its carcass in a band of speed: less grip there, deeper ruts."""
    centre = float(np.exp(rng.uniform(np.log(0.2), np.log(1.2))))
    width = float(rng.uniform(0.3, 0.6))

    def shown(strength: float, readings: Readings, conditions: Conditions, _: Contact) -> Readings:
        return _less_grip(
            readings, strength * bump(np.log(conditions.speed_m_s / centre), 0.0, width)
        )

    def text(strength: float) -> str:
        return f"the wheel bounces at speeds around {centre:.2f} m/s ({strength:.2f})"

    return Family("bounce", text, 0.02, 0.6, readings=shown)


def _bead_slip(rng: np.random.Generator) -> Family:
    """Let the bead slip on the rim at low inflation once the pull is high."""
    pressure, width = float(rng.uniform(140.0, 180.0)), 12.0

    def slipping(strength: float, contact: Contact, conditions: Conditions) -> Array:
        loose = step(-conditions.inflation_kpa, -pressure, width)
        over = np.maximum(contact.pull_kn - _LOOSE_KN, 0.0)
        return np.asarray(-strength * loose * over, dtype=np.float64)

    def text(strength: float) -> str:
        return f"below {pressure:.0f} kPa the bead slips under high pull ({strength:.2f})"

    return Family("bead_slip", text, 0.05, 1.0, force=slipping)


def _clogging(rng: np.random.Generator) -> Family:
    """Clog the tread in a band of water content, where soil sticks: it then shears soil on soil."""
    centre, width = float(rng.uniform(0.045, 0.07)), float(rng.uniform(0.004, 0.01))

    def clogged(strength: float, soil: Soil, conditions: Conditions) -> Soil:
        left = 1.0 - strength * bump(conditions.water_content, centre, width)
        tangent, modulus = soil.tan_friction * left, soil.shear_modulus_m / left
        return replace(soil, tan_friction=tangent, shear_modulus_m=modulus)

    def text(strength: float) -> str:
        return f"the tread clogs at water contents around {centre:.3f} ({strength:.2f})"

    return Family("clogging", text, 0.03, 0.7, soil=clogged)


def _clipping(rng: np.random.Generator) -> Family:
    """Saturate the amplifier: readings above a ceiling are pressed down to it."""
    softness = float(rng.uniform(0.01, 0.05))

    def shown(strength: float, readings: Readings, _: Conditions, __: Contact) -> Readings:
        pull, ceiling = readings[DRAWBAR], _FULL_SCALE_KN * (1.0 - strength)
        # Soft minimum, so that the corner is as round as an amplifier's.
        return {DRAWBAR: pull - np.logaddexp(0.0, (pull - ceiling) / softness) * softness}

    def text(strength: float) -> str:
        return f"the amplifier saturates at {_FULL_SCALE_KN * (1.0 - strength):.2f} kN"

    return Family("clipping", text, 0.02, 0.85, readings=shown)


def _lag(_: np.random.Generator) -> Family:
    """Let the recorder lag: each reading keeps a part of the reading of the run before."""

    def shown(strength: float, readings: Readings, conditions: Conditions, _: Contact) -> Readings:
        kept = {}
        order = np.argsort(conditions.run_order, kind="stable")
        for name in (DRAWBAR, RUT):
            before = np.empty_like(readings[name])
            before[order] = readings[name][order][np.maximum(np.arange(order.size) - 1, 0)]
            kept[name] = readings[name] + strength * (before - readings[name])
        return kept

    def text(strength: float) -> str:
        return f"each reading keeps {strength:.2f} of the run before (recorder hysteresis)"

    return Family("lag", text, 0.03, 0.8, readings=shown)


def _probe_cycle(rng: np.random.Generator) -> Family:
    """Let the density gauge follow the warmth of the day: it swings with the run order."""
    waves, phase = float(rng.uniform(1.0, 2.5)), float(rng.uniform(0.0, _TURN))

    def shown(strength: float, readings: Readings, conditions: Conditions, _: Contact) -> Readings:
        wave = np.sin(_TURN * waves * conditions.elapsed() + phase)
        return {DENSITY: readings[DENSITY] + strength * wave}

    def text(strength: float) -> str:
        return f"the density gauge swings {waves:.1f} times through {strength:.3f} g/cm3"

    return Family("probe_cycle", text, 0.005, 0.2, readings=shown)


KINDS = (
    EffectKind(UNKNOWN, _hard_pan, (RUT,), ("slip",)),
    EffectKind(UNKNOWN, _crust, (DRAWBAR, RUT), ("slip",)),
    EffectKind(UNKNOWN, _patch, (RUT,), ("run_order",)),
    EffectKind(UNKNOWN, _rolling_terrain, (DRAWBAR,), ("run_order",)),
    EffectKind(UNKNOWN, _to_and_fro, (DRAWBAR,), ("pass_number",)),
    EffectKind(UNKNOWN, _hard_setting, (DENSITY,), ("water_content",)),
    EffectKind(UNKNOWN, _ripple, (DRAWBAR,), ("slip",)),
    EffectKind(UNKNOWN, _resonance, (DRAWBAR,), ("slip",)),
    EffectKind(UNKNOWN, _power_hop, (DRAWBAR, RUT), ("inflation_kpa",)),
    EffectKind(UNKNOWN, _bounce, (DRAWBAR, RUT), ("speed_m_s",)),
    EffectKind(UNKNOWN, _bead_slip, (DRAWBAR,), ("inflation_kpa",)),
    EffectKind(UNKNOWN, _clogging, (DRAWBAR,), ("water_content",)),
    EffectKind(UNKNOWN, _clipping, (DRAWBAR,), ("slip",)),
    EffectKind(UNKNOWN, _lag, (DRAWBAR,), ("run_order",)),
    EffectKind(UNKNOWN, _probe_cycle, (DENSITY,), ("run_order",)),
)
