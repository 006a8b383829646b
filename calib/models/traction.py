"""Empirical models of traction, shear stress and rut depth: equations and symbols in their cards.

Wismer & Luth (1973), Brixius (1987): the published coefficients are the medians of the priors. In
Brixius' net traction the two terms 0.04, of the gross traction and of the motion resistance,
cancel; printed forms that omit the first of them differ. The exponent of radial tyres is 9.5 or
10.5, by source: it lies within its prior.

Upadhyaya & Wulfsohn (1993): their summary and list of symbols could be seen, not the printed
equation. The form is that of three parameters, its coefficients are free, and none published is
used. The net traction coefficient p20 at 20 % slip, at which traction is usually compared, and the
motion resistance coefficient r at no slip are sampled:

    P/W = -r + (p20 + r) [1 - exp(-c s)]/[1 - exp(-0.2 c)]

An elliptic contact: the load presses evenly on the ellipse. A part of the tread that has come a
distance x into the contact has sheared the soil by j = s x, and Janosi and Hanamoto's stress
(c + p tan phi)[1 - exp(-j/K)], averaged over the ellipse, is its strength times

    G(q) = 1 - (4/pi) int_0^(pi/2) exp(-q sin t) cos^2 t dt = 1 - (2/q)[I1(q) - L1(q)]

with the modified Bessel and Struve functions of order one. That is the form of Upadhyaya & Wulfsohn
(1993) and of Rosca, Carlescu and others (2006-2022), of whose papers summaries and symbols could be
seen, not how they find the contact from the deflection and the sinkage: its length and width are
measured here, and the motion resistance coefficient rho is free.

Maclaurin (1990): N is his mobility number for q = 0.4. Both are read in one public program after
Saarilahti (2002), with k = 0.224 and m = 1.25, and could not be confirmed from a second source:
exponents and factor are free. N is the wheel numeric I b d/W times f^q, with f = delta/sqrt(b d).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.models.base import Array, Conditions, References
from calib.models.card import Equation, from_cards
from calib.models.constants import FAR_SLIP


def _wheel_numeric(x: Conditions) -> Array:
    """Return Cn = CI b d / W."""
    area = x["tyre_width_m"] * x["tyre_diameter_m"]
    return np.asarray(x["cone_index_kpa"] * area / x["normal_load_kn"])


def _wismer_luth(x: Conditions, c1: Array, c2: Array, c3: Array, c4: Array) -> Array:
    numeric = _wheel_numeric(x)
    gross = c1 * -np.expm1(-c2 * numeric * x["slip_ratio"])
    return np.asarray(x["normal_load_kn"] * (gross - c3 / numeric - c4))


def _brixius(x: Conditions, c1: Array, c2: Array, c3: Array, c4: Array, c5: Array) -> Array:
    flattened = 1.0 + 5.0 * x["tyre_deflection_mm"] / x["section_height_mm"]
    slender = 1.0 + 3.0 * x["tyre_width_m"] / x["tyre_diameter_m"]
    number, slip = _wheel_numeric(x) * flattened / slender, x["slip_ratio"]
    gross = c1 * np.expm1(-c2 * number) * np.expm1(-c3 * slip)
    resistance = c4 / number + c5 * slip / np.sqrt(number)
    return np.asarray(x["normal_load_kn"] * (gross - resistance))


def _upadhyaya(x: Conditions, p20: Array, r: Array, c: Array) -> Array:
    risen = np.expm1(-c * x["slip_ratio"]) / np.expm1(-0.2 * c)
    return np.asarray(x["normal_load_kn"] * ((p20 + r) * risen - r))


def _upadhyaya_published(ref: References, p20: Any, r: Any, c: Any) -> dict[str, Any]:
    span = (p20 + r) / -np.expm1(-0.2 * c)
    return {"a": span - r, "b": span / (span - r), "c": c}


def _upadhyaya_sampled(ref: References, a: Any, b: Any, c: Any) -> dict[str, Any]:
    return {"p20": a * (1.0 - b * np.exp(-0.2 * c)), "r": a * (b - 1.0), "c": c}


def mobilised(q: Array) -> Array:
    """Return G(q), the part of the strength that is mobilised on average over the ellipse.

    q is slip times length of the contact over the shear deformation modulus; G is odd in it.
    """
    size = np.abs(q)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    angle = 0.25 * np.pi * (nodes + 1.0)
    near = np.exp(-np.minimum(size, FAR_SLIP)[..., None] * np.sin(angle))
    rest = near @ (weights * np.cos(angle) ** 2)
    # Of the integral, with the root of 1 - u^2 in powers of u = sin t.
    x = np.maximum(size, FAR_SLIP) ** -2.0
    series = 1.0 - x * (1.0 + x * (3.0 + x * (45.0 + x * (1575.0 + x * 99225.0))))
    far = 4.0 / np.pi * np.sqrt(x) * series
    return np.asarray(np.sign(q) * (1.0 - np.where(size > FAR_SLIP, far, rest)))


def _contact_area(x: Conditions) -> Array:
    """Return the area of the contact, m2."""
    return np.asarray(0.25e-6 * np.pi * x["contact_length_mm"] * x["contact_width_mm"])


def _contact_references(x: Conditions) -> dict[str, float]:
    pressure = x["normal_load_kn"] / _contact_area(x)
    return {"contact_pressure_ref_kpa": float(np.exp(np.log(pressure).mean()))}


def _elliptic_contact(x: Conditions, mu: Array, share: Array, K: Array, rho: Array) -> Array:
    load, by_area = x["normal_load_kn"], x["contact_pressure_ref_kpa"] * _contact_area(x)
    strength = mu * ((1.0 - share) * load + share * by_area)
    return np.asarray(
        strength * mobilised(x["slip_ratio"] * x["contact_length_mm"] / K) - rho * load
    )


def _elliptic_published(ref: References, mu: Any, share: Any, K: Any, rho: Any) -> dict[str, Any]:
    cohesion = mu * share * ref["contact_pressure_ref_kpa"]
    return {"c": cohesion, "phi": np.degrees(np.arctan(mu * (1.0 - share))), "K": K, "rho": rho}


def _elliptic_sampled(ref: References, c: Any, phi: Any, K: Any, rho: Any) -> dict[str, Any]:
    cohesion = c / ref["contact_pressure_ref_kpa"]
    mu = cohesion + np.tan(np.radians(phi))
    return {"mu": mu, "share": cohesion / mu, "K": K, "rho": rho}


def _janosi_hanamoto(x: Conditions, c: Array, phi: Array, K: Array) -> Array:
    strength = c + x["normal_stress_kpa"] * np.tan(np.radians(phi))
    return np.asarray(-strength * np.expm1(-x["shear_displacement_mm"] / K))


def _rut_factors(x: Conditions) -> dict[str, Array]:
    """Return what the rut depth is a product of powers of."""
    size = np.sqrt(x["tyre_width_m"] * x["tyre_diameter_m"])
    return {
        "numeric": _wheel_numeric(x),
        "flattened": x["tyre_deflection_mm"] / 1000.0 / size,
        "diameter": x["tyre_diameter_m"],
    }


def _rut_references(x: Conditions) -> dict[str, float]:
    return {f"{n}_ref": float(np.exp(np.log(v).mean())) for n, v in _rut_factors(x).items()}


def _maclaurin_rut(x: Conditions, z_ref: Array, m: Array, q: Array) -> Array:
    numeric, flattened, diameter = (np.log(v / x[f"{n}_ref"]) for n, v in _rut_factors(x).items())
    return np.asarray(np.log(z_ref) + diameter - m * (numeric + q * flattened))


def _z_ref_over_k(ref: References, m: Any, q: Any) -> Any:
    number = ref["numeric_ref"] * ref["flattened_ref"] ** q
    return 1000.0 * ref["diameter_ref"] * number**-m


def _maclaurin_published(ref: References, z_ref: Any, m: Any, q: Any) -> dict[str, Any]:
    return {"k": z_ref / _z_ref_over_k(ref, m, q), "m": m, "q": q}


def _maclaurin_sampled(ref: References, k: Any, m: Any, q: Any) -> dict[str, Any]:
    return {"z_ref": k * _z_ref_over_k(ref, m, q), "m": m, "q": q}


MODELS = from_cards(
    "traction",
    maclaurin_rut=Equation(
        _maclaurin_rut, _maclaurin_published, _maclaurin_sampled, _rut_references
    ),
    wismer_luth=Equation(_wismer_luth),
    brixius=Equation(_brixius),
    upadhyaya=Equation(_upadhyaya, _upadhyaya_published, _upadhyaya_sampled),
    elliptic_contact=Equation(
        _elliptic_contact, _elliptic_published, _elliptic_sampled, _contact_references
    ),
    janosi_hanamoto=Equation(_janosi_hanamoto),
)
