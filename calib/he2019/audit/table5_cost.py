"""The printed cost of Table 5: against the least that Eqs 12-15 can have, and its own digits'.

Quadratics through three pressures are free at each of them, so Eqs 12-15 are the Magic Formula of
each pressure with one C for all. Any such curves near Table 4's cost at most (|d| + r)^2 a pressure
(`calib.he2019.audit.nearness`), whatever the data: that bounds the optimum from above. With the
largest distance over all slips in the place of the tested ones the bound needs no slips at all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize, minimize_scalar

from calib.batch.threads import one_thread
from calib.he2019.audit.finding import (
    Basis,
    Finding,
    Quantity,
    Verdict,
    between,
    finding,
)
from calib.he2019.audit.nearness import (
    ASSUMED_SLIPS,
    Reference,
    joint_bounds,
    printed_coefficients,
    references,
)
from calib.he2019.audit.pull import coefficients, pull
from calib.he2019.datasets.published import Published
from calib.models.base import Array
from calib.models.magic_formula import magic_formula
from calib.report.reference import FittedTable

_BINS = 75
_LARGEST_SLIP = float(_BINS)
_COARSE = np.linspace(0.0, _LARGEST_SLIP, 4 * _BINS + 1)
_FINE = np.linspace(0.0, _LARGEST_SLIP, 100 * _BINS + 1)
_N_C = 9


def _common_C(published: Published) -> Array:
    values = [table.values["C"] for table in published.genetic.values()]
    return np.linspace(min(values), max(values), _N_C)


def _start(table: FittedTable, C: float, slips: Array) -> Array:
    """Return B, D and E of the curve with another C nearest in the sum of squares."""
    own = table.values
    curve = magic_formula(slips, **own)

    def apart(t: Array) -> Array:
        return magic_formula(slips, t[0], C, t[1], t[2]) - curve

    found = least_squares(apart, np.array([own["B"], own["D"], own["E"]]), x_scale="jac")
    return np.asarray(found.x)


def _worst_norm(apart: Array, levels: int) -> Array:
    """Return the largest |d| of any slips of which no two are within 1 %: one in each bin."""
    in_bins = apart[:-1].reshape(_BINS, -1)
    largest = np.maximum(in_bins.max(axis=1), np.append(in_bins[1:, 0], apart[-1]))
    return np.asarray(np.sqrt(np.sum(np.sort(largest)[-levels:] ** 2)))


def _nearest_everywhere(table: FittedTable, C: float, levels: int) -> Array:
    """Return B, D and E of the curve with another C that is nearest at the worst slips."""
    curve = magic_formula(_COARSE, **table.values)

    def norm(t: Array) -> float:
        apart = np.abs(magic_formula(_COARSE, t[0], C, t[1], t[2]) - curve)
        return float(_worst_norm(apart, levels)) if np.isfinite(apart).all() else 1e3

    found = minimize(
        norm, _start(table, C, _COARSE), method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-5, "maxiter": 1000, "maxfev": 1000},
    )  # fmt: skip
    return np.asarray(found.x)


def _largest_norm(table: FittedTable, C: float, levels: int) -> float:
    """Return a |d| (kN) that some curve with another C exceeds at no slips.

    It holds for all coefficients that print as Table 4, and between the points of the grid.
    """
    B, D, E = _nearest_everywhere(table, C, levels)
    allowed = pull(_FINE, coefficients(table))
    curve = magic_formula(_FINE, B, C, D, E)
    apart = np.maximum(allowed.upper - curve, curve - allowed.lower)
    between = 0.5 * np.abs(np.diff(curve - magic_formula(_FINE, **table.values))).max()
    return float(_worst_norm(apart + between, levels))


def any_slips_bound(published: Published) -> float:
    """Return a cost (kN^2) that the joint optimum cannot exceed, whatever the slips.

    They are up to 75 %, no two of them within 1 %.
    """
    levels = int(published.setup.slip_levels.value)

    def total(C: float) -> float:
        cost = 0.0
        for table in published.genetic.values():
            figure = table.quality["cost"]
            r = np.sqrt(figure.value + figure.half_unit)
            cost += float((r + _largest_norm(table, C, levels)) ** 2)
        return cost

    between = _common_C(published)[[0, -1]]
    # It bounds the optimum whatever C is; the last digit of the best C is of no use.
    found = minimize_scalar(total, bounds=between, method="bounded", options={"xatol": 5e-3})
    return float(found.fun)


def assumed_slips_bound(published: Published, *, optimal: bool) -> float:
    """Return a cost (kN^2) that the joint optimum cannot exceed at the assumed slips.

    `optimal` takes Table 4 for the optimum of each pressure.
    """
    known = references(published)

    def cost(reference: Reference, C: float) -> float:
        t = _start(published.genetic[reference.psi], C, ASSUMED_SLIPS)
        curve = magic_formula(ASSUMED_SLIPS, t[0], C, t[1], t[2])[None]
        return float(reference.bounds(curve, optimal=optimal)[1][0])

    return min(sum(cost(r, float(C)) for r in known) for C in _common_C(published))


class Bounds(NamedTuple):
    """Costs (kN^2) that the joint optimum cannot exceed.

    Whatever the slips, at the assumed ones, and there if Table 4 is optimal.
    """

    anywhere: float
    assumed: float
    optimal: float


@one_thread()
def bounds(published: Published) -> Bounds:
    """Bound the joint optimum, from Table 4 alone."""
    return Bounds(
        any_slips_bound(published),
        assumed_slips_bound(published, optimal=False),
        assumed_slips_bound(published, optimal=True),
    )


def cost_findings(
    published: Published, reconstructed_optimum: float, at_most: Bounds
) -> list[Finding]:
    """Judge the printed cost: as a minimum, and as that of the printed digits."""
    return [joint_cost(published, reconstructed_optimum, at_most), cost_as_printed(published)]


def joint_cost(published: Published, reconstructed_optimum: float, at_most: Bounds) -> Finding:
    """Judge whether the printed cost can be a minimum of Eq 16.

    Parameters
    ----------
    reconstructed_optimum : float
        The joint optimum on the reconstructed data, for comparison, kN^2.
    at_most : Bounds
        What `bounds` gives.
    """
    figure = published.pressure.quality["cost"]
    separate = [table.quality["cost"] for table in published.genetic.values()]
    floor = sum(f.value - f.half_unit for f in separate)
    low, high = figure.value - figure.half_unit, figure.value + figure.half_unit
    below, above = high < floor, low > at_most.anywhere
    contradicted = below or above or low > at_most.assumed
    each = (
        ("minimum at any slips", at_most.anywhere, "bounds for any data with Table 4's costs"),
        ("minimum at the assumed slips", at_most.assumed,
         "bounds for any data with Table 4's costs"),
        ("and if Table 4 is optimal", at_most.optimal, "bounds"),
    )  # fmt: skip
    name = "minimum on the reconstructed data"
    return finding(
        "table5_joint_cost", Verdict.CONTRADICTED if contradicted else Verdict.CONSISTENT,
        (*(between(what, floor, most, "kN^2", kind, figure.text) for what, most, kind in each),
         Quantity(name, reconstructed_optimum, "kN^2", published=figure.text)),
        basis=Basis.PRINTED if below or above else None, printed=figure, floor=floor, below=below,
        above=above, levels=published.setup.slip_levels.text, largest_slip=_LARGEST_SLIP,
        anywhere=at_most.anywhere, assumed=at_most.assumed,
    )  # fmt: skip


def cost_as_printed(published: Published) -> Finding:
    """Judge whether the coefficients as printed can have the printed cost."""
    figure = published.pressure.quality["cost"]
    known = references(published)
    both = np.tile(printed_coefficients(published), (2, 1))
    both[1, 8] *= -1.0  # the sign of c9 is open
    least, largest = joint_bounds(both, known, ASSUMED_SLIPS, optimal=False)
    strict, _ = joint_bounds(both, known, ASSUMED_SLIPS, optimal=True)
    refused = [bool((bound > figure.value + figure.half_unit).all()) for bound in (least, strict)]
    named = [f"c9 = {c9:+g}" for c9 in both[:, 8]]
    what = "any data with Table 4's costs"
    found = [
        between(f"cost with {name}", low, high, "kN^2", what, figure.text)
        for name, low, high in zip(named, least, largest, strict=True)
    ]
    found += [
        Quantity(f"least with {name} if Table 4 is optimal", low, "kN^2", published=figure.text)
        for name, low in zip(named, strict.tolist(), strict=True)
    ]
    return finding(
        "table5_cost_as_printed", Verdict.CONTRADICTED if any(refused) else Verdict.CONSISTENT,
        found, printed=figure, strict=strict.tolist(), least=least.tolist(), named=named,
    )  # fmt: skip
