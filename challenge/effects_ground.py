"""Listed effects that act in the ground: passes, speed, water, shear, and the wheel in the soil."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from challenge.contact import Contact
from challenge.mechanism import DRAWBAR, RUT, Conditions, EffectKind, Family
from challenge.soil import Soil
from challenge.tyre import CONTACT_WIDTH_M

type Array = NDArray[np.float64]

_LAB_SPEED, _LAB_WATER = 0.06, 0.05
_TREAD_TO_SOIL = 1.5  # tangent of the soil's friction over that of rubber on soil


def _multipass(rng: np.random.Generator) -> Family:
    """Let each pass densify what the last one left, until the load can do no more."""
    variant = "power" if rng.random() < 0.4 else "saturating"
    passes, cohesion = float(rng.uniform(0.5, 2.5)), float(rng.uniform(0.2, 0.7))
    stiffer = float(rng.uniform(0.0, 0.4))

    def compacted(strength: float, soil: Soil, conditions: Conditions) -> Soil:
        earlier = conditions.pass_number - 1.0
        if variant == "power":
            support = (1.0 + earlier) ** strength
        else:
            support = 1.0 + strength * -np.expm1(-earlier / passes)
        soil = soil.scaled(support=support, cohesion=support**cohesion)
        return replace(soil, shear_modulus_m=soil.shear_modulus_m * support**-stiffer)

    def text(strength: float) -> str:
        return f"earlier passes compacted the soil ({variant}, {strength:.2f})"

    return Family(variant, text, 0.04, 2.5, soil=compacted)


def _rate(rng: np.random.Generator) -> Family:
    """Let strength grow with the logarithm or a power of speed: cohesion, support, shear."""
    variant = "log" if rng.random() < 0.5 else "power"
    cohesion, support = float(rng.uniform(0.5, 2.0)), float(rng.uniform(0.3, 1.2))
    friction = float(rng.uniform(0.0, 0.3))

    def faster(strength: float, soil: Soil, conditions: Conditions) -> Soil:
        ratio = np.log(conditions.speed_m_s / _LAB_SPEED)
        raised = 1.0 + strength * ratio if variant == "log" else np.exp(strength * ratio)
        return soil.stronger(np.maximum(raised, 0.3), support, cohesion, friction)

    def text(strength: float) -> str:
        return f"soil strength changes with speed ({variant}, {strength:+.3f})"

    return Family(variant, text, 0.005, 0.35, (1.0, 1.0, 1.0, -1.0), soil=faster)


def _moisture(rng: np.random.Generator) -> Family:
    """Let suction, and with it cohesion and support, fall as the water content rises."""
    variant = "suction" if rng.random() < 0.5 else "exponential"
    cohesion, support = float(rng.uniform(0.4, 1.5)), float(rng.uniform(0.4, 1.2))
    friction = float(rng.uniform(0.0, 0.35))

    def wetter(strength: float, soil: Soil, conditions: Conditions) -> Soil:
        water = np.maximum(conditions.water_content, 0.005)
        if variant == "suction":
            factor = (water / _LAB_WATER) ** -strength
        else:
            factor = np.exp(-strength * (water - _LAB_WATER) / _LAB_WATER)
        return soil.stronger(factor, support, cohesion, friction)

    def text(strength: float) -> str:
        return f"water softens the soil ({variant}, {strength:.2f})"

    return Family(variant, text, 0.05, 2.5, soil=wetter)


def _post_peak(rng: np.random.Generator) -> Family:
    """Let shear strength fall past its peak to a residual, over a short or long displacement."""
    softening = float(rng.uniform(0.02, 0.12))

    def softer(strength: float, soil: Soil, _: Conditions) -> Soil:
        residual = np.asarray(soil.residual) * (1.0 - strength)
        return replace(soil, residual=residual, softening_m=softening)

    def text(strength: float) -> str:
        return f"shear strength falls by a further {strength:.2f} past its peak"

    return Family("short" if softening < 0.05 else "long", text, 0.02, 0.7, soil=softer)


def _slip_sinkage(rng: np.random.Generator) -> Family:
    """Take support away under shear: by flow to the sides, by digging, or by remoulding."""
    variant = str(rng.choice(["flow", "dig", "remould"]))
    scale, power = float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.7, 1.3))

    def sinking(strength: float, soil: Soil, conditions: Conditions) -> Soil:
        size = np.clip(np.abs(conditions.slip), 0.0, 0.95)
        if variant == "flow":
            extra = 1.0 + strength * -np.expm1(-size / scale)
        elif variant == "dig":
            extra = 1.0 + strength * size / (1.0 - 0.6 * size)
        else:
            extra = np.exp(strength * size**power)
        return replace(soil, extra_flow=soil.extra_flow * extra)

    def text(strength: float) -> str:
        return f"the slipping wheel sinks further ({variant}, {strength:.2f})"

    return Family(variant, text, 0.05, 3.0, soil=sinking)


def _at_the_tread(contact: Contact) -> tuple[Array, Array, Array]:
    """Return slip, the tangent of the soil's own friction, and its cohesion, ``(N,)`` each."""
    slip = np.clip(contact.slip, 0.0, 0.95)
    tangent = _TREAD_TO_SOIL * np.asarray(contact.soil.tan_friction)[:, 0]
    return slip, tangent, np.asarray(contact.soil.cohesion_kpa)[:, 0]


