"""Interval arithmetic: exact rationals for the four operations, long doubles for the functions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.he2019.audit.bounds import Interval, arctan, exact, exp, log, printed, sin, square, tan
from calib.report.reference import Figure

FINITE = st.floats(-1e6, 1e6, allow_nan=False)


def interval(low: float, high: float) -> Interval:
    return Interval(np.array(min(low, high)), np.array(max(low, high)))


def inside(i: Interval, share: float) -> float:
    low, high = float(i.lower), float(i.upper)
    return min(max(low + share * (high - low), low), high)


@given(FINITE, FINITE, FINITE, FINITE, st.floats(0, 1), st.floats(0, 1))
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


@given(FINITE, FINITE, FINITE, FINITE)
def test_no_wider_than_the_corners_but_for_rounding(a, b, c, d):
    x, y = interval(a, b), interval(c, d)
    corners = [Fraction(p) * Fraction(q) for p in (a, b) for q in (c, d)]
    found = x * y
    slack = 1e-14 * max(1.0, float(max(map(abs, corners))))
    assert float(found.upper) <= float(max(corners)) + slack
    assert float(found.lower) >= float(min(corners)) - slack


@pytest.mark.parametrize(
    ("function", "reference", "low", "high"),
    [(arctan, np.arctan, -50.0, 50.0), (exp, np.exp, -20.0, 20.0), (log, np.log, 1e-6, 1e6),
     (tan, np.tan, 0.01, 1.56), (sin, np.sin, 0.0, 3.14), (square, np.square, -50.0, 50.0)],
)  # fmt: skip
@given(ends=st.tuples(st.floats(0, 1), st.floats(0, 1)), share=st.floats(0, 1))
def test_functions_hold_their_values(function, reference, low, high, ends, share):
    x = interval(low + ends[0] * (high - low), low + ends[1] * (high - low))
    # 64 bits of mantissa: the reference errs a thousand times less than the steps outward.
    true = reference(np.longdouble(inside(x, share)))
    found = function(x)
    assert np.longdouble(found.lower) <= true <= np.longdouble(found.upper)


def test_sine_and_square_know_their_turning_points():
    assert float(sin(interval(1.0, 2.0)).upper) == 1.0
    assert float(sin(interval(1.0, 2.0)).lower) == pytest.approx(np.sin(1.0))
    assert float(square(interval(-1.0, 2.0)).lower) == 0.0
    assert float(square(interval(-3.0, 2.0)).upper) == pytest.approx(9.0)


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
