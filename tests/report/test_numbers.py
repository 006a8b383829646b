"""Numbers in the precision that their uncertainty warrants."""

from __future__ import annotations

import math
import re
from decimal import Decimal

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from calib.report.numbers import (
    NOTHING,
    TIMES,
    ascii_number,
    ascii_text,
    format_as_printed,
    format_at,
    format_interval,
    format_like,
    format_number,
    format_value,
    last_place,
)

MINUS = "\N{MINUS SIGN}"
SUPER = str.maketrans("\N{SUPERSCRIPT MINUS}⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
POWER = re.compile(rf"{TIMES}10([\N{{SUPERSCRIPT MINUS}}⁰¹²³⁴⁵⁶⁷⁸⁹]+)")
finite = st.floats(-1e9, 1e9, allow_nan=False)
spread = st.floats(1e-9, 1e9, allow_nan=False)


def read(text: str) -> list[float]:
    """Read numbers back from a formatted text."""
    body, _, power = text.replace(MINUS, "-").partition(f"{TIMES}10")
    scale = 10.0 ** int(power.translate(SUPER)) if power else 1.0
    return [float(t) * scale for t in re.split(r" ± | to ", body.strip("()"))]


def read_interval(text: str) -> list[float]:
    """Read the ends of an interval, each with a power of its own or with a common one."""
    if text.startswith("("):
        return read(text)
    return [read(end)[0] for end in text.split(" to ")]


def parts(text: str) -> list[str]:
    """The mantissas of a formatted text."""
    return re.split(r" ± | to ", POWER.sub("", text).strip("()").replace(MINUS, "-"))


@pytest.mark.parametrize(
    ("mean", "sd", "text"),
    [
        (1.64812, 0.0251, "1.648 ± 0.025"),
        (1.64812, 0.0996, "1.65 ± 0.10"),
        (3.31e5, 1.2e5, f"(3.3 ± 1.2){TIMES}10⁵"),
        (-0.1026, 1.3, f"{MINUS}0.1 ± 1.3"),
        (1234.5, 67.0, "1234 ± 67"),
        (12345.0, 678.0, "12340 ± 680"),
        (5.9e-10, 2.0e-10, f"(5.9 ± 2.0){TIMES}10\N{SUPERSCRIPT MINUS}¹⁰"),
        (-0.0001, 0.1, "0.00 ± 0.10"),
        (2.5, 0.0, "2.50000"),
        (float("nan"), 1.0, NOTHING),
        (1.0, float("inf"), NOTHING),
    ],
)
def test_format_value(mean, sd, text):
    assert format_value(mean, sd) == text


def exponent_at_two_digits(value: float) -> int:
    """Of a number as it is written: 0.995 is 1.0, though the float lies just below."""
    written = Decimal(repr(value))
    return round(written, 1 - written.adjusted()).adjusted()


@given(finite, spread)
@example(1.75, 0.995)
def test_no_more_is_lost_than_the_sd_allows(mean, sd):
    shown_mean, shown_sd = read(format_value(mean, sd))
    unit = 10.0 ** (exponent_at_two_digits(sd) - 1)
    slack = 1.0 + 1e-6
    assert abs(shown_mean - mean) <= 0.5 * unit * slack + 1e-12 * abs(mean)
    assert abs(shown_sd - sd) <= 0.5 * unit * slack


@given(finite, spread)
def test_minus_signs_are_minus_signs(mean, sd):
    assert "-" not in format_value(mean, sd)


@given(st.floats(-1e12, 1e12).filter(lambda x: abs(x) > 1e-12), st.integers(1, 6))
def test_numbers_keep_their_digits(value, digits):
    (shown,) = read(format_number(value, digits))
    assert shown == pytest.approx(value, rel=0.5001 * 10.0 ** (1 - digits))


def test_intervals_share_the_decimals_of_the_value():
    assert format_interval(1.6012, 1.6949, 0.0251) == "1.601 to 1.695"
    assert format_interval(-1.0, 1.0, float("nan")) == NOTHING
    assert format_interval(1e5, 5e5, 1.2e5) == f"(1.0 to 5.0){TIMES}10⁵"


@pytest.mark.parametrize(
    ("uncertainty", "mcse", "text"),
    [
        (0.0251, (0.0009, 0.0009), "1.601 to 1.695"),  # errors below the last digit
        (0.0251, (0.0011, 0.0011), "1.60 to 1.69"),  # just above it
        (0.0251, (0.0005, 0.0011), "1.60 to 1.69"),  # neighbours share the coarser
        (0.0251, (0.3, 0.3), "1.60 to 1.69"),  # one digit of the uncertainty stays
        ((0.0251, 2.51), (0.0, 0.0), "1.601 to 1.7"),  # ends of a long tail do not
        ((0.0251, 25.1), (0.0, 0.0), "1.601 to 2"),
    ],
)
def test_intervals_are_cut_by_their_monte_carlo_errors(uncertainty, mcse, text):
    assert format_interval(1.6012, 1.6949, uncertainty, mcse) == text


def test_an_end_that_is_nothing_is_zero():
    assert format_interval(2e-21, 1.1e-8, (8e-11, 1.1e-8)) == f"0 to 1.1{TIMES}10⁻⁸"
    assert format_interval(0.01, 90.0, 40.0) == "0 to 90"


def unit_of(uncertainty: float, mcse: float) -> float:
    """The rule, written a second time: two digits of the uncertainty, none below the error."""
    size = exponent_at_two_digits(uncertainty)
    fine, coarse = 10.0 ** (size - 1), 10.0**size
    return fine if fine >= mcse else coarse


@given(finite, spread, st.floats(0.0, 1.0))
def test_the_last_digit_is_never_finer_than_the_rule_allows(mean, sd, part):
    shown_mean, shown_sd = read(format_value(mean, sd, part * sd))
    unit = unit_of(sd, part * sd * (1.0 - 1e-12))
    for shown, value in ((shown_mean, mean), (shown_sd, sd)):
        assert abs(shown - value) <= 0.5 * unit * (1.0 + 1e-6) + 1e-12 * abs(value)
        assert abs(shown / unit - round(shown / unit)) < 1e-6 * max(1.0, abs(shown / unit))
    assert shown_sd > 0.0


@given(finite, finite, spread, st.floats(0.0, 0.2), st.floats(0.0, 0.2))
def test_an_interval_holds_what_its_errors_allow(a, b, sd, first, second):
    lower, upper = sorted((a, b))
    errors = (first * sd, second * sd)
    shown = read_interval(format_interval(lower, upper, sd, errors))
    unit = max(unit_of(sd, e * (1.0 - 1e-12)) for e in errors)
    for value, end in zip(shown, (lower, upper), strict=True):
        assert abs(value - end) <= 0.5 * unit * (1.0 + 1e-6) + 1e-12 * abs(end)
    assert unit >= max(errors) * (1.0 - 1e-9) or unit > 0.1 * sd


@given(finite, spread, spread)
def test_digits_do_not_depend_on_the_unit(mean, sd, scale):
    """The same measurement in another unit, a power of ten apart, has the same digits."""
    assume(abs(mean) < 1e12 * sd)  # a double has no more digits
    power = round(math.log10(scale))
    there = format_value(*(float(Decimal(repr(v)).scaleb(power)) for v in (mean, sd)))
    here = format_value(mean, sd)
    digits = [
        [f"{Decimal(part):f}".replace(".", "").lstrip("-0").rstrip("0") for part in parts(text)]
        for text in (here, there)
    ]
    assert digits[0] == digits[1]


@given(finite, spread, st.floats(0.0, 1.0))
def test_machines_read_the_same_digits(mean, sd, part):
    shown, _ = read(format_value(mean, sd, part * sd))
    written = ascii_number(mean, last_place(sd, part * sd))
    assert written.isascii()
    assert float(written) == pytest.approx(shown, rel=1e-9, abs=1e-300)


def test_format_like_prints_what_the_source_would():
    assert format_like(1.99612, "1.996") == "1.996"
    assert format_like(3.3061e5, "3.306e5") == f"3.306{TIMES}10⁵"
    assert format_like(5.934e-10, "5.934e-10") == f"5.934{TIMES}10\N{SUPERSCRIPT MINUS}¹⁰"
    assert format_like(-0.00001, "0.01") == "0.00"
    assert format_like(float("nan"), "1.0") == NOTHING


def test_an_estimate_is_written_like_the_published_figure_beside_it():
    assert format_as_printed(1.99612, "1.996") == "1.996"
    assert format_as_printed(45_649_312.0, "3.306e5") == f"4.565{TIMES}10⁷"
    assert format_as_printed(0.000213, "0.05") == f"2.13{TIMES}10⁻⁴"
    assert format_as_printed(float("nan"), "0.05") == NOTHING


def test_numbers_for_machines():
    assert ascii_number(-1.6481, -3) == "-1.648"
    assert ascii_number(5.9e-10, -11) == "5.9e-10"
    assert ascii_number(330_600.0, 2) == "3.306e+05"
    assert ascii_number(1e-9, -3) == "0"
    assert ascii_number(float("nan"), -3) == ""


@pytest.mark.parametrize(
    ("value", "last", "expected"),
    [(9.7e7, 7, "1.0e+08"), (9.4e7, 7, "9e+07"), (9.7e-8, -8, "1.0e-07"), (97.0, 1, "100")],
)
def test_a_number_that_rounds_up_to_the_next_power_is_written_with_it(value, last, expected):
    assert ascii_text(format_at(value, last)) == expected
