"""Rut depth from ground pressure and slip: Bekker and its slip-sinkage extension (Eqs 17-21).

    p = k z^n,  k = kc/b + kphi,  n = n0 + n1 s,   so   ln z = (ln p - ln k)/(n0 + n1 s)

with p in kPa, z in m, k in kPa/m^n and slip s as a fraction. ln k and n are almost collinear at
the centimetre sinkages of a tyre (d ln k/dn = -ln z, about 4), so the sinkage z_ref of a towed
wheel at the mean calibrated pressure is sampled in the place of k. The noise is on ln z: ground
pressure is set, rut depth is measured.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.models.base import Array, Columns, Conditions, Model, References, Rows

PRESSURE, WIDTH = "average_ground_pressure_kpa", "plate_width_mm"
LN_MM_PER_M = float(np.log(1000.0))


def rut_depth(
    pressure_kpa: Array, slip_ratio: Array | float, k: Array | float, n0: Array | float,
    n1: Array | float,
) -> Array:  # fmt: skip
    """Evaluate Eq 21, zt = (pgr/k)^(1/(n0 + n1 s)), in metres.

    Parameters
    ----------
    pressure_kpa, slip_ratio : ndarray
        Average ground pressure (kPa) and slip (fraction).
    k : ndarray or float
        Sinkage modulus, kPa/m^n.
    n0, n1 : ndarray or float
        Sinkage exponent and its growth with slip.

    References
    ----------
    He, Sandu & Osorio (2019), Eqs 17-21, doi:10.1016/j.jterra.2019.07.003.
    """
    return np.asarray((pressure_kpa / k) ** (1.0 / (n0 + n1 * slip_ratio)))


def prepare(conditions: Conditions, references: References) -> Rows:
    """Return what sinkages need: ln of the relative pressure, and width and slip if there are."""
    rows = {"ln_pressure": np.log(conditions[PRESSURE] / references["p_ref_kpa"])}
    if WIDTH in conditions:
        rows["wider"] = conditions[WIDTH] / references["b_ref_mm"]
    return rows | ({"slip": conditions["slip_ratio"]} if "slip_ratio" in conditions else {})


def _ln_rut_mm(
    ln_pressure: Array, exponent: Array, z_ref_mm: Array, n0: Array, work: Array
) -> Array:
    ln_z: Array = work[0]
    np.add(ln_pressure, n0 * (np.log(z_ref_mm) - LN_MM_PER_M), out=ln_z)
    ln_z /= exponent
    ln_z += LN_MM_PER_M
    if not exponent.min() > 0.0:
        np.copyto(ln_z, np.nan, where=~(exponent > 0.0))
    return ln_z


def bind_references(conditions: Conditions) -> dict[str, float]:
    """Return the geometric means of the pressure, and of the width of plates if there is one."""
    names = {"p_ref_kpa": PRESSURE, "b_ref_mm": WIDTH}
    return {
        name: float(np.exp(np.log(conditions[column]).mean()))
        for name, column in names.items()
        if column in conditions
    }


def _location_bekker(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    z_ref, n = columns
    return _ln_rut_mm(rows["ln_pressure"], n, z_ref, n, work)


def _location_modified(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    z_ref, n0, n1 = columns
    exponent = np.multiply(n1, rows["slip"], out=work[1])
    exponent += n0
    return _ln_rut_mm(rows["ln_pressure"], exponent, z_ref, n0, work)


def modulus(z_ref: Array, n: Array, references: References, width_mm: float = 1000.0) -> Array:
    """Return k (kPa) of p = k (z/b)^n by its sinkage z_ref (mm) at the mean pressure."""
    return np.asarray(references["p_ref_kpa"] * (z_ref / width_mm) ** -n)


def sinkage(k: float, n: float, references: References, width_mm: float = 1000.0) -> float:
    """Return the sinkage (mm) at the mean pressure by k (kPa), the inverse of `modulus`."""
    return float(width_mm * (references["p_ref_kpa"] / k) ** (1.0 / n))


def _report_bekker(theta: Array, references: References) -> dict[str, Array]:
    z_ref, n = theta.T
    return {"n": n, "k": modulus(z_ref, n, references)}


def _report_modified(theta: Array, references: References) -> dict[str, Array]:
    z_ref, n0, n1 = theta.T
    return {"n0": n0, "n1": n1, "k": modulus(z_ref, n0, references)}


def _theta_bekker(reported: Mapping[str, float], references: References) -> Array:
    return np.array([sinkage(reported["k"], reported["n"], references), reported["n"]])


def _theta_modified(reported: Mapping[str, float], references: References) -> Array:
    n0 = reported["n0"]
    return np.array([sinkage(reported["k"], n0, references), n0, reported["n1"]])


BEKKER = Model(
    name="bekker",
    title="Bekker pressure-sinkage",
    output="rut_depth_mm",
    conditions=(PRESSURE,),
    parameters=("z_ref", "n"),
    reported={"n": "1", "k": "kPa/m^n"},
    response="log",
    location=_location_bekker,
    report_theta=_report_bekker,
    theta_from_reported=_theta_bekker,
    bind_references=bind_references,
    prepare=prepare,
    latex=(
        r"$z_0 = (p_\mathrm{gr}/k)^{1/n}$",
        r"$k = k_\mathrm{c}/b + k_\phi$",
    ),
    numbers="Eqs 17, 19, 20",
    cited="He_2019",
    source="He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003",
    letters="[$z_0] the rut depth (m), [$p_gr] the ground pressure (kPa)",
    applies=(
        "A towed wheel, or one of little slip, on one soil: it knows nothing of slip sinkage. k "
        "has a unit that depends on n, so its values are to be compared at equal n only. The "
        "logarithm of the rut depth is compared, so a rut must be deeper than zero."
    ),
    parametrisation=(
        "The rut z_ref of a towed wheel at {p_ref_kpa:.4g} kPa (mean of the data) is "
        "sampled in the place of k, which is almost collinear with n; k follows from "
        "it."
    ),
    example="""\
