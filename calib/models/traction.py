"""Empirical models of traction, shear stress and rut depth.

Net traction from a mobility number and slip: Wismer & Luth (1973), Brixius (1987).

With W the load, CI the cone index, b and d width and diameter of the tyre, delta its deflection
and h the height of its section,

    Cn = CI b d / W                                      Bn = Cn (1 + 5 delta/h)/(1 + 3 b/d)
    P/W = c1 [1 - exp(-c2 Cn s)] - c3/Cn - c4            (Wismer & Luth)
    P/W = c1 [1 - exp(-c2 Bn)] [1 - exp(-c3 s)] - c4/Bn - c5 s/sqrt(Bn)    (Brixius, bias ply)

The published coefficients are the medians of the priors. In Brixius' net traction the two terms
0.04, of the gross traction and of the motion resistance, cancel; printed forms that omit the first
of them differ. The exponent of radial tyres is 9.5 or 10.5, by source: it lies within its prior.

Net traction over load, an exponential of slip: the form of Upadhyaya & Wulfsohn (1993).

    P/W = a [1 - b exp(-c s)]

Of the 1993 paper its summary and list of symbols could be seen, not the printed equation: three
parameters a', b', c' of the net traction and two, a and c, of the torque. The form is that of
three, its coefficients are free, and none published is used. What is sampled are the net traction
coefficient p20 at 20 % slip, at which traction is usually compared, and the motion resistance
coefficient r at no slip:

    P/W = -r + (p20 + r) [1 - exp(-c s)]/[1 - exp(-0.2 c)]

Net traction of a tyre whose contact with the ground is an ellipse.

    P = (A c + W tan phi) G(s l/K) - rho W,   A = pi l w/4,   p = W/A

The load presses evenly on an ellipse of the length l and the width w. A part of the tread that has
come a distance x into the contact has sheared the soil by j = s x, and Janosi and Hanamoto's stress
(c + p tan phi)[1 - exp(-j/K)], averaged over the ellipse, is its strength times

    G(q) = 1 - (4/pi) int_0^(pi/2) exp(-q sin t) cos^2 t dt = 1 - (2/q)[I1(q) - L1(q)]

with the modified Bessel and Struve functions of order one. G(q) is 4q/(3 pi) for small q and
1 - 4/(pi q) for large. That is the form of the models with an elliptic contact of Upadhyaya &
Wulfsohn (1993) and of Rosca, Carlescu and others (2006-2022), of whose papers summaries and
symbols could be seen, not how they find the contact from the deflection and the sinkage: its
length and width are measured here, and the motion resistance coefficient rho is free.

Shear stress from normal stress and displacement: Janosi & Hanamoto (1961).

tau = (c + sigma tan phi)[1 - exp(-j/K)], with tau, c and sigma in kPa, phi in degrees, j and K in
mm. For soils without a peak of the shear stress.

Rut depth from a mobility number: the form of Maclaurin (1990).

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


def wheel_numeric(conditions: Conditions) -> Array:
    """Return Cn = CI b d / W, dimensionless, of the shape of the conditions."""
    area = conditions["tyre_width_m"] * conditions["tyre_diameter_m"]
    return np.asarray(conditions["cone_index_kpa"] * area / conditions["normal_load_kn"])


def mobility_number(conditions: Conditions) -> Array:
    """Return Brixius' Bn, dimensionless, of the shape of the conditions."""
    flattened = 1.0 + 5.0 * conditions["tyre_deflection_mm"] / conditions["section_height_mm"]
    slender = 1.0 + 3.0 * conditions["tyre_width_m"] / conditions["tyre_diameter_m"]
    return np.asarray(wheel_numeric(conditions) * flattened / slender)


def _wismer_luth(theta: Array, conditions: Conditions) -> Array:
    c1, c2, c3, c4 = (theta[:, j, None] for j in range(4))
    numeric = wheel_numeric(conditions)
    gross = c1 * -np.expm1(-c2 * numeric * conditions["slip_ratio"])
    return np.asarray(conditions["normal_load_kn"] * (gross - c3 / numeric - c4))


def _brixius(theta: Array, conditions: Conditions) -> Array:
    c1, c2, c3, c4, c5 = (theta[:, j, None] for j in range(5))
    number, slip = mobility_number(conditions), conditions["slip_ratio"]
    gross = c1 * np.expm1(-c2 * number) * np.expm1(-c3 * slip)
    resistance = c4 / number + c5 * slip / np.sqrt(number)
    return np.asarray(conditions["normal_load_kn"] * (gross - resistance))


