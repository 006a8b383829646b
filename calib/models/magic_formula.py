"""Drawbar pull by the Magic Formula, at one inflation pressure or with pressure as a condition.

Drawbar pull by the Magic Formula at one inflation pressure (He et al. 2019, Eqs 3-5).

With slip x in percent and drawbar pull Y in kN,

    Y = Sv + D sin{ C arctan[ B X - E (B X - arctan B X) ] },   X = x - Sh.

B trades against C and D in every fit, while the initial slope K = B C D is what the data see
near zero slip; so K is sampled and B reported. E <= 1 keeps the curve single-peaked, and its
effect is felt through the size of 1 - E; so G = 1 - E > 0 is sampled and E reported.

Drawbar pull by the Magic Formula with pressure-dependent coefficients (Eqs 12-15).

The paper makes the initial slope K = B C D, the peak D and the curvature factor E quadratics in
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

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models.base import (
    Alone,
    Array,
    Columns,
    Conditions,
    Model,
    References,
    Rows,
    Searched,
    columns,
)


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
    """Return sin(C arctan[B X - E (B X - arctan B X)]), with G = 1 - E, as it broadcasts.

    By t = tan(v/2), sin v = 2 t/(1 + t^2): NumPy's tangent is faster than its sine.
    """
    angle = np.arctan(bx)
    half = np.tan(0.5 * C * np.arctan(angle + G * (bx - angle)))
    return np.asarray(2.0 * half / (1.0 + half * half))


def _prepare(conditions: Conditions, references: References) -> Rows:
    return {"slip_percent": 100.0 * conditions["slip_ratio"]}


def _pull(columns: Columns, rows: Rows, references: References) -> Array:
    K, C, D, G, Sh, Sv = columns
    return D * sine_of(K / (C * D) * (rows["slip_percent"] - Sh), C, G) + Sv


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
    mean_response=_pull,
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
    searched=_SEARCHED,
    estimates_all_rows=True,
)


def _positive(mean: Array, half: Array, curvature: Array) -> NDArray[np.bool_]:
    """Whether mean + half u + curvature (u^2 - 1) is positive over -1 <= u <= 1."""
    steep = np.abs(half)
    # Where the vertex lies inside, it is the lowest point: mean - curvature - half^2/(4 curvature).
    falls_through = 4.0 * curvature * (mean - curvature) <= half * half
    return np.asarray((mean > steep) & ~((steep < 2.0 * curvature) & falls_through), dtype=np.bool_)


def _at(columns: Columns, u: Array) -> tuple[Array, Array, Array, Array]:
    # K, D and G at once, along a leading axis.
    low, high, bend = (np.stack(columns[j:9:3]) for j in range(3))
    mean, half = 0.5 * (low + high), 0.5 * (high - low)
    curvature = bend * mean
    allowed = _positive(mean, half, curvature).all(axis=0)
    K, D, G = mean + half * u + curvature * (u * u - 1.0)
    return K, columns[9], np.where(allowed, D, np.nan), G


def coefficients_at(theta: Array, pressure_psi: Array, references: References) -> dict[str, Array]:
    """Return B (1/%), C, D (kN), E (k, n) of sampled parameters (k, 10) at pressures (n,)."""
    u = (np.asarray(pressure_psi) - references["p_mid_psi"]) / references["p_half_psi"]
    K, C, D, G = _at(columns(np.atleast_2d(theta)), u)
    return {"B": K / (C * D), "C": np.broadcast_to(C, D.shape), "D": D, "E": 1.0 - G}


def _prepare_by_pressure(conditions: Conditions, references: References) -> Rows:
    pressure = conditions["inflation_pressure_psi"]
    rows: dict[str, NDArray[Any]] = {"slip_percent": 100.0 * conditions["slip_ratio"]}
    if pressure.ndim == 1:
        # The quadratics are evaluated once per distinct pressure.
        pressure, level = _levels(pressure.tobytes())
        if pressure.size > 1:
            rows["level"] = level
    # Otherwise every vector and row has a pressure, as with an uncertain gauge.
    rows["u"] = (pressure - references["p_mid_psi"]) / references["p_half_psi"]
    return rows


@lru_cache(maxsize=64)
def _levels(pressure: bytes) -> tuple[Array, NDArray[np.intp]]:
    """Return distinct pressures and the index of each row's; a fit repeats the same rows."""
    return np.unique(np.frombuffer(pressure), return_inverse=True)


