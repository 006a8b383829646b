"""Net traction from a mobility number and slip: Wismer & Luth (1973), Brixius (1987).

With W the load, CI the cone index, b and d width and diameter of the tyre, delta its deflection
and h the height of its section,

    Cn = CI b d / W                                      Bn = Cn (1 + 5 delta/h)/(1 + 3 b/d)
    P/W = c1 [1 - exp(-c2 Cn s)] - c3/Cn - c4            (Wismer & Luth)
    P/W = c1 [1 - exp(-c2 Bn)] [1 - exp(-c3 s)] - c4/Bn - c5 s/sqrt(Bn)    (Brixius, bias ply)

The published coefficients are the medians of the priors. In Brixius' net traction the two terms
0.04, of the gross traction and of the motion resistance, cancel; printed forms that omit the first
of them differ. The exponent of radial tyres is 9.5 or 10.5, by source: it lies within its prior.
"""

from __future__ import annotations

import numpy as np

from calib.models.base import Array, Conditions, Model


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
    example="""\
slip_ratio,cone_index_kpa,normal_load_kn,tyre_width_m,tyre_diameter_m,drawbar_pull_kn
0.03,600,6,0.3,1,0.7685
0.08,600,6,0.3,1,1.6
0.15,600,6,0.3,1,2.891
0.25,600,6,0.3,1,3.495
0.4,600,6,0.3,1,3.856
0.03,600,10,0.3,1,0.02268
0.08,600,10,0.3,1,1.261
0.15,600,10,0.3,1,3.062
0.25,600,10,0.3,1,4.359
0.4,600,10,0.3,1,6.067
0.03,1100,10,0.42,1.4,2.758
0.08,1100,10,0.42,1.4,5.273
0.15,1100,10,0.42,1.4,6.464
0.25,1100,10,0.42,1.4,6.756
0.4,1100,10,0.42,1.4,6.753
""",
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
    example="""\
slip_ratio,cone_index_kpa,normal_load_kn,tyre_width_m,tyre_diameter_m,tyre_deflection_mm,section_height_mm,drawbar_pull_kn
0.03,600,6,0.3,1,30,200,0.7273
0.08,600,6,0.3,1,30,200,2.013
0.15,600,6,0.3,1,30,200,3.017
0.25,600,6,0.3,1,30,200,3.915
0.4,600,6,0.3,1,30,200,4.237
0.03,600,10,0.3,1,45,200,1.01
0.08,600,10,0.3,1,45,200,3.086
0.15,600,10,0.3,1,45,200,4.567
0.25,600,10,0.3,1,45,200,5.604
0.4,600,10,0.3,1,45,200,6.275
0.03,1100,10,0.42,1.4,50,260,1.684
0.08,1100,10,0.42,1.4,50,260,4.057
0.15,1100,10,0.42,1.4,50,260,5.654
0.25,1100,10,0.42,1.4,50,260,7.102
0.4,1100,10,0.42,1.4,50,260,8.107
""",
)  # fmt: skip