WISMER_LUTH = Model(
    name="wismer_luth",
    title="Wismer-Luth net traction",
    output="drawbar_pull_kn",
    conditions=(
        "slip_ratio", "cone_index_kpa", "normal_load_kn", "tyre_width_m", "tyre_diameter_m",
    ),
    parameters=("c1", "c2", "c3", "c4"),
    predict=_wismer_luth,
    latex=(
        r"$P/W = c_1[1 - \exp(-c_2 C_\mathrm{n} s)] - c_3/C_\mathrm{n} - c_4$",
        r"$C_\mathrm{n} = I b d/W$",
    ),
    source="Wismer & Luth (1973), J. Terramechanics 10(2), 49-61",
    applies=(
        "One pneumatic tyre or several on cohesive-frictional agricultural soils whose "
        "strength a cone penetrometer describes; not sand, and not soil so firm that the "
        "tyre stays rigid on it. Pull, load and cone index of a row belong together. With "
        "one mobility number in the data the rate and the coefficients of motion resistance "
        "are hardly told apart."
    ),
    letters=(
        "[$P] the pull (kN), [$W] the load (kN), [$s] the slip, [$C_n] the wheel numeric, [$I] the "
        "cone index (kPa), [$b] and [$d] width and diameter of the tyre (m)"
    ),
)  # fmt: skip

BRIXIUS = Model(
    name="brixius",
    title="Brixius net traction",
    output="drawbar_pull_kn",
    conditions=(
        "slip_ratio", "cone_index_kpa", "normal_load_kn", "tyre_width_m", "tyre_diameter_m",
        "tyre_deflection_mm", "section_height_mm",
    ),
    parameters=("c1", "c2", "c3", "c4", "c5"),
    predict=_brixius,
    latex=(
        (
            r"$P/W = c_1[1 - \exp(-c_2 B_\mathrm{n})][1 - \exp(-c_3 s)] - c_4/B_\mathrm{n} "
            r"- c_5 s/\sqrt{B_\mathrm{n}}$"
        ),
        r"$B_\mathrm{n} = (I b d/W)(1 + 5 \delta/h)/(1 + 3 b/d)$",
    ),
    source="Brixius (1987), ASAE paper 87-1622; ASABE D497",
    applies=(
        "Bias-ply tyres on cohesive-frictional soils, for which its coefficients were "
        "published: radial tyres have a larger slip coefficient and less motion resistance, "
        "within the priors. Mobility numbers of the published data are about 10 to 80. With "
        "one mobility number in the data the coefficients of thrust are hardly told apart."
    ),
    letters=(
        "[$P] the pull (kN), [$W] the load (kN), [$s] the slip, [$B_n] the mobility number, [$I] "
        "the cone index (kPa), [$b], [$d] and [$h] width, diameter (m) and section height of the "
        "tyre, [$delta] its deflection"
    ),
)  # fmt: skip


_SLIP = 0.2


def _range(p20: Array, r: Array, c: Array) -> Array:
    """Return a b, from the net traction coefficient at no slip to that at any."""
    return np.asarray((p20 + r) / -np.expm1(-_SLIP * c))


def _predict(theta: Array, conditions: Conditions) -> Array:
    p20, r, c = (theta[:, j, None] for j in range(3))
    risen = -np.expm1(-c * conditions["slip_ratio"])
    return np.asarray(conditions["normal_load_kn"] * (_range(p20, r, c) * risen - r))


def _report(theta: Array, references: References) -> dict[str, Array]:
    p20, r, c = theta.T
    span = _range(p20, r, c)
    return {"a": span - r, "b": span / (span - r), "c": c}


def _theta(reported: Mapping[str, float], references: References) -> Array:
    a, b, c = (reported[name] for name in "abc")
    return np.array([a * (1.0 - b * np.exp(-_SLIP * c)), a * (b - 1.0), c])


