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

from calib.models.base import Array, Columns, Conditions, Model, References, Rows

_LN_DENSITY_BRACKET = (float(np.log(0.1)), float(np.log(5.0)))
_MAX_ITERATIONS = 80


def bulk_density(
    cone_index_kpa: Array, water_g_g: Array, C1: Array | float, C2: Array | float,
    C3: Array | float, C4: Array | float,
) -> Array:  # fmt: skip
    """Evaluate Eq 1 in g/cm^3, from cone index (kPa), water content (g/g) and soil coefficients.

    Ayers & Perumpral (1982), as Eq 1 of He, Sandu & Osorio (2019),
    doi:10.1016/j.jterra.2019.07.003.
    """
    return np.asarray((cone_index_kpa / C1 * (C2 + (water_g_g - C3) ** 2)) ** (1.0 / C4))


def _ln_water_term(water: Array | float, C2: Array, C3: Array) -> Array:
    return np.asarray(np.log(C2 + (water - C3) ** 2))


def _water(conditions: Conditions) -> Array:
    name = "gravimetric_water_content"
    return conditions[name if name in conditions else "volumetric_water_content"]


def _prepare(conditions: Conditions, references: References) -> Rows:
    ln_index = np.log(conditions["cone_index_kpa"] / references["ci_ref_kpa"])
    return {"ln_index": ln_index, "water": _water(conditions)}


def _density(columns: Columns, rows: Rows, references: References) -> Array:
    gamma_ref, C2, C3, C4 = columns
    at_references = np.log(gamma_ref) - _ln_water_term(references["water_ref"], C2, C3) / C4
    ln_term = rows["ln_index"] + _ln_water_term(rows["water"], C2, C3)
    return np.exp(ln_term / C4 + at_references)


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
        "water_ref": float(_water(conditions).mean()),
    }


def _density_volumetric(columns: Columns, rows: Rows, references: References) -> Array:
    gamma_ref, A2, A3, A4 = columns
    ln_ref = np.log(gamma_ref)
    target = A2 * ln_ref - _ln_water_term(references["water_ref"] / gamma_ref, A3, A4)
    return np.exp(_solve_ln_density(rows["ln_index"] + target, rows["water"], A2, A3, A4))


def _solve_ln_density(target: Array, water: Array, A2: Array, A3: Array, A4: Array) -> Array:
    """Solve A2 x - ln(A3 + (water e^-x - A4)^2) = target for x = ln gamma; NaN without a root."""
    low = np.full(np.broadcast_shapes(target.shape, water.shape), _LN_DENSITY_BRACKET[0])
    high = np.full_like(low, _LN_DENSITY_BRACKET[1])

    def excess(x: Array) -> tuple[Array, Array]:
        w = water * np.exp(-x)
        offset = w - A4
        denominator = A3 + offset**2
        return A2 * x - np.log(denominator) - target, A2 + 2.0 * offset * w / denominator

    solvable = (excess(low)[0] < 0.0) & (excess(high)[0] > 0.0)
    x = np.zeros_like(low)
    for _ in range(_MAX_ITERATIONS):
        value, slope = excess(x)
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        step = x - value / slope
        # A converged step ends on the bracket's edge.
        new = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        moved = np.abs(new - x)
        x = new
        if not np.any(moved[solvable] > 1e-13):
            break
    return np.where(solvable, x, np.nan)


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
    output="bulk_density_g_cm3",
    conditions=("cone_index_kpa", "gravimetric_water_content"),
    parameters=("gamma_ref", "C2", "C3", "C4"),
    reported={"C1": "kPa (g/cm^3)^-C4", "C2": "1", "C3": "g/g", "C4": "1"},
    response="identity",
    mean_response=_density,
    report_theta=_report,
    theta_from_reported=_from_reported,
    bind_references=_references,
    prepare=_prepare,
    latex=(
        (
            r"$\gamma_\mathrm{d} = \{(\mathrm{CI}/C_1)[C_2 + (\theta_\mathrm{g} - "
            r"C_3)^2]\}^{1/C_4}$"
        ),
    ),
    numbers="Eq 1",
    cited="He_2019",
    source="He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003",
    letters=(
        "[$gamma_d] the dry bulk density (g/cm³), CI the cone index (kPa), [$theta_g] "
        "the gravimetric water content (g/g)"
    ),
    applies=(
        "One soil, at several states of compaction and water content. Data with a narrow range of "
        "water content hardly narrow C2 and C3: the report marks what the prior sets. At water "
        "contents or cone indices outside those of the data it is extrapolated."
    ),
    parametrisation=(
        "The density gamma_ref at a cone index of {ci_ref_kpa:.4g} kPa and a water "
        "content of {water_ref:.3g} (means of the data) is sampled in the place of "
        "C1, with which the other coefficients are almost collinear; C1 follows from "
        "it."
    ),
)

AYERS_PERUMPRAL_VOLUMETRIC = Model(
    name="ayers_perumpral_volumetric",
    title="Bulk density from cone index and volumetric water content",
    output="bulk_density_g_cm3",
    conditions=("cone_index_kpa", "volumetric_water_content"),
    parameters=("gamma_ref", "A2", "A3", "A4"),
    reported={"A1": "kPa (g/cm^3)^-A2", "A2": "1", "A3": "1", "A4": "g/g"},
    response="identity",
    mean_response=_density_volumetric,
    report_theta=_report_volumetric,
    theta_from_reported=_from_reported_volumetric,
    bind_references=_references,
    prepare=_prepare,
    latex=(
        (
            r"$\mathrm{CI} = A_1 \gamma_\mathrm{d}^{A_2} / [A_3 + "
            r"(\theta_\mathrm{v}/\gamma_\mathrm{d} - A_4)^2]$"
        ),
        r"solved for $\gamma_\mathrm{d}$",
    ),
    numbers="Eq 2",
    cited="He_2019",
    source="He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003",
    letters=(
        "[$gamma_d] the dry bulk density (g/cm³), CI the cone index (kPa), [$theta_v] "
        "the volumetric water content (cm³/cm³)"
    ),
    applies=(
        "As the gravimetric form, with water at 1 g/cm³. The equation is implicit in the density "
        "and is solved between 0.1 and 5 g/cm³; where it has no root there, there is no value. "
        "Data with a narrow range of water content hardly narrow A3 and A4."
    ),
    parametrisation=(
        "The density gamma_ref at a cone index of {ci_ref_kpa:.4g} kPa and a water "
        "content of {water_ref:.3g} (means of the data) is sampled in the place of "
        "A1, with which the other coefficients are almost collinear; A1 follows from "
        "it."
    ),
)
