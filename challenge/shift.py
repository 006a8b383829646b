"""Parameter shift: the same mechanics on another soil, or under a softer or stiffer tyre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from challenge.density import ConeLaw
from challenge.mechanics import Reality
from challenge.soil import Soil

SMALLEST_AMOUNT, LARGEST_AMOUNT = 0.03, 1.5


def _other_soil(soil: Soil, change: dict[str, float], amount: float) -> Soil:
    support, cohesion = np.exp(amount * change["support"]), np.exp(amount * change["cohesion"])
    soil = soil.scaled(support=float(support), cohesion=float(cohesion))
    return replace(
        soil,
        tan_friction=soil.tan_friction * float(np.exp(amount * change["friction"])),
        shear_modulus_m=soil.shear_modulus_m * float(np.exp(amount * change["shear"])),
        exponent=soil.exponent * float(np.exp(amount * change["exponent"])),
        slip_flow=soil.slip_flow * float(np.exp(amount * change["flow"])),
    )


def _other_cone(cone: ConeLaw, change: dict[str, float], amount: float) -> ConeLaw:
    return replace(
        cone,
        slope=cone.slope * float(np.exp(amount * change["exponent"])),
        reference_kpa=cone.reference_kpa * float(np.exp(amount * change["support"])),
        suction_share=cone.suction_share * float(np.exp(amount * change["cohesion"])),
    )


def draw_shift(rng: np.random.Generator) -> tuple[dict[str, float], str]:
    """Draw a direction in which the field's soil differs from the lab's.

    Returns
    -------
    dict
        Logarithmic changes at amount 1, by property.
    str
        What differs, for the key.
    """
    spread = {"support": 0.8, "cohesion": 0.6, "friction": 0.25, "shear": 0.5, "exponent": 0.2}
    change = {name: float(rng.normal(0.0, sd)) for name, sd in spread.items()}
    change["flow"] = float(rng.normal(0.0, 0.25))
    change["length"] = float(rng.normal(0.0, 0.1)) if rng.random() < 0.3 else 0.0
    worded = ", ".join(f"{name} {value:+.2f}" for name, value in change.items() if value)
    return change, f"another soil and tyre in the field (log changes times amount: {worded})"


def shifted(reality: Reality, change: dict[str, float], amount: float) -> Reality:
    """Return the field's reality, the rolling radius being that of the lab.

    Parameters
    ----------
    reality : Reality
        The lab's.
    change : dict
        From `draw_shift`.
    amount : float
        Multiplies every logarithmic change.
    """
    length = reality.tyre.length_factor * float(np.exp(amount * change["length"]))
    return replace(
        reality,
        soil=_other_soil(reality.soil, change, amount),
        cone=_other_cone(reality.cone, change, amount),
        tyre=replace(reality.tyre, length_factor=length),
        rolling=reality.rolling or reality,
    )
