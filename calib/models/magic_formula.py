"""Drawbar pull by the Magic Formula at one inflation pressure (He et al. 2019, Eqs 3-5).

With slip x in percent and drawbar pull Y in kN,

    Y = Sv + D sin{ C arctan[ B X - E (B X - arctan B X) ] },   X = x - Sh.

B trades against C and D in every fit, while the initial slope K = B C D is what the data see
near zero slip; so K is sampled and B reported. E <= 1 keeps the curve single-peaked, and its
effect is felt through the size of 1 - E; so G = 1 - E > 0 is sampled and E reported.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calib.models.base import Array, Columns, Conditions, Model, References, Rows, Searched


def magic_formula(
    slip_percent: Array,
    B: Array | float,
    C: Array | float,
    D: Array | float,
    E: Array | float,
    Sh: Array | float = 0.0,
    Sv: Array | float = 0.0,
) -> Array:
    """Evaluate the Magic Formula.

    Parameters
    ----------
    slip_percent : ndarray
        Slip in percent; broadcast against the parameters.
    B, C, D, E : ndarray or float
        Stiffness factor (1/%), shape factor, peak factor (kN), curvature factor.
    Sh, Sv : ndarray or float
        Horizontal (%) and vertical (kN) shift.

    Returns
    -------
    ndarray
        Drawbar pull in kN, of the broadcast shape.

    References
    ----------
    He, Sandu & Osorio (2019), Eqs 3-5, doi:10.1016/j.jterra.2019.07.003.
    """
    bx = B * (slip_percent - Sh)
    return np.asarray(Sv + D * np.sin(C * np.arctan(bx - E * (bx - np.arctan(bx)))))


def half_sine_in_place(bx: Array, work: Array, C: Array, G: Array) -> None:
    """Turn B X into sin(C arctan[B X - E (B X - arctan B X)])/2 where it stands.

    Parameters
    ----------
    bx : ndarray
        B X; overwritten.
    work : ndarray
        Of the same shape; overwritten.
    C, G : ndarray
        G = 1 - E; broadcast against `bx`.

    Notes
    -----
    BX - E(BX - arctan BX) = arctan BX + G(BX - arctan BX), and with t = tan(v/2)
    sin(v)/2 = t/(1 + t^2): NumPy has vector instructions for the tangent, not for the sine.
    """
    np.arctan(bx, out=work)
    bx -= work
    bx *= G
    bx += work
    np.arctan(bx, out=bx)
    bx *= 0.5 * C
    np.tan(bx, out=bx)
    np.multiply(bx, bx, out=work)
    work += 1.0
    bx /= work


def _prepare(conditions: Conditions, references: References) -> Rows:
    return {"slip_percent": 100.0 * conditions["slip_ratio"]}


def _location(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    K, C, D, G, Sh, Sv = columns
    bx: Array = work[0]
    np.subtract(rows["slip_percent"], Sh, out=bx)
    bx *= K / (C * D)
    half_sine_in_place(bx, work[1], C, G)
    bx *= 2.0 * D
    bx += Sv
    return bx


def _report(theta: Array, references: References) -> dict[str, Array]:
    K, C, D, G, Sh, Sv = theta.T
    return {"B": K / (C * D), "C": C, "D": D, "E": 1.0 - G, "Sh": Sh, "Sv": Sv}


def _from_reported(reported: Mapping[str, float], references: References) -> Array:
    B, C, D, E = (reported[name] for name in "BCDE")
    return np.array([B * C * D, C, D, 1.0 - E, reported.get("Sh", 0.0), reported.get("Sv", 0.0)])


def _box(largest: float) -> dict[str, tuple[float, float]]:
    return {"B": (0.001, 0.5), "C": (1.0, 2.0), "D": (0.0, 2.0 * largest), "E": (-30.0, 1.0)}


def _sampled(value: dict[str, Any]) -> dict[str, Any]:
    found = dict(value)
    if "B" in value:
        found["K"] = value["B"] * value["C"] * value["D"]
    if "E" in value:
        found["G"] = 1.0 - value["E"]
    return found


# As the source searches it (Table 3).
_SEARCHED = Searched({"K": "B", "G": "E"}, _box, _sampled)

MAGIC_FORMULA = Model(
    name="magic_formula",
    title="Magic Formula, one inflation pressure",
    output="drawbar_pull_kn",
    conditions=("slip_ratio",),
    parameters=("K", "C", "D", "G", "Sh", "Sv"),
    reported={"B": "1/%", "C": "1", "D": "kN", "E": "1", "Sh": "%", "Sv": "kN"},
    response="identity",
    location=_location,
    report_theta=_report,
    theta_from_reported=_from_reported,
    prepare=_prepare,
    latex=(
        r"$Y = S_\mathrm{v} + D \sin\{C \arctan[B X - E (B X - \arctan B X)]\}$",
        r"$X = x - S_\mathrm{h}$",
    ),
    numbers="Eqs 3-5",
    cited="He_2019",
    source="He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003",
    letters="[$Y] the drawbar pull (kN), [$x] the slip (%)",
    applies=(
        "One tyre, soil, load and inflation pressure: it knows slip alone, and takes whatever else "
        "varies between the rows for noise. E is at most 1, which keeps the curve single-peaked; a "
        "pull that falls more steeply past its peak is not captured."
    ),
    parametrisation=(
        "The initial slope K = BCD is sampled in the place of B, and G = 1 - E in "
        "that of E; B and E follow."
    ),
    example="""\
slip_ratio,normal_load_kn,drawbar_pull_kn
0.00,5.0,0.02
0.05,5.0,0.55
0.10,5.0,0.94
0.15,5.0,0.98
0.20,5.0,0.90
0.30,5.0,0.78
0.45,5.0,0.67
0.60,5.0,0.66
""",
    searched=_SEARCHED,
    estimates_all_rows=True,
)
