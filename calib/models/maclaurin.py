"""Rut depth from a mobility number: the form of Maclaurin (1990).

    z = k d N^-m,   N = I (b d)^(1 - q/2) delta^q / W

with z, b, d and the deflection delta in m, the cone index I in kPa and the load W in kN. N is
Maclaurin's mobility number for q = 0.4. Both are read in one public program after Saarilahti
(2002), with k = 0.224 and m = 1.25, and could not be confirmed from a second source: exponents and
factor are free. N is the wheel numeric I b d/W times f^q, with f = delta/sqrt(b d); at the means of
the data z is z_ref, which is sampled in the place of k. The noise is on ln z.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.models.base import Array, Columns, Conditions, Model, References, Rows
from calib.models.traction import wheel_numeric

_MM_PER_M = 1000.0


def _parts(conditions: Conditions) -> dict[str, Array]:
    """Return logarithms of what the rut depth is a product of powers of."""
    size = np.sqrt(conditions["tyre_width_m"] * conditions["tyre_diameter_m"])
    return {
        "numeric": np.log(wheel_numeric(conditions)),
        "flattened": np.log(conditions["tyre_deflection_mm"] / _MM_PER_M / size),
        "diameter": np.log(conditions["tyre_diameter_m"]),
    }


def _references(conditions: Conditions) -> dict[str, float]:
    return {f"{name}_ref": float(np.exp(v.mean())) for name, v in _parts(conditions).items()}


def _prepare(conditions: Conditions, references: References) -> Rows:
    return {n: v - np.log(references[f"{n}_ref"]) for n, v in _parts(conditions).items()}


def _ln_rut(columns: Columns, rows: Rows, references: References) -> Array:
    z_ref, m, q = columns
    return np.asarray(
        np.log(z_ref) + rows["diameter"] - m * (rows["numeric"] + q * rows["flattened"])
    )


def _scale(m: Array | float, q: Array | float, references: References) -> Array:
    """Return z_ref over k."""
    number = references["numeric_ref"] * references["flattened_ref"] ** np.asarray(q)
    return np.asarray(_MM_PER_M * references["diameter_ref"] * number ** -np.asarray(m))


def _report(theta: Array, references: References) -> dict[str, Array]:
    z_ref, m, q = theta.T
    return {"k": z_ref / _scale(m, q, references), "m": m, "q": q}


def _theta(reported: Mapping[str, float], references: References) -> Array:
    m, q = reported["m"], reported["q"]
    return np.array([reported["k"] * float(_scale(m, q, references)), m, q])


MACLAURIN_RUT = Model(
    name="maclaurin_rut",
    title="Maclaurin's form of rut depth",
    output="rut_depth_mm",
    conditions=(
        "cone_index_kpa", "normal_load_kn", "tyre_width_m", "tyre_diameter_m",
        "tyre_deflection_mm",
    ),
    parameters=("z_ref", "m", "q"),
    reported={"k": "1", "m": "1", "q": "1"},
    response="log",
    mean_response=_ln_rut,
    report_theta=_report,
    theta_from_reported=_theta,
    bind_references=_references,
    prepare=_prepare,
    latex=(
        r"$z = k d N_\mathrm{M}^{-m}$",
        r"$N_\mathrm{M} = I (b d)^{1 - q/2} \delta^q/W$",
    ),
    source="Maclaurin (1990; 1997), after Saarilahti (2002), Soil interaction model: the form",
    applies=(
        "First pass of pneumatic tyres on soft cohesive soils whose strength a cone penetrometer "
        "describes, at slips that dig no deeper. Its factor and exponents could not be confirmed "
        "from a second source and are free. Deflections that keep in step with the tyre's size "
        "leave the exponent q to its prior, one mobility number leaves m to it."
    ),
    letters=(
        "[$z] the rut depth (m), [$N_M] the mobility number, [$I] the cone index (kPa), [$W] the "
        "load (kN), [$b] and [$d] width and diameter of the tyre (m), [$delta] its deflection (m)"
    ),
    parametrisation=(
        "The rut depth z_ref at the means of the data (a wheel numeric of {numeric_ref:.4g}, a "
        "deflection of {flattened_ref:.4g} of the tyre's size, a diameter of {diameter_ref:.4g} m) "
        "is sampled in the place of the factor k, which is almost collinear with m; the published "
        "constants follow."
    ),
    example="""\
cone_index_kpa,normal_load_kn,tyre_width_m,tyre_diameter_m,tyre_deflection_mm,rut_depth_mm
250,10,0.3,1,25,76.36
250,16,0.3,1,60,105.4
450,10,0.3,1,25,40.61
450,16,0.3,1,60,44.55
800,10,0.3,1,25,19.18
800,16,0.3,1,60,19.32
250,16,0.42,1.4,35,106.4
250,25,0.42,1.4,75,94.64
450,16,0.42,1.4,35,44.24
450,25,0.42,1.4,75,67.88
800,16,0.42,1.4,35,15.79
800,25,0.42,1.4,75,21.61
250,22,0.47,1.75,45,98.73
250,34,0.47,1.75,90,133.1
450,22,0.47,1.75,45,42.04
450,34,0.47,1.75,90,61.18
800,22,0.47,1.75,45,25.07
800,34,0.47,1.75,90,31.29
""",
)  # fmt: skip
