"""Bulk density from cone index and water content (Ayers & Perumpral 1982; Eqs 1 and 2).

Gravimetric, Eq 1:  gamma_d = { (CI/C1) [C2 + (theta_g - C3)^2] }^(1/C4)
Volumetric, Eq 2:   CI = A1 gamma_d^A2 / (A3 + (theta_v/gamma_d - A4)^2), implicit in gamma_d

with gamma_d in g/cm^3, CI in kPa, theta_g in g/g, theta_v in cm^3/cm^3 and water at 1 g/cm^3.
C1 spans orders of magnitude and is collinear with C4, so the density gamma_ref at the mean
(log) cone index and mean water content of the calibration data is sampled in its place.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.models.base import Array, Conditions, Model, References, columns

__all__ = ["AYERS_PERUMPRAL", "AYERS_PERUMPRAL_VOLUMETRIC", "bulk_density"]

_LN_DENSITY_BRACKET = (float(np.log(0.1)), float(np.log(5.0)))
_MAX_ITERATIONS = 80


def bulk_density(
    cone_index_kpa: Array, water_g_g: Array, C1: Array | float, C2: Array | float,
    C3: Array | float, C4: Array | float,
) -> Array:  # fmt: skip
    """Evaluate Eq 1 in g/cm^3.

    Parameters
    ----------
    cone_index_kpa, water_g_g : ndarray
        Cone index (kPa) and gravimetric water content (g/g).
    C1, C2, C3, C4 : ndarray or float
        Soil coefficients.

    References
    ----------
    Ayers & Perumpral (1982), as Eq 1 of He, Sandu & Osorio (2019),
    doi:10.1016/j.jterra.2019.07.003.
    """
    return np.asarray((cone_index_kpa / C1 * (C2 + (water_g_g - C3) ** 2)) ** (1.0 / C4))


def _ln_water_term(water: Array | float, C2: Array, C3: Array) -> Array:
    return np.asarray(np.log(C2 + (water - C3) ** 2))


def _location(theta: Array, conditions: Conditions, references: References) -> Array:
    gamma_ref, C2, C3, C4 = columns(theta)
    ln_index = np.log(conditions["cone_index_kpa"] / references["ci_ref_kpa"])
    water = conditions["gravimetric_water_content"]
    drier = _ln_water_term(water, C2, C3) - _ln_water_term(references["water_ref"], C2, C3)
    return np.asarray(gamma_ref * np.exp((ln_index + drier) / C4))


def _report(theta: Array, references: References) -> dict[str, Array]:
    gamma_ref, C2, C3, C4 = theta.T
    ln_c1 = (
        np.log(references["ci_ref_kpa"])
        + _ln_water_term(references["water_ref"], C2, C3)
        - C4 * np.log(gamma_ref)
    )
    return {"C1": np.exp(ln_c1), "C2": C2, "C3": C3, "C4": C4}


def _from_reported(reported: Mapping[str, float], references: References) -> Array:
    C1, C2, C3, C4 = (reported[name] for name in ("C1", "C2", "C3", "C4"))
    gamma_ref = bulk_density(
        np.array(references["ci_ref_kpa"]), np.array(references["water_ref"]), C1, C2, C3, C4
    )
    return np.array([float(gamma_ref), C2, C3, C4])


def _references(conditions: Conditions) -> dict[str, float]:
    return {
        "ci_ref_kpa": float(np.exp(np.log(conditions["cone_index_kpa"]).mean())),
        "water_ref": float(conditions["gravimetric_water_content"].mean()),
    }


def _references_volumetric(conditions: Conditions) -> dict[str, float]:
    return {
        "ci_ref_kpa": float(np.exp(np.log(conditions["cone_index_kpa"]).mean())),
        "water_ref": float(conditions["volumetric_water_content"].mean()),
    }


def _location_volumetric(theta: Array, conditions: Conditions, references: References) -> Array:
    gamma_ref, A2, A3, A4 = columns(theta)
    ln_index = np.log(conditions["cone_index_kpa"] / references["ci_ref_kpa"])
    water = conditions["volumetric_water_content"]
    ln_ref = np.log(gamma_ref)
    target = A2 * ln_ref + ln_index - _ln_water_term(references["water_ref"] / gamma_ref, A3, A4)
    return np.exp(_solve_ln_density(target, water, A2, A3, A4))


def _solve_ln_density(target: Array, water: Array, A2: Array, A3: Array, A4: Array) -> Array:
    """Solve A2 x - ln(A3 + (water e^-x - A4)^2) = target for x = ln gamma, shape (k, n).

    Newton's method kept inside a shrinking bracket, all roots at once; NaN where the bracket
    of 0.1 to 5 g/cm^3 holds no sign change.
    """
    shape = np.broadcast_shapes(target.shape, water.shape)
    given = [np.broadcast_to(a, shape).ravel() for a in (target, water, A2, A3, A4)]
    root = np.full(given[0].size, np.nan)
    low, high = (np.full(root.size, end) for end in _LN_DENSITY_BRACKET)
    solvable = (_excess(low, *given)[0] < 0.0) & (_excess(high, *given)[0] > 0.0)
    # Only what has not converged is worked on; most roots need six steps, a few need forty.
    left = np.flatnonzero(solvable)
    low, high, *given = (a[left] for a in (low, high, *given))
    x = np.zeros(left.size)
    for _ in range(_MAX_ITERATIONS):
        value, slope = _excess(x, *given)
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        step = x - value / slope
        new = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        going = np.abs(new - x) > 1e-13
        root[left] = x = new
        if not going.any():
            break
        if np.count_nonzero(going) < 0.7 * going.size:
            left = left[going]
            x, low, high, *given = (a[going] for a in (x, low, high, *given))
    return root.reshape(shape)


def _excess(
    x: Array, target: Array, water: Array, A2: Array, A3: Array, A4: Array
) -> tuple[Array, Array]:
    """Left side of the equation less its right side, and its slope in x."""
    w = water * np.exp(-x)
    offset = w - A4
    denominator = A3 + offset**2
    return A2 * x - np.log(denominator) - target, A2 + 2.0 * offset * w / denominator


def _report_volumetric(theta: Array, references: References) -> dict[str, Array]:
    gamma_ref, A2, A3, A4 = theta.T
    ln_a1 = (
        np.log(references["ci_ref_kpa"])
        + _ln_water_term(references["water_ref"] / gamma_ref, A3, A4)
        - A2 * np.log(gamma_ref)
    )
    return {"A1": np.exp(ln_a1), "A2": A2, "A3": A3, "A4": A4}


def _from_reported_volumetric(reported: Mapping[str, float], references: References) -> Array:
    A1, A2, A3, A4 = (np.array([[reported[name]]]) for name in ("A1", "A2", "A3", "A4"))
    target = np.log(references["ci_ref_kpa"] / A1)
    ln_gamma = _solve_ln_density(target, np.array([references["water_ref"]]), A2, A3, A4)
    return np.array([float(np.exp(ln_gamma[0, 0])), *(float(a[0, 0]) for a in (A2, A3, A4))])


AYERS_PERUMPRAL = Model(
    name="ayers_perumpral",
    title="Bulk density from cone index and gravimetric water content",
    equation="gamma_d = {(CI/C1)[C2 + (theta_g - C3)^2]}^(1/C4)  (Eq 1)",
    output="bulk_density_g_cm3",
    conditions=("cone_index_kpa", "gravimetric_water_content"),
    parameters=("gamma_ref", "C2", "C3", "C4"),
    reported={"C1": "kPa (g/cm^3)^-C4", "C2": "1", "C3": "g/g", "C4": "1"},
    response="identity",
    location=_location,
    report_theta=_report,
    theta_from_reported=_from_reported,
    bind_references=_references,
)

AYERS_PERUMPRAL_VOLUMETRIC = Model(
    name="ayers_perumpral_volumetric",
    title="Bulk density from cone index and volumetric water content",
    equation="CI = A1 gamma_d^A2/(A3 + (theta_v/gamma_d - A4)^2), solved for gamma_d  (Eq 2)",
    output="bulk_density_g_cm3",
    conditions=("cone_index_kpa", "volumetric_water_content"),
    parameters=("gamma_ref", "A2", "A3", "A4"),
    reported={"A1": "kPa (g/cm^3)^-A2", "A2": "1", "A3": "1", "A4": "g/g"},
    response="identity",
    location=_location_volumetric,
    report_theta=_report_volumetric,
    theta_from_reported=_from_reported_volumetric,
    bind_references=_references_volumetric,
)
