"""What results have in a notebook: a table, a figure and a view, which `calib.report` makes."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class Shown:
    """A result that can be looked at."""

    __slots__ = ()

    def to_dataframe(self) -> DataFrame:
        """Return its numbers as a table, with units in the column names or a column of their own.

        Examples
        --------
        >>> import calib
        >>> plates = calib.load_he2019("rut_depth")
        >>> calibration = calib.calibrate(calib.build_problem("bekker", plates), seed=1)
        >>> list(calibration.to_dataframe().columns)[:3]
        ['unit', 'median', 'mean']
        """
        found: DataFrame = _views().frame(self)
        return found

    def plot(self) -> Figure:
        """Draw the one figure that shows it.

        Examples
        --------
        >>> import calib
        >>> plates = calib.load_he2019("rut_depth")
        >>> calibration = calib.calibrate(calib.build_problem("bekker", plates), seed=1)
        >>> calibration.plot().savefig("bands.png")  # doctest: +SKIP
        """
        figure: Figure = _views().figure(self)
        return figure

    def _repr_html_(self) -> str:
        html: str = _views().html(self)
        return html


def _views() -> Any:
    # Later rooms import this one.
    return import_module("calib.report.notebook")
