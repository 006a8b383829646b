import math

import numpy as np
import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.data.quantities import QUANTITIES, convert
from calib.errors import CalibError

REGISTRY = pint.UnitRegistry()
PAIRS = [
    (unit, quantity.unit) for quantity in QUANTITIES.values() for unit in quantity.units.values()
]


@given(pair=st.sampled_from(PAIRS), value=st.floats(-1e6, 1e6))
def test_conversion_agrees_with_pint_and_comes_back(pair: tuple[str, str], value: float) -> None:
    there = float(convert(value, *pair))
    reference = REGISTRY.Quantity(value, pair[0]).m_as(pair[1])
    assert math.isclose(there, reference, rel_tol=1e-12, abs_tol=1e-300)
    assert math.isclose(
        float(convert(there, *reversed(pair))), value, rel_tol=1e-12, abs_tol=1e-300
    )


@pytest.mark.parametrize(
    ("value", "unit", "expected", "canonical"),
    [
        (30.0, "psi", 206.842719, "kPa"),
        (1.0, "lbf", 0.0044482216, "kN"),
        (1.0, "kgf", 0.00980665, "kN"),
        (1.0, "inch", 25.4, "mm"),
        (1.65, "Mg/m**3", 1.65, "g/cm**3"),
        (100.0, "lb/ft**3", 1.601846, "g/cm**3"),
        (3.6, "km/h", 1.0, "m/s"),
    ],
)
def test_known_values(value: float, unit: str, expected: float, canonical: str) -> None:
    assert float(convert(value, unit, canonical)) == pytest.approx(expected, rel=1e-6)


@given(st.integers(-100, 100))
def test_percent_is_exact_to_the_last_bit(percent: int) -> None:
    assert float(convert(percent, "percent", "dimensionless")) == percent / 100


def test_conversion_copies_keeps_the_shape_and_nan() -> None:
    values = np.array([[1.0, np.nan]])
    same = convert(values, "kPa", "kPa")
    assert same is not values
    assert convert(values, "MPa", "kPa").tolist()[0][0] == 1000.0
    assert np.isnan(convert(values, "MPa", "kPa")[0, 1])


@pytest.mark.parametrize(
    ("units", "words"),
    [
        (("furlongz", "m"), ["unknown unit", "furlongz", "expected", "spelling"]),
        (("kPa", "kN"), ["cannot convert 'kPa' to 'kN'", "same dimension"]),
        (("degC", "kelvin"), ["their zeros differ", "absolute unit"]),
    ],
)
def test_impossible_conversions_say_so(units: tuple[str, str], words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        convert(1.0, *units)
    for word in words:
        assert word in str(caught.value)