def _bulldozing(rng: np.random.Generator) -> Family:
    """Push a passive wedge ahead of the wheel, with a pile that slip feeds; Terzaghi or Hegedus."""
    variant = "terzaghi" if rng.random() < 0.5 else "hegedus"
    pile, approach = float(rng.uniform(0.5, 3.0)), float(np.radians(rng.uniform(35.0, 60.0)))

    def wedge(strength: float, contact: Contact, _: Conditions) -> Array:
        slip, tangent, cohesion = _at_the_tread(contact)
        friction = np.arctan(tangent)
        depth = contact.sinkage_m * (1.0 + pile * slip)
        weight = np.asarray(contact.soil.unit_weight)[:, 0]
        if variant == "terzaghi":
            passive = np.tan(np.pi / 4.0 + friction / 2.0) ** 2
            stress = 0.5 * weight * depth * passive + 2.0 * cohesion * np.sqrt(passive)
        else:
            plane = np.pi / 4.0 - friction / 2.0
            wide = 1.0 / np.tan(plane) + 1.0 / np.tan(approach)
            stress = np.tan(plane + friction) * (0.5 * weight * depth * wide + cohesion * wide)
        return np.asarray(-strength * CONTACT_WIDTH_M * depth * stress, dtype=np.float64)

    def text(strength: float) -> str:
        return f"the wheel pushes a wedge of soil ahead of it ({variant}, {strength:.2f} wedges)"

    return Family(variant, text, 0.1, 12.0, force=wedge)


def _lugs(rng: np.random.Generator) -> Family:
    """Let lugs cut the soil: passive pressure on their faces, or shear along their sides."""
    variant = "faces" if rng.random() < 0.5 else "sides"
    height, modulus = float(rng.uniform(0.015, 0.04)), float(rng.uniform(0.04, 0.15))

    def grip(strength: float, contact: Contact, _: Conditions) -> Array:
        slip, tangent, cohesion = _at_the_tread(contact)
        travel = slip * contact.length_m
        if variant == "faces":
            passive = np.tan(np.pi / 4.0 + np.arctan(tangent) / 2.0) ** 2
            stress = contact.flat_pressure_kpa * passive * 0.3 + 2.0 * cohesion * passive**0.5
            area = np.full(slip.shape, 2.0 * CONTACT_WIDTH_M * height)
        else:
            stress = cohesion + 0.6 * contact.flat_pressure_kpa * tangent
            area = 2.0 * height * contact.length_m
        force = strength * stress * area * -np.expm1(-travel / modulus)
        return np.asarray(force, dtype=np.float64)

    def text(strength: float) -> str:
        return f"tread lugs add thrust on their {variant} as slip grows ({strength:.2f})"

    return Family(variant, text, 0.05, 4.0, force=grip)


KINDS = (
    EffectKind("multipass_compaction", _multipass, varies=("pass_number",)),
    EffectKind("rate_effect", _rate, varies=("speed_m_s",)),
    EffectKind("moisture_softening", _moisture, varies=("water_content",)),
    EffectKind("post_peak_softening", _post_peak, (DRAWBAR,), ("slip",)),
    EffectKind("slip_sinkage", _slip_sinkage, (RUT,), ("slip",)),
    EffectKind("bulldozing_resistance", _bulldozing, (DRAWBAR,), ("slip",)),
    EffectKind("lug_thrust", _lugs, (DRAWBAR,), ("slip",)),
)
