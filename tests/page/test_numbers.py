"""Numbers in the precision that their uncertainty warrants."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.page.numbers import (
    NOTHING,
    TIMES,
    format_interval,
    format_like,
    format_number,
    format_value,
)

MINUS = "\N{MINUS SIGN}"
SUPER = str.maketrans("\N{SUPERSCRIPT MINUS}⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
finite = st.floats(-1e9, 1e9, allow_nan=False)
spread = st.floats(1e-9, 1e9, allow_nan=False)


def read(text: str) -> list[float]:
    """Read numbers back from a formatted text."""
    body, _, power = text.replace(MINUS, "-").partition(f"{TIMES}10")
    scale = 10.0 ** int(power.translate(SUPER)) if power else 1.0
    return [float(t) * scale for t in re.split(r" ± | to ", body.strip("()"))]


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


@given(finite, spread)
def test_no_more_is_lost_than_the_sd_allows(mean, sd):
    shown_mean, shown_sd = read(format_value(mean, sd))
    unit = 10.0 ** (math.floor(math.log10(float(f"{sd:.1e}"))) - 1)
    slack = 1.0 + 1e-6
    assert abs(shown_mean - mean) <= 0.5 * unit * slack + 1e-12 * abs(mean)
    assert abs(shown_sd - sd) <= 0.5 * unit * slack
    assert float(f"{sd:.1e}") == pytest.approx(shown_sd, rel=0.06)


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


def test_format_like_prints_what_the_source_would():
    assert format_like(1.99612, "1.996") == "1.996"
    assert format_like(3.3061e5, "3.306e5") == f"3.306{TIMES}10⁵"
    assert format_like(5.934e-10, "5.934e-10") == f"5.934{TIMES}10\N{SUPERSCRIPT MINUS}¹⁰"
    assert format_like(-0.00001, "0.01") == "0.00"
    assert format_like(float("nan"), "1.0") == NOTHING
