"""Unit conversion at the boundary: everything inside works in one unit per quantity."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import CalibError

if TYPE_CHECKING:
    import pint

__all__ = ["convert"]


@cache
def _registry() -> pint.UnitRegistry:
    # Building the registry takes longer than all else in this module, and data in canonical
    # units never need it.
    import pint

    return pint.UnitRegistry()


@cache
def _factor(from_unit: str, to_unit: str) -> float:
    """Return how many `to_unit` one `from_unit` is."""
    import pint

    registry = _registry()
    try:
        one, zero = (float(registry.Quantity(x, from_unit).m_as(to_unit)) for x in (1.0, 0.0))
    except (pint.UndefinedUnitError, pint.DefinitionSyntaxError) as error:
        raise CalibError(
            f"unknown unit in the conversion from {from_unit!r} to {to_unit!r} ({error})",
            allowed="units known to pint, such as kPa, psi, kN, mm, g/cm**3, percent",
            mend="correct the spelling of the unit",
        ) from None
    except pint.DimensionalityError as error:
        raise CalibError(
            f"cannot convert {from_unit!r} to {to_unit!r}: {error}",
            allowed="two units of the same dimension",
            mend="use a unit that measures the same quantity",
        ) from None
    if zero != 0.0:
        raise CalibError(
            f"cannot convert {from_unit!r} to {to_unit!r}: their zeros differ",
            allowed="units that differ by a factor only",
            mend="use an absolute unit",
        )
    # Fifteen digits drop the last-bit noise of chained definitions (999.9999999999999).
    return float(f"{one:.15g}")


def convert(values: ArrayLike, from_unit: str, to_unit: str) -> NDArray[np.float64]:
    """Convert values from one unit to another.

    Parameters
    ----------
    values : array_like, any shape
        Values in `from_unit`.
    from_unit, to_unit : str
        Units in pint's spelling, such as ``"kPa"``, ``"g/cm**3"`` or ``"percent"``.

    Returns
    -------
    ndarray of float64, same shape
        New array in `to_unit`; NaN stays NaN.

    Raises
    ------
    CalibError
        If a unit is unknown, the dimensions differ or the units have different zeros.
    """
    array = np.array(values, dtype=np.float64)
    if from_unit == to_unit:
        return array
    factor = _factor(from_unit, to_unit)
    if factor >= 1.0:
        return np.asarray(array * factor)
    # 57 percent is 57/100 = 0.57 to the last bit; 57 * 0.01 is not.
    return np.asarray(array / _factor(to_unit, from_unit))
