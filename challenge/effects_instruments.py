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
    Readings,
    step,
)  # fmt: skip

type Array = NDArray[np.float64]

_BOTH_SIGNS = (-1.0, 1.0)
_NOMINAL_KPA = 200.0


def _slip_zero(rng: np.random.Generator) -> Family:
    """Record slip with a wrong rolling radius, constant or worse as the tyre flattens."""
    flattening = 0.0 if rng.random() < 0.7 else float(rng.uniform(0.3, 0.8))
    more = " and more so at low inflation" if flattening else ""

    def true(strength: float, conditions: Conditions) -> Conditions:
        error = strength * (_NOMINAL_KPA / conditions.inflation_kpa) ** flattening
        return replace(conditions, slip=1.0 - (1.0 - conditions.slip) * (1.0 + error))

    def text(strength: float) -> str:
        return f"the rolling radius behind the recorded slip is wrong{more}: {strength:+.3f}"

    variant = "flattening" if flattening else "constant"
    return Family(variant, text, 0.002, 0.07, _BOTH_SIGNS, conditions=true)


def _force_offset(_: np.random.Generator) -> Family:
    """Offset the load cell by a constant."""

    def shown(strength: float, readings: Readings, _: Conditions, __: Contact) -> Readings:
        return {DRAWBAR: readings[DRAWBAR] + strength}

    def text(strength: float) -> str:
        return f"the drawbar reading is off by {strength:+.3f} kN"

    return Family("constant", text, 0.01, 0.6, _BOTH_SIGNS, readings=shown)


def _drift(rng: np.random.Generator) -> Family:
    """Let the load cell drift: steadily, as it warms up, or from some run on to a plateau."""
    variant = str(rng.choice(["linear", "warm_up", "piecewise"]))
    if variant == "warm_up":
        first, span = float(rng.uniform(0.15, 0.5)), 0.0
    else:
        first, span = float(rng.uniform(0.1, 0.5)), float(rng.uniform(0.3, 0.9))

    def shown(strength: float, readings: Readings, conditions: Conditions, _: Contact) -> Readings:
        time = conditions.elapsed()
        if variant == "linear":
            shape = time
        elif variant == "warm_up":
            shape = -np.expm1(-time / first)
        else:
            shape = np.clip((time - first) / span, 0.0, 1.0)
        return {DRAWBAR: readings[DRAWBAR] + strength * shape}

    def text(strength: float) -> str:
        return f"the drawbar reading drifts ({variant}) by {strength:+.3f} kN over the campaign"

    return Family(variant, text, 0.02, 0.9, _BOTH_SIGNS, readings=shown)


def _wrong_gauge(
    column: str, what: str, variant: str, low: float, high: float, offset: float, least: float,
    *, exponential: bool = False,
) -> Family:  # fmt: skip
    """Give a gauge a wrong gain, or a wrong zero by an offset times the strength."""

    def true(strength: float, conditions: Conditions) -> Conditions:
        recorded: Array = getattr(conditions, column)
        gain = np.exp(strength) if exponential else 1.0 + strength
        value = recorded * gain if variant == "gain" else recorded + offset * strength
        return replace(conditions, **{column: np.maximum(value, least)})

    def text(strength: float) -> str:
        return f"{what} by a {variant}: {strength:+.3f}"

    return Family(variant, text, low, high, _BOTH_SIGNS, conditions=true)


def _pressure_gauge(rng: np.random.Generator) -> Family:
    """Give the gauge a wrong gain or a wrong zero."""
    variant = "gain" if rng.random() < 0.5 else "offset"
    what = "true inflation differs from the gauge's"
    return _wrong_gauge("inflation_kpa", what, variant, 0.03, 0.4, _NOMINAL_KPA, 40.0)


def _cone_index(rng: np.random.Generator) -> Family:
    """Give the penetrometer a wrong gain, or friction on its rod that adds a constant."""
    variant = "gain" if rng.random() < 0.4 else "offset"
    what = "the cone penetrometer reads wrong"
    return _wrong_gauge(
        "cone_index_kpa", what, variant, 0.03, 1.2, 400.0, 20.0, exponential=True
    )  # fmt: skip


def _water_content(rng: np.random.Generator) -> Family:
    """Set the moisture probe off by a constant or by a factor."""
    variant = "offset" if rng.random() < 0.6 else "gain"
    what = "the moisture probe reads wrong"
    return _wrong_gauge("water_content", what, variant, 0.05, 1.5, 0.05, 0.008)


def _load_transfer(rng: np.random.Generator) -> Family:
    """Set the hitch above the axle: the pull loads the wheel, or relieves it."""
    variant = "loads" if rng.random() < 0.75 else "relieves"

    def text(strength: float) -> str:
        return f"the drawbar pull {variant} the wheel by {strength:.3f} kN per kN"

    return Family(variant, text, 0.03, 0.9, load_transfer=1.0 if variant == "loads" else -1.0)


def _rebound(rng: np.random.Generator) -> Family:
    """Let the soil spring back behind the wheel, more where it was sheared more."""
    variant = str(rng.choice(["threshold", "power"]))
    centre, width = float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.04, 0.12))
    power, share = float(rng.uniform(1.3, 2.5)), float(rng.uniform(0.0, 0.15))

    def shown(strength: float, readings: Readings, _: Conditions, contact: Contact) -> Readings:
        slip = np.clip(contact.slip, 0.0, 1.0)
        growth = step(slip, centre, width) if variant == "threshold" else (slip / 0.7) ** power
        left = 1.0 - strength * (share + (1.0 - share) * growth)
        return {RUT: readings[RUT] * np.maximum(left, 0.1)}

    def text(strength: float) -> str:
        return f"{strength:.2f} of the sinkage springs back at high slip ({variant})"

    return Family(variant, text, 0.02, 0.6, readings=shown)


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