UPADHYAYA = Model(
    name="upadhyaya",
    title="Upadhyaya's form of net traction",
    output="drawbar_pull_kn",
    conditions=("slip_ratio", "normal_load_kn"),
    parameters=("p20", "r", "c"),
    reported={"a": "1", "b": "1", "c": "1"},
    predict=_predict,
    report_theta=_report,
    theta_from_reported=_theta,
    latex=(r"$P/W = a[1 - b \exp(-c s)]$",),
    source="Upadhyaya & Wulfsohn (1993), J. Terramechanics 30(2), 85-100: the form, not its values",
    applies=(
        "One tyre on one soil at loads that change the pull in proportion: the coefficients are "
        "of this tyre, soil and inflation pressure. Pull rises with slip to its limit and does "
        "not fall again. Slips that stay low tell how steeply it rises, and not its limit; none "
        "below 5 % leaves the motion resistance to its prior."
    ),
    letters="[$P] the pull (kN), [$W] the load (kN), [$s] the slip (as a fraction)",
    parametrisation=(
        "The net traction over load p20 at 20 % slip and the motion resistance over load r at no "
        "slip are sampled: the limit a and the rate c are almost collinear where slips are low, "
        "and so are a and b. The published coefficients follow."
    ),
)


_MM_PER_M = 1000.0
# Where 20 nodes and the series are off by 2e-13 at most.
_FAR = 34.0


def _rule(size: int) -> tuple[Array, Array]:
    t, weight = np.polynomial.legendre.leggauss(size)
    t = 0.25 * np.pi * (t + 1.0)
    return np.sin(t), np.asarray(weight * np.cos(t) ** 2)


_NODES, _WEIGHTS = _rule(20)


def mobilised(q: Array) -> Array:
    """Return G(q), the part of the strength that is mobilised on average over the ellipse.

    q is slip times length of the contact over the shear deformation modulus; G is odd in it.
    """
    size = np.abs(q)
    near = np.minimum(size, _FAR)
    rest = np.zeros_like(near)
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        rest += weight * np.exp(-node * near)
    # Of the integral, with the root of 1 - u^2 in powers of u = sin t.
    x = np.maximum(size, _FAR) ** -2.0
    series = 1.0 - x * (1.0 + x * (3.0 + x * (45.0 + x * (1575.0 + x * 99225.0))))
    far = 4.0 / np.pi * np.sqrt(x) * series
    return np.asarray(np.sign(q) * (1.0 - np.where(size > _FAR, far, rest)))


def _area(conditions: Conditions) -> Array:
    """Return the area of the contact, m2."""
    length, width = conditions["contact_length_mm"], conditions["contact_width_mm"]
    return np.asarray(0.25 * np.pi * length * width / _MM_PER_M**2)


def _references(conditions: Conditions) -> dict[str, float]:
    pressure = conditions["normal_load_kn"] / _area(conditions)
    return {"contact_pressure_ref_kpa": float(np.exp(np.log(pressure).mean()))}


def _prepare(conditions: Conditions, references: References) -> Rows:
    load = conditions["normal_load_kn"]
    return {
        "load": load,
        "held": references["contact_pressure_ref_kpa"] * _area(conditions),
        "slid": conditions["slip_ratio"] * conditions["contact_length_mm"],
    }


def _pull(columns: Columns, rows: Rows, references: References) -> Array:
    mu, share, K, rho = columns
    strength = mu * ((1.0 - share) * rows["load"] + share * rows["held"])
    return np.asarray(strength * mobilised(rows["slid"] / K) - rho * rows["load"])


def _report_elliptic(theta: Array, references: References) -> dict[str, Array]:
    mu, share, K, rho = theta.T
    cohesion = mu * share * references["contact_pressure_ref_kpa"]
    return {"c": cohesion, "phi": np.degrees(np.arctan(mu * (1.0 - share))), "K": K, "rho": rho}


def _theta_elliptic(reported: Mapping[str, float], references: References) -> Array:
    cohesion = reported["c"] / references["contact_pressure_ref_kpa"]
    mu = cohesion + float(np.tan(np.radians(reported["phi"])))
    return np.array([mu, cohesion / mu, reported["K"], reported["rho"]])


