"""Listed effects that act on what was recorded: slip, gauges, probes and the load cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from challenge.contact import Contact
from challenge.mechanism import (
    DENSITY,
    DRAWBAR,
    RUT,
    Conditions,
    EffectKind,
    Family,
    Mechanism,
    Readings,
)

type Array = NDArray[np.float64]

_BOTH_SIGNS = (-1.0, 1.0)
_NOMINAL_KPA = 200.0


def _slip_zero(rng: np.random.Generator) -> Family:
    """Record slip with a wrong rolling radius, constant or worse as the tyre flattens."""
    flattening = 0.0 if rng.random() < 0.7 else float(rng.uniform(0.3, 0.8))
    text = "the rolling radius behind the recorded slip is wrong"
    text += " and more so at low inflation" if flattening else ""

    def at(strength: float) -> Mechanism:
        def true(conditions: Conditions) -> Conditions:
            error = strength * (_NOMINAL_KPA / conditions.inflation_kpa) ** flattening
            return replace(conditions, slip=1.0 - (1.0 - conditions.slip) * (1.0 + error))

        return Mechanism("slip_zero_shift", f"{text}: {strength:+.3f}", conditions=true)

    variant = "flattening" if flattening else "constant"
    return Family("slip_zero_shift", variant, at, 0.002, 0.07, _BOTH_SIGNS)


def _force_offset(rng: np.random.Generator) -> Family:
    """Offset the load cell by a constant."""
    del rng

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del conditions, contact
            return {**readings, DRAWBAR: readings[DRAWBAR] + strength}

        text = f"the drawbar reading is off by {strength:+.3f} kN"
        return Mechanism("force_offset", text, readings=shown)

    return Family("force_offset", "constant", at, 0.01, 0.6, _BOTH_SIGNS)


def _drift_shape(rng: np.random.Generator, variant: str) -> tuple[float, float]:
    if variant == "warm_up":
        return float(rng.uniform(0.15, 0.5)), 0.0
    return float(rng.uniform(0.1, 0.5)), float(rng.uniform(0.3, 0.9))


def _drift(rng: np.random.Generator) -> Family:
    """Let the load cell drift: steadily, as it warms up, or from some run on to a plateau."""
    variant = str(rng.choice(["linear", "warm_up", "piecewise"]))
    first, span = _drift_shape(rng, variant)

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del contact
            time = conditions.elapsed()
            if variant == "linear":
                shape = time
            elif variant == "warm_up":
                shape = -np.expm1(-time / first)
            else:
                shape = np.clip((time - first) / span, 0.0, 1.0)
            return {**readings, DRAWBAR: readings[DRAWBAR] + strength * shape}

        text = f"the drawbar reading drifts ({variant}) by {strength:+.3f} kN over the campaign"
        return Mechanism("sensor_drift", text, readings=shown)

    return Family("sensor_drift", variant, at, 0.02, 0.9, _BOTH_SIGNS)


def _pressure_gauge(rng: np.random.Generator) -> Family:
    """Give the gauge a wrong gain or a wrong zero."""
    variant = "gain" if rng.random() < 0.5 else "offset"

    def at(strength: float) -> Mechanism:
        def true(conditions: Conditions) -> Conditions:
            recorded = conditions.inflation_kpa
            if variant == "gain":
                inflation = recorded * (1.0 + strength)
            else:
                inflation = recorded + strength * _NOMINAL_KPA
            return replace(conditions, inflation_kpa=np.maximum(inflation, 40.0))

        text = f"true inflation differs from the gauge's by a {variant}: {strength:+.3f}"
        return Mechanism("pressure_gauge_bias", text, conditions=true)

    return Family("pressure_gauge_bias", variant, at, 0.03, 0.4, _BOTH_SIGNS)


def _cone_index(rng: np.random.Generator) -> Family:
    """Give the penetrometer a wrong gain, or friction on its rod that adds a constant."""
    variant = "gain" if rng.random() < 0.4 else "offset"

    def at(strength: float) -> Mechanism:
        def true(conditions: Conditions) -> Conditions:
            recorded = conditions.cone_index_kpa
            if variant == "gain":
                index = recorded * np.exp(strength)
            else:
                index = recorded + 400.0 * strength
            return replace(conditions, cone_index_kpa=np.maximum(index, 20.0))

        text = f"the cone penetrometer reads wrong by a {variant}: {strength:+.3f}"
        return Mechanism("cone_index_bias", text, conditions=true)

    return Family("cone_index_bias", variant, at, 0.03, 1.2, _BOTH_SIGNS)


def _water_content(rng: np.random.Generator) -> Family:
    """Set the moisture probe off by a constant or by a factor."""
    variant = "offset" if rng.random() < 0.6 else "gain"

    def at(strength: float) -> Mechanism:
        def true(conditions: Conditions) -> Conditions:
            recorded = conditions.water_content
            if variant == "offset":
                water = recorded + 0.05 * strength
            else:
                water = recorded * (1.0 + strength)
            return replace(conditions, water_content=np.maximum(water, 0.008))

        text = f"the moisture probe reads wrong by a {variant}: {strength:+.3f}"
        return Mechanism("water_content_bias", text, conditions=true)

    return Family("water_content_bias", variant, at, 0.05, 1.5, _BOTH_SIGNS)


def _load_transfer(rng: np.random.Generator) -> Family:
    """Set the hitch above the axle: the pull loads the wheel, or relieves it."""
    variant = "loads" if rng.random() < 0.75 else "relieves"
    sign = 1.0 if variant == "loads" else -1.0

    def at(strength: float) -> Mechanism:
        text = f"the drawbar pull {variant} the wheel by {strength:.3f} kN per kN"
        return Mechanism("load_transfer", text, load_transfer=sign * strength)

    return Family("load_transfer", variant, at, 0.03, 0.9)


def _rebound(rng: np.random.Generator) -> Family:
    """Let the soil spring back behind the wheel, more where it was sheared more."""
    variant = str(rng.choice(["threshold", "power"]))
    centre, width = float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.04, 0.12))
    power, share = float(rng.uniform(1.3, 2.5)), float(rng.uniform(0.0, 0.15))

    def at(strength: float) -> Mechanism:
        def shown(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
            del conditions
            slip = np.clip(contact.slip, 0.0, 1.0)
            if variant == "threshold":
                growth = 1.0 / (1.0 + np.exp(-(slip - centre) / width))
            else:
                growth = (slip / 0.7) ** power
            left = 1.0 - strength * (share + (1.0 - share) * growth)
            return {**readings, RUT: readings[RUT] * np.maximum(left, 0.1)}

        text = f"{strength:.2f} of the sinkage springs back at high slip ({variant})"
        return Mechanism("rut_rebound", text, readings=shown)

    return Family("rut_rebound", variant, at, 0.02, 0.6)


KINDS = (
    EffectKind("slip_zero_shift", _slip_zero, (DRAWBAR,), ("slip",)),
    EffectKind("force_offset", _force_offset, (DRAWBAR,)),
    EffectKind("sensor_drift", _drift, (DRAWBAR,), ("run_order",)),
    EffectKind("pressure_gauge_bias", _pressure_gauge, varies=("inflation_kpa",)),
    EffectKind("cone_index_bias", _cone_index, (DENSITY,), ("cone_index_kpa",)),
    EffectKind("water_content_bias", _water_content, (DENSITY,), ("water_content",)),
    EffectKind("load_transfer", _load_transfer, (DRAWBAR,)),
    EffectKind("rut_rebound", _rebound, (RUT,), ("slip",)),
)