average_ground_pressure_kpa,rut_depth_mm
60,13.6
85,15.9
107,18.2
141,19.8
178,23.0
220,24.9
""",
)

MODIFIED_BEKKER = Model(
    name="modified_bekker",
    title="Bekker with slip sinkage",
    output="rut_depth_mm",
    conditions=(PRESSURE, "slip_ratio"),
    parameters=("z_ref", "n0", "n1"),
    reported={"n0": "1", "n1": "1", "k": "kPa/m^n"},
    response="log",
    location=_location_modified,
    report_theta=_report_modified,
    theta_from_reported=_theta_modified,
    bind_references=bind_references,
    prepare=prepare,
    latex=(
        r"$z_\mathrm{t} = (p_\mathrm{gr}/k)^{1/(n_0 + n_1 s)}$",
        r"$k = k_\mathrm{c}/b + k_\phi$",
    ),
    numbers="Eqs 18, 20, 21",
    cited="He_2019",
    source="He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003",
    letters=(
        "[$z_t] the rut depth (m), [$p_gr] the ground pressure (kPa), [$s] the slip (as a fraction)"
    ),
    applies=(
        "A driven wheel on one soil, while the rut equals the sinkage: He et al. (2019) fit slips "
        "up to 20 %, for above 30 % the rut rebounds. There is no value where n0 + n1 s is not "
        "positive. The logarithm of the rut depth is compared, so a rut must be deeper than zero."
    ),
    parametrisation=(
        "The rut z_ref of a towed wheel at {p_ref_kpa:.4g} kPa (mean of the data) is "
        "sampled in the place of k, which is almost collinear with n0; k follows from "
        "it."
    ),
    example="""\
slip_ratio,average_ground_pressure_kpa,rut_depth_mm
0.00,107,17.7
0.10,107,23.2
0.20,107,30.3
0.00,141,20.3
0.10,141,25.6
0.20,141,33.0
0.00,178,22.2
0.10,178,28.5
0.20,178,36.5
""",
)
