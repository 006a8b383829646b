"""Drawbar pull by the Magic Formula at one inflation pressure (He et al. 2019, Eqs 3-5).

With slip x in percent and drawbar pull Y in kN,

    Y = Sv + D sin{ C arctan[ B X - E (B X - arctan B X) ] },   X = x - Sh.

B trades against C and D in every fit, while the initial slope K = B C D is what the data see
near zero slip; so K is sampled and B reported. E <= 1 keeps the curve single-peaked, and its
effect is felt through the size of 1 - E; so G = 1 - E > 0 is sampled and E reported.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.models.base import Array, Conditions, Model, References, columns

__all__ = ["MAGIC_FORMULA", "magic_formula"]


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


def _location(theta: Array, conditions: Conditions, references: References) -> Array:
    K, C, D, G, Sh, Sv = columns(theta)
    slip_percent = 100.0 * conditions["slip_ratio"]
    return magic_formula(slip_percent, K / (C * D), C, D, 1.0 - G, Sh, Sv)


def _report(theta: Array, references: References) -> dict[str, Array]:
    K, C, D, G, Sh, Sv = theta.T
    return {"B": K / (C * D), "C": C, "D": D, "E": 1.0 - G, "Sh": Sh, "Sv": Sv}


def _from_reported(reported: Mapping[str, float], references: References) -> Array:
    B, C, D, E = (reported[name] for name in "BCDE")
    return np.array([B * C * D, C, D, 1.0 - E, reported.get("Sh", 0.0), reported.get("Sv", 0.0)])


MAGIC_FORMULA = Model(
    name="magic_formula",
    title="Magic Formula, one inflation pressure",
    equation="Y = Sv + D sin(C arctan(BX - E(BX - arctan BX))), X = x - Sh  (Eqs 3-5)",
    output="drawbar_pull_kn",
    conditions=("slip_ratio",),
    parameters=("K", "C", "D", "G", "Sh", "Sv"),
    reported={"B": "1/%", "C": "1", "D": "kN", "E": "1", "Sh": "%", "Sv": "kN"},
    response="identity",
    location=_location,
    report_theta=_report,
    theta_from_reported=_from_reported,
)
