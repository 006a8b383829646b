"""Bounds on what the printed digits allow: intervals, boxes of coefficients, costs of curves."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.he2019.audit.bounds import (
    ASSUMED_SLIPS,
    COEFFICIENTS,
    Coefficients,
    Interval,
    arctan,
    coefficients,
    exact,
    exp,
    joint_bounds,
    largest_pull,
    log,
    peak_slip,
    pressure_box,
    pressure_curves,
    printed,
    printed_coefficients,
    pull,
    pull_from_slope,
    references,
    sin,
    square,
    tan,
)
from calib.he2019.published import PUBLISHED
from calib.models.magic_formula import magic_formula
from calib.report.reference import Figure
from tests.he2019.altered import altered


def interval(low: float, high: float) -> Interval:
    return Interval(np.array(min(low, high)), np.array(max(low, high)))


def inside(i: Interval, share: float) -> float:
    low, high = float(i.lower), float(i.upper)
    return min(max(low + share * (high - low), low), high)


@settings(max_examples=50)
@given(*[st.floats(-1e6, 1e6, allow_nan=False)] * 4, st.floats(0, 1), st.floats(0, 1))
def test_the_exact_result_of_any_two_numbers_lies_inside(a, b, c, d, s, t):
    x, y = interval(a, b), interval(c, d)
    u, v = inside(x, s), inside(y, t)
    results = {"+": (x + y, Fraction(u) + Fraction(v)), "-": (x - y, Fraction(u) - Fraction(v)),
               "*": (x * y, Fraction(u) * Fraction(v))}  # fmt: skip
    if not (y.lower <= 0.0 <= y.upper):
        results["/"] = (x / y, Fraction(u) / Fraction(v))
    for name, (found, true) in results.items():
        low, high = float(found.lower), float(found.upper)
        # An end beyond the largest number is infinite: it bounds nothing, rightly.
        assert np.isinf(low) or Fraction(low) <= true, name
        assert np.isinf(high) or true <= Fraction(high), name
    # No wider than the corners but for rounding.
    corners = [Fraction(p) * Fraction(q) for p in (a, b) for q in (c, d)]
    slack = 1e-14 * max(1.0, float(max(map(abs, corners))))
    assert float((x * y).upper) <= float(max(corners)) + slack
    assert float((x * y).lower) >= float(min(corners)) - slack


@pytest.mark.parametrize(
    ("function", "reference", "low", "high"),
    [(arctan, np.arctan, -50.0, 50.0), (exp, np.exp, -20.0, 20.0), (log, np.log, 1e-6, 1e6),
     (tan, np.tan, 0.01, 1.56), (sin, np.sin, 0.0, 3.14), (square, np.square, -50.0, 50.0)],
)  # fmt: skip
@settings(max_examples=25)
@given(ends=st.tuples(st.floats(0, 1), st.floats(0, 1)), share=st.floats(0, 1))
def test_functions_hold_their_values(function, reference, low, high, ends, share):
    x = interval(low + ends[0] * (high - low), low + ends[1] * (high - low))
    # 64 bits of mantissa: the reference errs a thousand times less than the steps outward.
    true = reference(np.longdouble(inside(x, share)))
    found = function(x)
    assert np.longdouble(found.lower) <= true <= np.longdouble(found.upper)


def test_a_printed_figure_is_every_number_that_prints_so():
    found = printed(Figure("-0.107"))
    assert found.holds([-0.1075, -0.107, -0.1065])
    assert not found.holds(-0.10751)
    assert printed(Figure("5.934e-10")).holds(5.9344e-10)


@pytest.mark.parametrize(
    "refused",
    [lambda: Interval(np.array(2.0), np.array(1.0)), lambda: exact(1.0) / interval(-1.0, 1.0),
     lambda: log(interval(-1.0, 1.0)), lambda: sin(interval(0.0, 4.0)),
     lambda: tan(interval(0.5, 1.6))],
)  # fmt: skip
def test_what_has_no_meaning_is_refused(refused):
    with pytest.raises(ValueError, match=r"interval|sine|tangent"):
        refused()


SLIPS = np.array([0.0, 0.5, 2.0, 5.0, 10.0, 20.0, 45.0, 72.0])


def formula(x, B, C, D, E):
    """The Magic Formula, written anew (Eqs 3-5)."""
    bx = B * x
    return D * np.sin(C * np.arctan(bx - E * (bx - np.arctan(bx))))


def box(B, C, D, E) -> Coefficients:
    return Coefficients(*(Interval(np.array(low), np.array(high)) for low, high in (B, C, D, E)))


def points(b: Coefficients, shares) -> list[np.ndarray]:
    return [i.lower + s * (i.upper - i.lower) for i, s in zip(b, shares, strict=True)]


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


@settings(max_examples=30)
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


@pytest.fixture(scope="module")
def known():
    return references(PUBLISHED)


@pytest.mark.parametrize("optimal", [False, True])
def test_simulated_data_stay_within_the_bounds(known, optimal):
    rng = np.random.default_rng(1)
    for reference in known:
        other = magic_formula(ASSUMED_SLIPS, **PUBLISHED.geometric[reference.psi].values)
        low, high = (float(b[0]) for b in reference.bounds(other[None], optimal=optimal))
        errors = rng.standard_normal((1000, ASSUMED_SLIPS.size))
        # Also those that point at the other curve, where the bounds are attained.
        apart = other - reference.curve
        if optimal:
            errors -= errors @ reference.span @ reference.span.T
            apart = apart - reference.span @ (reference.span.T @ apart)
        errors = np.vstack([errors, apart, -apart])
        errors *= np.sqrt(reference.cost) / np.linalg.norm(errors, axis=1)[:, None]
        costs = np.sum((reference.curve + errors - other) ** 2, axis=1)
        assert costs.min() >= low - 1e-12
        assert costs.max() <= high + 1e-12
        assert costs[-2:] == pytest.approx([low, high])


def test_pressure_curves_against_the_equations_written_anew():
    c = printed_coefficients(PUBLISHED)
    found = pressure_curves(c[None], np.array([18.0, 30.0]), ASSUMED_SLIPS)[0]
    for i, p in enumerate((18.0, 30.0)):
        K = 0.267 - 0.007 * p + 0.0001 * p**2
        D = 3.272 - 0.107 * p + 0.001 * p**2
        E = 0.963 - 0.139 * p - 0.0025 * p**2
        u = K / (1.554 * D) * ASSUMED_SLIPS
        assert found[i] == pytest.approx(
            D * np.sin(1.554 * np.arctan(u - E * (u - np.arctan(u)))), rel=1e-12
        )


def test_no_value_is_an_infinite_cost(known):
    c = printed_coefficients(PUBLISHED)
    c[0] = -3.272
    least, largest = joint_bounds(c[None], known, ASSUMED_SLIPS, optimal=False)
    assert least.tolist() == largest.tolist() == [np.inf]
