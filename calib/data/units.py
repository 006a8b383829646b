"""Unit conversion at the boundary: everything inside works in one unit per quantity."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import CalibError

if TYPE_CHECKING:
    import pint


@cache
def _registry() -> pint.UnitRegistry:
    # Building the registry takes longer than all else in this module, and data in canonical
    # units never need it.
    import pint

    return pint.UnitRegistry()


# The usual units in SI, by definition: pint takes longer to start than a diagnosis to draw. All
# others are asked of pint.
_POUND, _INCH, _GRAVITY = 0.45359237, 0.0254, 9.80665
_USUAL: Mapping[str, Mapping[str, float]] = {
    "pressure": {
        "Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "bar": 1e5, "psi": _POUND * _GRAVITY / _INCH**2,
    },
    "force": {"N": 1.0, "kN": 1e3, "lbf": _POUND * _GRAVITY, "kgf": _GRAVITY},
    "length": {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": _INCH},
    "ratio": {"dimensionless": 1.0, "percent": 1e-2},
    "density": {"g/cm**3": 1e3, "kg/m**3": 1.0},
    "speed": {"m/s": 1.0, "km/h": 1.0 / 3.6},
}  # fmt: skip


@cache
def _factor(from_unit: str, to_unit: str) -> float:
    """Return how many `to_unit` one `from_unit` is."""
    for si in _USUAL.values():
        if from_unit in si and to_unit in si:
            # Fifteen digits drop the last-bit noise of chained definitions (999.9999999999999).
            return float(f"{si[from_unit] / si[to_unit]:.15g}")
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
    return float(f"{one:.15g}")


def convert(values: ArrayLike, from_unit: str, to_unit: str) -> NDArray[np.float64]:
    """Convert values of any shape from one unit to another; NaN stays NaN.

    Units are in pint's spelling, such as ``"kPa"``, ``"g/cm**3"`` or ``"percent"``.

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
