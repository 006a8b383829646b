"""Sinkage under plates of several widths, and of a slipping wheel: Bekker, Reece, Lyasko.

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

from calib.models.base import Array, Columns, Model, References, Rows
from calib.models.bekker import PRESSURE, WIDTH, bind_references, modulus, prepare, sinkage


def _bekker(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    z_ref, n, share = columns
    stiffer = np.log(1.0 - share + share / rows["wider"])
    return np.asarray(np.log(z_ref) + (rows["ln_pressure"] - stiffer) / n)


def _reece(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    z_ref, n, share = columns
    stiffer = np.log(1.0 - share + share * rows["wider"])
    return np.asarray(np.log(z_ref * rows["wider"]) + (rows["ln_pressure"] - stiffer) / n)


def _lyasko(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    z_ref, n, a = columns
    slip = rows["slip"]
    deeper = np.log((1.0 + slip) / (1.0 - a * slip))
    return np.asarray(np.log(z_ref) + rows["ln_pressure"] / n + deeper)


def _report_bekker(theta: Array, references: References) -> dict[str, Array]:
    z_ref, n, share = theta.T
    k = modulus(z_ref, n, references)
    return {"n": n, "kc": share * k * references["b_ref_mm"] / 1000.0, "kphi": (1.0 - share) * k}


def _theta_bekker(reported: Mapping[str, float], references: References) -> Array:
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
    location=_bekker,
    report_theta=_report_bekker,
    theta_from_reported=_theta_bekker,
    latex=(r"$p = (k_\mathrm{c}/b + k_\phi) z^n$",),
    source="Bekker (1956), Theory of Land Locomotion; Wong (2008), Theory of Ground Vehicles",
    applies=(
        "Plates pressed into one homogeneous soil, at two widths or more: with one width "
        "k_c and k_phi cannot be told apart. The moduli depend on the exponent by their "
        "units, so they carry over to another soil only together with it."
    ),
    example="""\
average_ground_pressure_kpa,plate_width_mm,rut_depth_mm
5,60,3.221
10,60,6.143
20,60,9.827
40,60,24.9
5,80,2.768
10,80,6.618
20,80,11.08
40,80,19.91
5,100,3.113
10,100,5.839
20,100,11.93
40,100,21.54
""",
)

REECE = _plate(
    name="reece",
    title="Reece pressure-sinkage",
    reported={"n": "1", "k1": "kPa", "k2": "kPa/m"},
    location=_reece,
    report_theta=_report_reece,
    theta_from_reported=_theta_reece,
    latex=(r"$p = (k_1 + k_2 b)(z/b)^n$",),
    source="Reece (1965), Proc. Inst. Mech. Eng. 180(2A), 45-66; Wong & Reece (1967)",
    applies=(
        "Plates pressed into one homogeneous soil, at two widths or more; pressures grow "
        "with width where friction carries the plate and do not where cohesion does. Not "
        "for layered soil or a box whose walls are within a few plate widths."
    ),
    example="""\
average_ground_pressure_kpa,plate_width_mm,rut_depth_mm
5,60,3.955
10,60,7.716
20,60,16.79
40,60,29.09
5,80,4.155
10,80,8.894
20,80,15.89
40,80,31.75
5,100,4.548
10,100,9.902
20,100,18.59
40,100,38.85
""",
)

LYASKO = Model(
    name="lyasko",
    title="Lyasko slip sinkage",
    output="rut_depth_mm",
    conditions=(PRESSURE, "slip_ratio"),
    parameters=("z_ref", "n", "a"),
    reported={"n": "1", "k": "kPa/m^n", "a": "1"},
    response="log",
    location=_lyasko,
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
    example="""\
average_ground_pressure_kpa,slip_ratio,rut_depth_mm
90,0,22.88
90,0.15,21.82
90,0.3,31.07
140,0,30.91
140,0.15,43.92
140,0.3,42.86
190,0,45.35
190,0.15,58.93
190,0.3,63.3
""",
)