def _pull_by_pressure(columns: Columns, rows: Rows, references: References) -> Array:
    K, C, D, G = _at(columns, rows["u"])
    # Extrapolated to other pressures, the quadratics may still turn negative.
    D = np.where((D > 0.0) & (K > 0.0), D, np.nan)
    B = K / (C * D)
    if "level" in rows:
        B, D, G = (np.take(v, rows["level"], axis=1) for v in (B, D, G))
    return D * sine_of(B * rows["slip_percent"], C, G)


def _monomials(low: Array, high: Array, bend: Array, references: References) -> tuple[Array, ...]:
    mid, half = references["p_mid_psi"], references["p_half_psi"]
    mean = 0.5 * (low + high)
    slope, curvature = 0.5 * (high - low) / half, bend * mean / half**2
    constant = mean * (1.0 - bend)
    return (
        constant - slope * mid + curvature * mid**2,
        slope - 2.0 * curvature * mid,
        curvature,
    )


def _report_by_pressure(theta: Array, references: References) -> dict[str, Array]:
    K_lo, K_hi, K_bend, D_lo, D_hi, D_bend, G_lo, G_hi, G_bend, C = theta.T
    c1, c2, c3 = _monomials(D_lo, D_hi, D_bend, references)
    c4, c5, c6 = _monomials(K_lo, K_hi, K_bend, references)
    g7, g8, g9 = _monomials(G_lo, G_hi, G_bend, references)
    return {
        "c1": c1, "c2": c2, "c3": c3, "c4": c4, "c5": c5,
        "c6": c6, "c7": 1.0 - g7, "c8": -g8, "c9": -g9, "b0": C,
    }  # fmt: skip


def _from_reported_by_pressure(reported: Mapping[str, float], references: References) -> Array:
    mid, half = references["p_mid_psi"], references["p_half_psi"]

    def ends(constant: float, linear: float, square: float) -> tuple[float, float, float]:
        low, high = (constant + linear * p + square * p * p for p in (mid - half, mid + half))
        return low, high, 2.0 * square * half**2 / (low + high)

    D = ends(reported["c1"], reported["c2"], reported["c3"])
    K = ends(reported["c4"], reported["c5"], reported["c6"])
    G = ends(1.0 - reported["c7"], -reported["c8"], -reported["c9"])
    return np.array([*K, *D, *G, reported["b0"]])


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


MAGIC_FORMULA_PRESSURE = Model(
    name="magic_formula_pressure",
    title="Magic Formula with inflation pressure",
    output="drawbar_pull_kn",
    conditions=("slip_ratio", "inflation_pressure_psi"),
    parameters=(
        "K_lo", "K_hi", "K_bend", "D_lo", "D_hi", "D_bend", "G_lo", "G_hi", "G_bend", "C",
    ),
    reported={
        "c1": "kN", "c2": "kN/psi", "c3": "kN/psi^2", "c4": "kN/%", "c5": "kN/%/psi",
        "c6": "kN/%/psi^2", "c7": "1", "c8": "1/psi", "c9": "1/psi^2", "b0": "1",
    },
    response="identity",
    mean_response=_pull_by_pressure,
    report_theta=_report_by_pressure,
    theta_from_reported=_from_reported_by_pressure,
    bind_references=_references,
    prepare=_prepare_by_pressure,
    latex=(
        r"$Y = D \sin\{C \arctan[B x - E (B x - \arctan B x)]\}$",
        "$B C D = c_4 + c_5 p + c_6 p^2$",
        "$C = b_0$",
        "$D = c_1 + c_2 p + c_3 p^2$",
        "$E = c_7 + c_8 p + c_9 p^2$",
    ),
    numbers="Eqs 12-15",
    cited="He_2019",
    source="He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003",
    letters=("[$Y] the drawbar pull (kN), [$x] the slip (%), [$p] the inflation pressure (psi)"),
    applies=(
        "One tyre, soil and load, at two inflation pressures or more; with one pressure it is "
        "refused. Two pressures cannot determine a quadratic: the curvature between them is then "
        "the prior's, and the report says so. Slope, peak and 1 - E must be positive over the "
        "calibrated pressures; far outside these the quadratics may turn negative, and there is "
        "no value."
    ),
    parametrisation=(
        "Each quadratic in pressure is sampled through its values at the lowest (_lo) "
        "and highest (_hi) calibrated pressure, {p_low_psi:.4g} and {p_high_psi:.4g} "
        "psi, and its relative curvature between them (_bend): K = BCD, D and G = 1 - "
        "E. All three quadratics must stay positive between these pressures, which "
        "truncates the priors (bends below about 1). The coefficients c1 to c9 of the "
        "source follow."
    ),
    alone=Alone("inflation_pressure_psi", "magic_formula", {"Sh": 0.0, "Sv": 0.0}),
    parabolic_in="inflation_pressure_psi",
    estimates_all_rows=True,
)  # fmt: skip
