"""Numbers in a sentence."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.data.files import plain_number


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(1316.4, 3, "1320"), (150.0, 2, "150"), (999.7, 3, "1000"), (-12345.0, 4, "-12340"),
     (99_960.0, 3, "1e+05"), (99_940.0, 3, "99900"), (0.00123, 2, "0.0012"), (2.0e-6, 3, "2e-06"),
     (0.0, 3, "0"), (5.0, 3, "5"), (float("nan"), 3, "nan"), (float("-inf"), 3, "-inf")],
)  # fmt: skip
def test_a_number_in_a_sentence(value, digits, text):
    assert plain_number(value, digits) == text


@given(st.floats(1e-3, 99_000.0), st.integers(2, 5))
def test_no_exponent_where_digits_are_read_faster(value, digits):
    text = plain_number(value, digits)
    assert "e" not in text
    assert float(text) == pytest.approx(value, rel=0.51 * 10.0 ** (1 - digits))