ELLIPTIC_CONTACT = Model(
    name="elliptic_contact",
    title="Net traction of an elliptic contact",
    output="drawbar_pull_kn",
    conditions=("slip_ratio", "normal_load_kn", "contact_length_mm", "contact_width_mm"),
    parameters=("mu", "share", "K", "rho"),
    reported={"c": "kPa", "phi": "degree", "K": "mm", "rho": "1"},
    mean_response=_pull,
    report_theta=_report_elliptic,
    theta_from_reported=_theta_elliptic,
    bind_references=_references,
    prepare=_prepare,
    latex=(
        r"$P = (A c + W \tan\phi) G(s l/K) - \rho W$",
        r"$A = \pi l w/4$",
        r"$G(q) = 1 - \frac{4}{\pi} \int_0^{\pi/2} \exp(-q \sin t) \cos^2 t dt$",
    ),
    source=(
        "Janosi & Hanamoto (1961) over the elliptic contact of Upadhyaya & Wulfsohn (1993), "
        "J. Terramechanics 30(2), 85-100, and Rosca et al. (2020), HAICTA: the form"
    ),
    applies=(
        "Tyres that flatten so much that they press about evenly on plastic soil: not rigid "
        "wheels, and not firm soil with a peak of the shear stress. Length and width of the "
        "contact are measured, as prints on hard ground or in the rut. At one mean pressure "
        "cohesion and friction cannot be told apart; where no slip is low, neither can strength "
        "and motion resistance."
    ),
    letters=(
        "[$P] the pull (kN), [$W] the load (kN), [$s] the slip, [$A] the area of the contact (m2), "
        "[$l] and [$w] its length and width (m), [$K] the shear deformation modulus (m)"
    ),
    parametrisation=(
        "The strength over load mu at a mean pressure of {contact_pressure_ref_kpa:.4g} kPa (mean "
        "of the data) is sampled, and the part of it that is due to cohesion: c and phi are almost "
        "collinear where pressures differ little. The published constants follow."
    ),
)


def _predict_janosi(theta: Array, conditions: Conditions) -> Array:
    c, phi, K = (theta[:, j, None] for j in range(3))
    strength = c + conditions["normal_stress_kpa"] * np.tan(np.radians(phi))
    return np.asarray(-strength * np.expm1(-conditions["shear_displacement_mm"] / K))


JANOSI_HANAMOTO = Model(
    name="janosi_hanamoto",
    title="Janosi-Hanamoto shear",
    output="shear_stress_kpa",
    conditions=("normal_stress_kpa", "shear_displacement_mm"),
    parameters=("c", "phi", "K"),
    reported={"c": "kPa", "phi": "degree", "K": "mm"},
    predict=_predict_janosi,
    latex=(r"$\tau = (c + \sigma_\mathrm{n} \tan \phi)[1 - \exp(-j/K)]$",),
    source="Janosi & Hanamoto (1961), 1st Int. Conf. Mechanics of Soil-Vehicle Systems, Turin",
    applies=(
        "Plastic soils whose shear stress rises to its strength and stays there: loose "
        "sand, saturated clay, most disturbed soils. Soils with a peak (firm, cemented or "
        "rooted) lose strength past it. At one normal stress cohesion and friction cannot "
        "be told apart."
    ),
    letters=(
        "[$tau] the shear stress, [$sigma_n] the normal stress (kPa), [$j] the displacement (mm)"
    ),
)


def _parts_rut(conditions: Conditions) -> dict[str, Array]:
    """Return logarithms of what the rut depth is a product of powers of."""
    size = np.sqrt(conditions["tyre_width_m"] * conditions["tyre_diameter_m"])
    return {
        "numeric": np.log(wheel_numeric(conditions)),
        "flattened": np.log(conditions["tyre_deflection_mm"] / _MM_PER_M / size),
        "diameter": np.log(conditions["tyre_diameter_m"]),
    }


def _references_rut(conditions: Conditions) -> dict[str, float]:
    return {f"{name}_ref": float(np.exp(v.mean())) for name, v in _parts_rut(conditions).items()}


def _prepare_rut(conditions: Conditions, references: References) -> Rows:
    return {n: v - np.log(references[f"{n}_ref"]) for n, v in _parts_rut(conditions).items()}


def _ln_rut(columns: Columns, rows: Rows, references: References) -> Array:
    z_ref, m, q = columns
    return np.asarray(
        np.log(z_ref) + rows["diameter"] - m * (rows["numeric"] + q * rows["flattened"])
    )


def _scale_rut(m: Array | float, q: Array | float, references: References) -> Array:
    """Return z_ref over k."""
    number = references["numeric_ref"] * references["flattened_ref"] ** np.asarray(q)
    return np.asarray(_MM_PER_M * references["diameter_ref"] * number ** -np.asarray(m))


def _report_rut(theta: Array, references: References) -> dict[str, Array]:
    z_ref, m, q = theta.T
    return {"k": z_ref / _scale_rut(m, q, references), "m": m, "q": q}


def _theta_rut(reported: Mapping[str, float], references: References) -> Array:
    m, q = reported["m"], reported["q"]
    return np.array([reported["k"] * float(_scale_rut(m, q, references)), m, q])


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
    report_theta=_report_rut,
    theta_from_reported=_theta_rut,
    bind_references=_references_rut,
    prepare=_prepare_rut,
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
)  # fmt: skip
