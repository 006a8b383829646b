"""Drawbar pull by the Magic Formula, at one inflation pressure or with pressure as a condition.

At one inflation pressure (He et al. 2019, Eqs 3-5), with slip x in percent and drawbar pull Y in
kN,

    Y = Sv + D sin{ C arctan[ B X - E (B X - arctan B X) ] },   X = x - Sh.

B trades against C and D in every fit, while the initial slope K = B C D is what the data see
near zero slip; so K is sampled and B reported. E <= 1 keeps the curve single-peaked, and its
effect is felt through the size of 1 - E; so G = 1 - E > 0 is sampled and E reported.

With pressure-dependent coefficients (Eqs 12-15) the paper makes K, the peak D and E quadratics in
inflation pressure p (psi) and keeps C = b0. The nine coefficients c1..c9 of monomials in p are
almost collinear, so each quadratic is sampled through its values at the lowest and the highest
calibrated pressure and its curvature,

    Q(p) = Q_lo (1 - u)/2 + Q_hi (1 + u)/2 + q (u^2 - 1),   u = (p - p_mid)/p_half,

which is the same quadratic: two pressures determine Q_lo and Q_hi and leave q to its prior; q is
relative to the mean of the end values. The quadratics are K, D and G = 1 - E, all of which must be
positive over the calibrated pressures: a negative stiffness or peak has no meaning, and E <= 1
keeps the curve single-peaked.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.models.base import Array, Conditions, References
from calib.models.card import Equation, from_cards


def magic_formula(
    slip_percent: Array,
    B: Array | float,
    C: Array | float,
    D: Array | float,
    E: Array | float,
    Sh: Array | float = 0.0,
    Sv: Array | float = 0.0,
) -> Array:
    """Evaluate the Magic Formula in kN, as it broadcasts.

    Slip and horizontal shift Sh in percent, stiffness factor B in 1/%, peak factor D and vertical
    shift Sv in kN, shape factor C, curvature factor E. He, Sandu & Osorio (2019), Eqs 3-5,
    doi:10.1016/j.jterra.2019.07.003.
    """
    bx = B * (slip_percent - Sh)
    return np.asarray(Sv + D * np.sin(C * np.arctan(bx - E * (bx - np.arctan(bx)))))


def sine_of(bx: Array, C: Array, G: Array) -> Array:
    """Return sin(C arctan[B X - E (B X - arctan B X)]), with G = 1 - E, as it broadcasts."""
    angle = np.arctan(bx)
    return np.asarray(np.sin(C * np.arctan(angle + G * (bx - angle))))


def _pull(x: Conditions, K: Array, C: Array, D: Array, G: Array, Sh: Array, Sv: Array) -> Array:
    return D * sine_of(K / (C * D) * (100.0 * x["slip_ratio"] - Sh), C, G) + Sv


def _published(ref: References, K: Any, C: Any, D: Any, G: Any, Sh: Any, Sv: Any) -> dict[str, Any]:
    return {"B": K / (C * D), "C": C, "D": D, "E": 1.0 - G, "Sh": Sh, "Sv": Sv}


def _sampled(
    ref: References, B: Any, C: Any, D: Any, E: Any, Sh: Any = 0.0, Sv: Any = 0.0
) -> dict[str, Any]:
    return {"K": B * C * D, "C": C, "D": D, "G": 1.0 - E, "Sh": Sh, "Sv": Sv}


def _quadratic(low: Array, high: Array, bend: Array, u: Array) -> Array:
    """Evaluate a quadratic at u; NaN unless it is positive over -1 <= u <= 1."""
    mean, half = 0.5 * (low + high), 0.5 * (high - low)
    curvature = bend * mean
    steep = np.abs(half)
    # Where the vertex lies inside, it is the lowest point: mean - curvature - half^2/(4 curvature).
    inside = steep < 2.0 * curvature
    falls_through = inside & (4.0 * curvature * (mean - curvature) <= half * half)
    # A mean without a value leaves the whole curve without one.
    positive = np.where((mean > steep) & ~falls_through, mean, np.nan)
    return np.asarray(positive + half * u + curvature * (u * u - 1.0))


def _at(u: Array, p: dict[str, Array]) -> tuple[Array, Array, Array]:
    """Return K, D and G where the relative pressure is u."""
    K, D, G = (_quadratic(p[f"{q}_lo"], p[f"{q}_hi"], p[f"{q}_bend"], u) for q in "KDG")
    return K, D, G


def coefficients_at(theta: Array, pressure_psi: Array, references: References) -> dict[str, Array]:
    """Return B (1/%), C, D (kN), E (k, n) of sampled parameters (k, 10) at pressures (n,)."""
    u = (np.asarray(pressure_psi) - references["p_mid_psi"]) / references["p_half_psi"]
    names = MODELS[1].parameters
    p = dict(zip(names, np.atleast_2d(theta).T[:, :, None], strict=True))
    K, D, G = _at(u, p)
    C = np.broadcast_to(p["C"], D.shape)
    return {"B": K / (C * D), "C": C, "D": D, "E": 1.0 - G}


def _pull_by_pressure(x: Conditions, C: Array, **ends: Array) -> Array:
    K, D, G = _at((x["inflation_pressure_psi"] - x["p_mid_psi"]) / x["p_half_psi"], ends)
    # Extrapolated to other pressures, the quadratics may still turn negative.
    D = np.where((D > 0.0) & (K > 0.0), D, np.nan)
    return D * sine_of(K / (C * D) * (100.0 * x["slip_ratio"]), C, G)


def _monomials(ref: References, low: Any, high: Any, bend: Any) -> tuple[Any, Any, Any]:
    mid, half = ref["p_mid_psi"], ref["p_half_psi"]
    mean = 0.5 * (low + high)
    slope, curvature = 0.5 * (high - low) / half, bend * mean / half**2
    constant = mean * (1.0 - bend) - slope * mid + curvature * mid**2
    return constant, slope - 2.0 * curvature * mid, curvature


def _ends(ref: References, constant: Any, linear: Any, square: Any, name: str) -> dict[str, Any]:
    mid, half = ref["p_mid_psi"], ref["p_half_psi"]
    low, high = (constant + linear * p + square * p * p for p in (mid - half, mid + half))
    bend = 2.0 * square * half**2 / (low + high)
    return {f"{name}_lo": low, f"{name}_hi": high, f"{name}_bend": bend}


def _published_by_pressure(ref: References, C: Any, **ends: Any) -> dict[str, Any]:
    D, K, G = (_monomials(ref, ends[f"{q}_lo"], ends[f"{q}_hi"], ends[f"{q}_bend"]) for q in "DKG")
    values = (*D, *K, 1.0 - G[0], -G[1], -G[2])
    return {f"c{i}": value for i, value in enumerate(values, start=1)} | {"b0": C}


def _sampled_by_pressure(ref: References, b0: Any, **c: Any) -> dict[str, Any]:
    D = _ends(ref, c["c1"], c["c2"], c["c3"], "D")
    K = _ends(ref, c["c4"], c["c5"], c["c6"], "K")
    G = _ends(ref, 1.0 - c["c7"], -c["c8"], -c["c9"], "G")
    return {**K, **D, **G, "C": b0}


def _references(conditions: Conditions) -> dict[str, float]:
    pressure = conditions["inflation_pressure_psi"]
    low, high = float(pressure.min()), float(pressure.max())
    if not high > low * (1.0 + 1e-9):
        raise CalibError(
            f"model magic_formula_pressure found one inflation pressure only ({low:g} psi)",
            where="column inflation_pressure",
            expected="at least two distinct inflation pressures",
            hint="add tests at another pressure, or fit the model magic_formula",
        )
    return {"p_mid_psi": 0.5 * (low + high), "p_half_psi": 0.5 * (high - low)}


MODELS = from_cards(
    "magic_formula",
    magic_formula=Equation(_pull, _published, _sampled),
    magic_formula_pressure=Equation(
        _pull_by_pressure, _published_by_pressure, _sampled_by_pressure, _references
    ),
)
