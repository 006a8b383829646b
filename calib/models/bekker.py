"""Sinkage by ground pressure, slip and plate width: Bekker, Reece and Lyasko.

Rut depth from ground pressure and slip: Bekker and its slip-sinkage extension (Eqs 17-21).

    p = k z^n,  k = kc/b + kphi,  n = n0 + n1 s,   so   ln z = (ln p - ln k)/(n0 + n1 s)

with p in kPa, z in m, k in kPa/m^n and slip s as a fraction. ln k and n are almost collinear at
the centimetre sinkages of a tyre (d ln k/dn = -ln z, about 4), so the sinkage z_ref of a towed
wheel at the mean calibrated pressure is sampled in the place of k. The noise is on ln z: ground
pressure is set, rut depth is measured.

Sinkage under plates of several widths, and of a slipping wheel: Bekker, Reece, Lyasko.

    p = (kc/b + kphi) z^n                       Bekker (1956)
    p = (k1 + k2 b) (z/b)^n                     Reece (1965), k1 = c kc', k2 = gamma kphi'
    z = z0 (1 + s)/(1 - a s), p = k z0^n        Lyasko (2010)

with p in kPa, z and b in m. As for the plain Bekker model, the sinkage z_ref at the mean pressure
(and width) of the data is sampled in the place of the modulus, with which n is almost collinear,
and the part that width has in the modulus there in the place of its second constant. The noise is
on ln z.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from calib.models.base import Array, Columns, Conditions, Model, References, Rows

PRESSURE, WIDTH = "average_ground_pressure_kpa", "plate_width_mm"
LN_MM_PER_M = float(np.log(1000.0))


def rut_depth(
    pressure_kpa: Array, slip_ratio: Array | float, k: Array | float, n0: Array | float,
    n1: Array | float,
) -> Array:  # fmt: skip
    """Evaluate Eq 21, zt = (pgr/k)^(1/(n0 + n1 s)), in metres, as it broadcasts.

    Pressure in kPa, slip as a fraction, the modulus k in kPa/m^n. He, Sandu & Osorio (2019), Eqs
    17-21, doi:10.1016/j.jterra.2019.07.003.
    """
    return np.asarray((pressure_kpa / k) ** (1.0 / (n0 + n1 * slip_ratio)))


def prepare(conditions: Conditions, references: References) -> Rows:
    """Return ln of the relative pressure, and relative width and slip if there are any."""
    rows = {"ln_pressure": np.log(conditions[PRESSURE] / references["p_ref_kpa"])}
    if WIDTH in conditions:
        rows["wider"] = conditions[WIDTH] / references["b_ref_mm"]
    return rows | ({"slip": conditions["slip_ratio"]} if "slip_ratio" in conditions else {})


def _ln_rut_mm(ln_pressure: Array, exponent: Array, z_ref_mm: Array, n0: Array) -> Array:
    exponent = np.where(exponent > 0.0, exponent, np.nan)
    return (ln_pressure + n0 * (np.log(z_ref_mm) - LN_MM_PER_M)) / exponent + LN_MM_PER_M


def bind_references(conditions: Conditions) -> dict[str, float]:
    """Return the geometric means of the pressure, and of the width of plates if there is one."""
    names = {"p_ref_kpa": PRESSURE, "b_ref_mm": WIDTH}
    return {
        name: float(np.exp(np.log(conditions[column]).mean()))
        for name, column in names.items()
        if column in conditions
    }


def _location_bekker(columns: Columns, rows: Rows, references: References) -> Array:
    z_ref, n = columns
    return _ln_rut_mm(rows["ln_pressure"], n, z_ref, n)


def _location_modified(columns: Columns, rows: Rows, references: References) -> Array:
    z_ref, n0, n1 = columns
    return _ln_rut_mm(rows["ln_pressure"], n0 + n1 * rows["slip"], z_ref, n0)


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
    mean_response=_location_bekker,
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
)

MODIFIED_BEKKER = Model(
    name="modified_bekker",
    title="Bekker with slip sinkage",
    output="rut_depth_mm",
    conditions=(PRESSURE, "slip_ratio"),
    parameters=("z_ref", "n0", "n1"),
    reported={"n0": "1", "n1": "1", "k": "kPa/m^n"},
    response="log",
    mean_response=_location_modified,
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
)


def _bekker(columns: Columns, rows: Rows, references: References) -> Array:
    z_ref, n, share = columns
    stiffer = np.log(1.0 - share + share / rows["wider"])
    return np.asarray(np.log(z_ref) + (rows["ln_pressure"] - stiffer) / n)


def _reece(columns: Columns, rows: Rows, references: References) -> Array:
    z_ref, n, share = columns
    stiffer = np.log(1.0 - share + share * rows["wider"])
    return np.asarray(np.log(z_ref * rows["wider"]) + (rows["ln_pressure"] - stiffer) / n)


def _lyasko(columns: Columns, rows: Rows, references: References) -> Array:
    z_ref, n, a = columns
    slip = rows["slip"]
    deeper = np.log((1.0 + slip) / (1.0 - a * slip))
    return np.asarray(np.log(z_ref) + rows["ln_pressure"] / n + deeper)


def _report_plate(theta: Array, references: References) -> dict[str, Array]:
    z_ref, n, share = theta.T
    k = modulus(z_ref, n, references)
    return {"n": n, "kc": share * k * references["b_ref_mm"] / 1000.0, "kphi": (1.0 - share) * k}


def _theta_plate(reported: Mapping[str, float], references: References) -> Array:
    n, by_width = reported["n"], reported["kc"] / (references["b_ref_mm"] / 1000.0)
    k = by_width + reported["kphi"]
    return np.array([sinkage(k, n, references), n, by_width / k])


def _report_reece(theta: Array, references: References) -> dict[str, Array]:
    z_ref, n, share = theta.T
    k = modulus(z_ref, n, references, references["b_ref_mm"])
    return {"n": n, "k1": (1.0 - share) * k, "k2": share * k / references["b_ref_mm"] * 1000.0}


def _theta_reece(reported: Mapping[str, float], references: References) -> Array:
    width = references["b_ref_mm"]
    by_width = reported["k2"] * width / 1000.0
    k = reported["k1"] + by_width
    return np.array([sinkage(k, reported["n"], references, width), reported["n"], by_width / k])


def _report_lyasko(theta: Array, references: References) -> dict[str, Array]:
    z_ref, n, a = theta.T
    return {"n": n, "k": modulus(z_ref, n, references), "a": a}


def _theta_lyasko(reported: Mapping[str, float], references: References) -> Array:
    n = reported["n"]
    return np.array([sinkage(reported["k"], n, references), n, reported["a"]])


_plate = partial(
    Model,
    output="rut_depth_mm",
    conditions=(PRESSURE, WIDTH),
    parameters=("z_ref", "n", "share"),
    response="log",
    bind_references=bind_references,
    prepare=prepare,
    letters="[$p] the pressure (kPa), [$z] the sinkage and [$b] the width of the plate (m)",
    parametrisation=(
        "The sinkage z_ref at {p_ref_kpa:.4g} kPa and a width of {b_ref_mm:.4g} mm (means of the "
        "data) is sampled in the place of the modulus, which is almost collinear with n, and "
        "beside it the part of the modulus there that depends on the width; the published "
        "constants follow."
    ),
)

BEKKER_PLATE = _plate(
    name="bekker_plate",
    title="Bekker under plates of several widths",
    reported={"n": "1", "kc": "kPa/m^(n-1)", "kphi": "kPa/m^n"},
    mean_response=_bekker,
    report_theta=_report_plate,
    theta_from_reported=_theta_plate,
    latex=(r"$p = (k_\mathrm{c}/b + k_\phi) z^n$",),
    source="Bekker (1956), Theory of Land Locomotion; Wong (2008), Theory of Ground Vehicles",
    applies=(
        "Plates pressed into one homogeneous soil, at two widths or more: with one width "
        "k_c and k_phi cannot be told apart. The moduli depend on the exponent by their "
        "units, so they carry over to another soil only together with it."
    ),
)

REECE = _plate(
    name="reece",
    title="Reece pressure-sinkage",
    reported={"n": "1", "k1": "kPa", "k2": "kPa/m"},
    mean_response=_reece,
    report_theta=_report_reece,
    theta_from_reported=_theta_reece,
    latex=(r"$p = (k_1 + k_2 b)(z/b)^n$",),
    source="Reece (1965), Proc. Inst. Mech. Eng. 180(2A), 45-66; Wong & Reece (1967)",
    applies=(
        "Plates pressed into one homogeneous soil, at two widths or more; pressures grow "
        "with width where friction carries the plate and do not where cohesion does. Not "
        "for layered soil or a box whose walls are within a few plate widths."
    ),
)

LYASKO = Model(
    name="lyasko",
    title="Lyasko slip sinkage",
    output="rut_depth_mm",
    conditions=(PRESSURE, "slip_ratio"),
    parameters=("z_ref", "n", "a"),
    reported={"n": "1", "k": "kPa/m^n", "a": "1"},
    response="log",
    mean_response=_lyasko,
    report_theta=_report_lyasko,
    theta_from_reported=_theta_lyasko,
    bind_references=bind_references,
    prepare=prepare,
    latex=(r"$z = (p/k)^{1/n}(1 + s)/(1 - a s)$",),
    source="Lyasko (2010), J. Terramechanics 47(1), 21-31",
    applies=(
        "Driven wheels at slips of zero or more, well below where the denominator vanishes. "
        "The coefficient of slip sinkage could not be confirmed from a second source: its "
        "prior is wide, and says so."
    ),
    letters="[$z] the sinkage (m), [$p] the ground pressure (kPa), [$s] the slip (as a fraction)",
    parametrisation=(
        "The sinkage z_ref at {p_ref_kpa:.4g} kPa (mean of the data) is sampled in the "
        "place of the modulus, which is almost collinear with n; the published constants "
        "follow."
    ),
)
