"""Soil under load: bulk density, and sinkage by ground pressure, slip and plate width.

Bulk density from cone index and water content (Ayers & Perumpral 1982; Eqs 1 and 2):

    gravimetric   gamma_d = { (CI/C1) [C2 + (theta_g - C3)^2] }^(1/C4)
    volumetric    CI = A1 gamma_d^A2 / (A3 + (theta_v/gamma_d - A4)^2), implicit in gamma_d

with gamma_d in g/cm^3, CI in kPa, theta_g in g/g, theta_v in cm^3/cm^3 and water at 1 g/cm^3. C1
spans orders of magnitude and is collinear with C4, so the density gamma_ref at the mean (log) cone
index and mean water content of the calibration data is sampled in its place.

Sinkage, with p in kPa, z and b in m and slip s as a fraction:

    p = k z^n, n = n0 + n1 s                    Bekker, with slip sinkage (Eqs 17-21)
    p = (kc/b + kphi) z^n                       Bekker (1956), plates of several widths
    p = (k1 + k2 b) (z/b)^n                     Reece (1965), k1 = c kc', k2 = gamma kphi'
    z = z0 (1 + s)/(1 - a s), p = k z0^n        Lyasko (2010)

ln k and n are almost collinear at the centimetre sinkages of a tyre (d ln k/dn = -ln z, about 4),
so the sinkage z_ref at the mean pressure (and width) of the data is sampled in the place of the
modulus, and the part that width has in the modulus there in the place of its second constant. The
noise is on ln z: ground pressure is set, sinkage is measured.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.models.base import Array, Conditions, References
from calib.models.card import Equation, from_cards

PRESSURE, WIDTH = "average_ground_pressure_kpa", "plate_width_mm"


def bulk_density(
    cone_index_kpa: Array, water_g_g: Array, C1: Array | float, C2: Array | float,
    C3: Array | float, C4: Array | float,
) -> Array:  # fmt: skip
    """Evaluate Eq 1 in g/cm^3, from cone index (kPa), water content (g/g) and soil coefficients.

    Ayers & Perumpral (1982), as Eq 1 of He, Sandu & Osorio (2019),
    doi:10.1016/j.jterra.2019.07.003.
    """
    return np.asarray((cone_index_kpa / C1 * (C2 + (water_g_g - C3) ** 2)) ** (1.0 / C4))


def _ln_wet(water: Array | float, still: Array, best: Array) -> Array:
    return np.asarray(np.log(still + (water - best) ** 2))


def _water(x: Conditions) -> Array:
    return x["gravimetric_water_content" if "gravimetric_water_content" in x
             else "volumetric_water_content"]  # fmt: skip


def _density_references(x: Conditions) -> dict[str, float]:
    index = float(np.exp(np.log(x["cone_index_kpa"]).mean()))
    return {"ci_ref_kpa": index, "water_ref": float(_water(x).mean())}


def _gravimetric(x: Conditions, gamma_ref: Array, C2: Array, C3: Array, C4: Array) -> Array:
    ln_ci = np.log(x["cone_index_kpa"] / x["ci_ref_kpa"])
    wetter = _ln_wet(_water(x), C2, C3) - _ln_wet(x["water_ref"], C2, C3)
    return np.asarray(gamma_ref * np.exp((ln_ci + wetter) / C4))


def _gravimetric_published(
    ref: References, gamma_ref: Array, C2: Array, C3: Array, C4: Array
) -> dict[str, Array]:
    ln_c1 = np.log(ref["ci_ref_kpa"]) + _ln_wet(ref["water_ref"], C2, C3) - C4 * np.log(gamma_ref)
    return {"C1": np.exp(ln_c1), "C2": C2, "C3": C3, "C4": C4}


def _gravimetric_sampled(ref: References, **soil: Any) -> dict[str, Any]:
    index, water = np.array(ref["ci_ref_kpa"]), np.array(ref["water_ref"])
    return {"gamma_ref": bulk_density(index, water, **soil), **soil}


def _volumetric(x: Conditions, gamma_ref: Array, A2: Array, A3: Array, A4: Array) -> Array:
    at_reference = A2 * np.log(gamma_ref) - _ln_wet(x["water_ref"] / gamma_ref, A3, A4)
    ln_ci = np.log(x["cone_index_kpa"] / x["ci_ref_kpa"])
    return np.asarray(np.exp(_ln_density(at_reference + ln_ci, _water(x), A2, A3, A4)))


def _ln_density(target: Array, water: Array, A2: Array, A3: Array, A4: Array) -> Array:
    """Solve A2 x - ln(A3 + (water e^-x - A4)^2) = target for x = ln gamma; NaN without a root."""
    from scipy.optimize.elementwise import find_root  # late: a tenth of a second

    def excess(x: Array, target: Array, water: Array, A2: Array, A3: Array, A4: Array) -> Array:
        return np.asarray(A2 * x - _ln_wet(water * np.exp(-x), A3, A4) - target)

    ends = float(np.log(0.1)), float(np.log(5.0))  # g/cm^3, beyond all soils
    found = find_root(excess, ends, args=(target, water, A2, A3, A4), tolerances={"xatol": 1e-13})
    return np.where(found.success, found.x, np.nan)


def _volumetric_published(
    ref: References, gamma_ref: Array, A2: Array, A3: Array, A4: Array
) -> dict[str, Array]:
    wet = _ln_wet(ref["water_ref"] / gamma_ref, A3, A4)
    ln_a1 = np.log(ref["ci_ref_kpa"]) + wet - A2 * np.log(gamma_ref)
    return {"A1": np.exp(ln_a1), "A2": A2, "A3": A3, "A4": A4}


def _volumetric_sampled(ref: References, A1: Any, A2: Any, A3: Any, A4: Any) -> dict[str, Any]:
    target = np.log(ref["ci_ref_kpa"] / A1)
    gamma = np.exp(_ln_density(target, np.array(ref["water_ref"]), A2, A3, A4))
    return {"gamma_ref": gamma, "A2": A2, "A3": A3, "A4": A4}


def rut_depth(
    pressure_kpa: Array, slip_ratio: Array | float, k: Array | float, n0: Array | float,
    n1: Array | float,
) -> Array:  # fmt: skip
    """Evaluate Eq 21, zt = (pgr/k)^(1/(n0 + n1 s)), in metres, as it broadcasts.

    Pressure in kPa, slip as a fraction, the modulus k in kPa/m^n. He, Sandu & Osorio (2019), Eqs
    17-21, doi:10.1016/j.jterra.2019.07.003.
    """
    return np.asarray((pressure_kpa / k) ** (1.0 / (n0 + n1 * slip_ratio)))


def _sinkage_references(x: Conditions) -> dict[str, float]:
    """Return the geometric means of the pressure, and of the width of plates if there is one."""
    names = {"p_ref_kpa": PRESSURE, "b_ref_mm": WIDTH}
    return {
        name: float(np.exp(np.log(x[column]).mean())) for name, column in names.items()
        if column in x
    }  # fmt: skip


def _ln_pressure(x: Conditions) -> Array:
    return np.asarray(np.log(x[PRESSURE] / x["p_ref_kpa"]))


def _ln_rut(x: Conditions, z_ref: Array, n0: Array, exponent: Array) -> Array:
    """Return ln z (mm), the modulus being of a sinkage in metres; NaN without an exponent."""
    exponent = np.where(exponent > 0.0, exponent, np.nan)
    return np.asarray(np.log(1000.0) + (_ln_pressure(x) + n0 * np.log(z_ref / 1000.0)) / exponent)


def _bekker(x: Conditions, z_ref: Array, n: Array) -> Array:
    return _ln_rut(x, z_ref, n, n)


def _modified_bekker(x: Conditions, z_ref: Array, n0: Array, n1: Array) -> Array:
    return _ln_rut(x, z_ref, n0, n0 + n1 * x["slip_ratio"])


def _bekker_plate(x: Conditions, z_ref: Array, n: Array, share: Array) -> Array:
    stiffer = np.log(1.0 - share + share / (x[WIDTH] / x["b_ref_mm"]))
    return np.asarray(np.log(z_ref) + (_ln_pressure(x) - stiffer) / n)


def _reece(x: Conditions, z_ref: Array, n: Array, share: Array) -> Array:
    wider = x[WIDTH] / x["b_ref_mm"]
    stiffer = np.log(1.0 - share + share * wider)
    return np.asarray(np.log(z_ref * wider) + (_ln_pressure(x) - stiffer) / n)


def _reece_plate(x: Conditions, k1: Array, k2: Array, n: Array) -> Array:
    width = x[WIDTH] / 1000.0
    return np.asarray(np.log(x[WIDTH]) + (np.log(x[PRESSURE]) - np.log(k1 + k2 * width)) / n)


def _lyasko(x: Conditions, z_ref: Array, n: Array, a: Array) -> Array:
    slip = x["slip_ratio"]
    deeper = np.log((1.0 + slip) / (1.0 - a * slip))
    return np.asarray(np.log(z_ref) + _ln_pressure(x) / n + deeper)


def _modulus(ref: References, z_ref: Any, n: Any, width_mm: float = 1000.0) -> Any:
    """Return k (kPa) of p = k (z/b)^n by its sinkage z_ref (mm) at the mean pressure."""
    return ref["p_ref_kpa"] * (z_ref / width_mm) ** -n


def _sinkage(ref: References, k: Any, n: Any, width_mm: float = 1000.0) -> Any:
    """Return the sinkage (mm) at the mean pressure by k (kPa), the inverse of `_modulus`."""
    return width_mm * (ref["p_ref_kpa"] / k) ** (1.0 / n)


def _k_of(ref: References, z_ref: Any, **others: Any) -> dict[str, Any]:
    exponent = others["n" if "n" in others else "n0"]
    return {**others, "k": _modulus(ref, z_ref, exponent)}


def _z_ref_of(ref: References, k: Any, **others: Any) -> dict[str, Any]:
    exponent = others["n" if "n" in others else "n0"]
    return {"z_ref": _sinkage(ref, k, exponent), **others}


def _plate_published(ref: References, z_ref: Any, n: Any, share: Any) -> dict[str, Any]:
    k = _modulus(ref, z_ref, n)
    return {"n": n, "kc": share * k * ref["b_ref_mm"] / 1000.0, "kphi": (1.0 - share) * k}


def _plate_sampled(ref: References, n: Any, kc: Any, kphi: Any) -> dict[str, Any]:
    by_width = kc / (ref["b_ref_mm"] / 1000.0)
    k = by_width + kphi
    return {"z_ref": _sinkage(ref, k, n), "n": n, "share": by_width / k}


def _reece_published(ref: References, z_ref: Any, n: Any, share: Any) -> dict[str, Any]:
    k = _modulus(ref, z_ref, n, ref["b_ref_mm"])
    return {"n": n, "k1": (1.0 - share) * k, "k2": share * k / ref["b_ref_mm"] * 1000.0}


def _reece_sampled(ref: References, n: Any, k1: Any, k2: Any) -> dict[str, Any]:
    by_width = k2 * ref["b_ref_mm"] / 1000.0
    k = k1 + by_width
    return {"z_ref": _sinkage(ref, k, n, ref["b_ref_mm"]), "n": n, "share": by_width / k}


MODELS = from_cards(
    "soil",
    ayers_perumpral=Equation(
        _gravimetric, _gravimetric_published, _gravimetric_sampled, _density_references
    ),
    ayers_perumpral_volumetric=Equation(
        _volumetric, _volumetric_published, _volumetric_sampled, _density_references
    ),
    bekker=Equation(_bekker, _k_of, _z_ref_of, _sinkage_references),
    modified_bekker=Equation(_modified_bekker, _k_of, _z_ref_of, _sinkage_references),
    bekker_plate=Equation(_bekker_plate, _plate_published, _plate_sampled, _sinkage_references),
    reece=Equation(_reece, _reece_published, _reece_sampled, _sinkage_references),
    reece_plate=Equation(_reece_plate),
    lyasko=Equation(_lyasko, _k_of, _z_ref_of, _sinkage_references),
)
