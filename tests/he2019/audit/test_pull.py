"""Extremes of the Magic Formula over boxes: against corners, random points and a fine grid."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.he2019.audit.bounds import (
    COEFFICIENTS,
    Coefficients,
    Interval,
    coefficients,
    largest_pull,
    peak_slip,
    pressure_box,
    pressure_curves,
    printed,
    pull,
    pull_from_slope,
)
from calib.he2019.published import PUBLISHED
from tests.he2019.audit.altered import altered

SLIPS = np.array([0.0, 0.5, 2.0, 5.0, 10.0, 20.0, 45.0, 72.0])


def formula(x, B, C, D, E):
    """The Magic Formula, written anew (Eqs 3-5)."""
    bx = B * x
    return D * np.sin(C * np.arctan(bx - E * (bx - np.arctan(bx))))


def box(B, C, D, E) -> Coefficients:
    return Coefficients(*(Interval(np.array(low), np.array(high)) for low, high in (B, C, D, E)))


def points(b: Coefficients, shares) -> list[np.ndarray]:
    return [i.lower + s * (i.upper - i.lower) for i, s in zip(b, shares, strict=True)]


span = st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)).map(sorted)


@settings(max_examples=150)
@given(span, span, span, span, st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_any_point_of_the_box_lies_inside(b, c, d, e, shares):
    ends = [(low + s[0] * (high - low), low + s[1] * (high - low)) for s, (low, high) in zip(
        (b, c, d, e), ((0.01, 0.5), (1.01, 1.99), (0.1, 2.0), (-20.0, 1.0)), strict=True
    )]  # fmt: skip
    found = pull(SLIPS, box(*ends))
    assert found.holds(formula(SLIPS, *points(box(*ends), shares)))


@pytest.mark.parametrize("psi", PUBLISHED.genetic)
@pytest.mark.parametrize("table", ["geometric", "genetic"])
def test_rounding_of_tables_3_and_4_against_brute_force(table, psi):
    b = coefficients(getattr(PUBLISHED, table)[psi])
    corners = np.array([formula(SLIPS, *points(b, s)) for s in product((0.0, 1.0), repeat=4)])
    found = pull(SLIPS, b)
    assert found.holds(corners)
    # Monotone in every coefficient but at the very peak: the corners are the extremes.
    away = np.abs(SLIPS - float(peak_slip(b).middle)) > 1.0
    assert found.lower[away] == pytest.approx(corners.min(axis=0)[away], abs=1e-12)
    assert found.upper[away] == pytest.approx(corners.max(axis=0)[away], abs=1e-12)


@settings(max_examples=100)
@given(st.sampled_from([18, 30, 42]), st.lists(st.floats(0, 1), min_size=10, max_size=10))
def test_no_coefficients_that_print_alike_leave_the_enclosure(psi, shares):
    figures = [printed(PUBLISHED.pressure.estimates[name]) for name in COEFFICIENTS]
    drawn = np.array([[float(i.lower + s * (i.upper - i.lower)) for i, s in zip(
        figures, shares, strict=True)]])  # fmt: skip
    curve = pressure_curves(drawn, np.array([float(psi)]), SLIPS)[0, 0]
    found = pull_from_slope(SLIPS, pressure_box(PUBLISHED, psi))
    if np.isfinite(curve).all():
        assert found.holds(curve)


@pytest.mark.parametrize("psi", [18, 30])
def test_the_enclosure_is_reached_by_corners_and_a_fine_grid(psi):
    b = pressure_box(PUBLISHED, psi)
    found = pull_from_slope(SLIPS, b)
    K, C, D, E = (np.linspace(float(i.lower), float(i.upper), n)
                  for i, n in zip(b, (41, 3, 161, 3), strict=True))  # fmt: skip
    grid = np.meshgrid(K, C, D, E, indexing="ij")
    k, c, d, e = (g.ravel()[:, None] for g in grid)
    curves = formula(SLIPS, k / (c * d), c, d, e)
    assert found.holds(curves)
    # The enclosure is wider than what is reached by a few newtons only.
    assert np.abs(found.upper - curves.max(axis=0)).max() < 0.006
    assert np.abs(found.lower - curves.min(axis=0)).max() < 0.006
    # All sixteen corners alone would miss the extremes: the pull is not monotone in D.
    picked = [g[np.ix_(*[[0, -1]] * 4)].ravel()[:, None] for g in grid]
    corners = formula(SLIPS, picked[0] / (picked[1] * picked[2]), *picked[1:])
    assert found.holds(corners)


def test_more_cells_narrow_the_enclosure_and_stay_inside():
    b = pressure_box(PUBLISHED, 30)
    wide, narrow = pull_from_slope(SLIPS, b, cells=40), pull_from_slope(SLIPS, b, cells=1600)
    assert np.all(wide.lower <= narrow.lower + 1e-12)
    assert np.all(wide.upper >= narrow.upper - 1e-12)
    assert np.all((wide.half_width > narrow.half_width)[1:4])


def test_a_peak_that_may_be_zero_gives_all_pulls_from_zero():
    b = pressure_box(PUBLISHED, 42)
    assert float(b.D.lower) < 0.0 < float(b.D.upper)
    found = pull_from_slope(SLIPS, b)
    assert np.all(found.lower == 0.0)
    assert float(found.upper[0]) == pytest.approx(0.0, abs=1e-9)
    tiny = formula(SLIPS, float(b.stiffness.middle) / (1.554 * 1e-6), 1.554, 1e-6, -9.0)
    assert found.holds(tiny)


@pytest.mark.parametrize("psi", PUBLISHED.genetic)
def test_the_peak_is_where_a_fine_grid_has_it(psi):
    table = PUBLISHED.genetic[psi]
    x = np.linspace(0.0, 40.0, 40_001)
    at = x[formula(x, *table.values.values()).argmax()]
    found = peak_slip(coefficients(table))
    assert float(found.lower) - 2e-3 <= at <= float(found.upper) + 2e-3


def test_largest_pull_with_E_above_one_against_a_grid():
    b = coefficients(altered({"Table 3, 30 psi: E": "14.0852"}).geometric[30])
    values = PUBLISHED.geometric[30].values
    x = np.linspace(0.0, 75.0, 200_001)
    top = formula(x, values["B"], values["C"], values["D"], -values["E"]).max()
    assert largest_pull(b).holds(top)
    assert float(largest_pull(b).half_width) < 1e-4
    assert peak_slip(b) is None


def test_a_box_of_which_a_part_has_a_peak_is_refused():
    b = box((0.07, 0.08), (1.5, 1.6), (1.0, 1.1), (0.5, 3.0))
    with pytest.raises(ValueError, match="part of the box"):
        peak_slip(b)
    with pytest.raises(ValueError, match="E above 1"):
        pull(SLIPS, b)
