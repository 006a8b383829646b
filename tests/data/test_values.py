"""What a model or simulator gives becomes plain numbers in its unit, or is refused."""

from __future__ import annotations

import array
import decimal
import fractions
from collections import deque

import numpy as np
import pint
import pytest

from calib.data.quantities import real_array
from calib.errors import CalibError

UNITS = pint.UnitRegistry()
NAN = np.nan


class Astropy:
    """A quantity as astropy has it: a value, a unit, and an array if it is asked for one."""

    def __init__(self, value: object, unit: str) -> None:
        self.value, self.unit = value, unit

    def __array__(self, *args: object, **kwargs: object) -> np.ndarray:
        return np.asarray(self.value)


class MaskedUnit(np.ma.MaskedArray):
    """A masked column with a unit, as tables of astropy have it."""

    unit = "N"


@pytest.mark.parametrize(
    ("given", "kn"),
    [
        ([1, 2.5], [1.0, 2.5]),
        (np.array([1.0, 2.0], ">f4"), [1.0, 2.0]),
        (np.array([1, 2], np.uint8), [1.0, 2.0]),
        (np.longdouble([1, 2]), [1.0, 2.0]),
        (np.longdouble("1e400"), np.inf),
        (np.array([[1.0, 2.0]]).view(np.matrix), [[1.0, 2.0]]),
        (np.ma.array([1.0, 2.0], mask=[False, True]), [1.0, NAN]),
        (np.ma.array([1, 0], mask=[False, True]), [1.0, NAN]),
        ([1.0, np.ma.masked], [1.0, NAN]),
        (np.ma.masked, NAN),
        (MaskedUnit([1.0, 2.0], mask=[False, True]), [0.001, NAN]),
        (np.array([1.0 + 0.0j, 2.0]), [1.0, 2.0]),
        (1.0 + 0.0j, 1.0),
        (np.array([complex(NAN, NAN), 2.0]), [NAN, 2.0]),
        (UNITS.Quantity([1500.0, 2.0], "N"), [1.5, 0.002]),
        ([UNITS.Quantity(1.0, "N"), UNITS.Quantity(1.0, "lbf")], [0.001, 0.0044482216152605]),
        (UNITS.Quantity(np.ma.array([1.0, 2.0], mask=[True, False]), "N"), [NAN, 0.002]),
        (Astropy(np.array([1.0, 2.0]), "N"), [0.001, 0.002]),
        (np.array([1.0, None], object), [1.0, NAN]),
        (decimal.Decimal("1.5"), 1.5),
        (fractions.Fraction(1, 4), 0.25),
        (array.array("d", [1.0, 2.0]), [1.0, 2.0]),
        (deque([1.0, 2.0]), [1.0, 2.0]),
        (range(2), [0.0, 1.0]),
        (["1.5", " -2e3", "1.5D3", "nan"], [1.5, -2000.0, 1500.0, NAN]),
    ],
)
def test_what_is_numbers_is_converted(given: object, kn: object) -> None:
    found = real_array(given, "kN")
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, kn, rtol=1e-14)


@pytest.mark.parametrize(
    ("given", "word"),
    [
        (None, "nothing (None)"),
        ([True, False], "bool"),
        (np.array([1.0, 2.0]) > 1.5, "bool"),
        (np.array([1.0 + 0.25j, 2.0]), "imaginary parts up to 0.25"),
        (UNITS.Quantity([1.0], "kPa"), "cannot convert"),
        (Astropy([1.0], "slug"), "cannot convert"),
        (Astropy([1.0], "horses of wood"), "unknown unit"),
        (Astropy([1.0], ""), "cannot convert 'dimensionless'"),
        (np.array(["2020-01-01"], "M8[D]"), "datetime64"),
        (np.array([3], "m8[s]"), "timedelta64"),
        ("1,5", "'1,5' is no number"),
        (["1_000"], "'1_000' is no number"),
        (["\u0661"], "is no number"),  # an Arabic digit, which `float` takes
        (b"1.5", "bytes"),
        ([[1.0, 2.0], [3.0]], "rows differ in length"),
        (10**400, "too large"),
        (np.array([10**400], object), "too large"),
        ({1.0, 2.0}, "set"),
        ({0: 1.0}, "dict"),
        ((x for x in [1.0]), "generator"),
        (np.zeros(2, [("pull", float)]), "pull"),
        (object(), "object"),
    ],
)
def test_what_is_not_is_refused(given: object, word: str) -> None:
    with pytest.raises(CalibError) as refused:
        real_array(given, "kN")
    assert word in refused.value.message
    assert "kN" in str(refused.value) or "real numbers" in str(refused.value)


def test_labelled_arrays_have_their_order_units_and_gaps() -> None:
    pandas = pytest.importorskip("pandas")
    xarray = pytest.importorskip("xarray")
    for given, kn in (
        (pandas.Series([1.0, 2.0]), [1.0, 2.0]),
        (pandas.Series([1, None], dtype="Int64"), [1.0, NAN]),
        (pandas.Series(UNITS.Quantity([1.0, 2.0], "N")[i] for i in range(2)), [0.001, 0.002]),
        (pandas.DataFrame([[1.0, 2.0]]), [[1.0, 2.0]]),
        (xarray.DataArray([1.0, 2.0], attrs={"units": "N"}), [0.001, 0.002]),
        (xarray.DataArray(UNITS.Quantity([1.0, 2.0], "N")), [0.001, 0.002]),
    ):
        np.testing.assert_allclose(real_array(given, "kN"), kn)
    # Sorted by something: the rows are no longer those of the conditions.
    for given in (
        pandas.Series([1.0, 2.0], index=[1, 0]),
        pandas.Series([1.0, 2.0], index=[0.1, 0.3]),
        pandas.DataFrame([[1.0, 2.0]], columns=[1, 0]),
        xarray.DataArray([1.0, 2.0], dims="slip", coords={"slip": [0.3, 0.1]}),
    ):
        with pytest.raises(CalibError, match="rows are labelled"):
            real_array(given, "kN")
    for given in (pandas.Series([True]), pandas.date_range("2020", periods=2), pandas.NaT):
        with pytest.raises(CalibError):
            real_array(given, "kN")


def test_a_buffer_that_is_used_again_is_copied() -> None:
    buffer = np.ones(2)
    found = real_array(buffer, "kN")
    buffer[:] = 7.0
    np.testing.assert_array_equal(found, [1.0, 1.0])
