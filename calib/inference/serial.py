"""Normal noise that is correlated along a run, in closed form.

With z_i the noise over its scale, of sd 1 at every row, readings that are k apart in a run have the
correlation rho^k: an autoregression of order one, of which rows may be missing. Different runs are
independent. Each row depends on the others through its two neighbours alone.

References
----------
Box, Jenkins & Reinsel (2008), Time Series Analysis, section 3.2. Leaving out one row of a normal
vector: Bürkner, Gabry & Vehtari (2021), doi:10.1007/s00180-020-01045-4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.errors import CalibError
from calib.inference.noise import Along
from calib.models.base import Array

__all__ = ["Serial", "serial_of"]

# Lines that are named.
_SHOWN = 8


@dataclass(frozen=True)
class Serial:
    """Rows in the order in which they were measured.

    Parameters
    ----------
    order : ndarray of int, shape (n,)
        Rows of the table, run by run.
    gap : ndarray, shape (n,)
        How far each of these is from the one before; infinite for the first of a run.
    """

    order: NDArray[np.intp]
    gap: Array

    def before(self, z: Array, rho: Array) -> tuple[Array, Array]:
        """Mean and variance of each row given those before it, (k, n), in the rows' order.

        Parameters
        ----------
        z : ndarray, shape (k, n)
        rho : ndarray, shape (k, 1)
        """
        r, along = self._correlations(rho), z[:, self.order]
        mean = np.zeros_like(along)
        mean[:, 1:] = r[:, 1:] * along[:, :-1]
        return self._back(mean), self._back(1.0 - r * r)

    def given_all_others(self, z: Array, rho: Array) -> tuple[Array, Array]:
        """Mean and variance of each row given all others, (k, n), in the rows' order."""
        r, along = self._correlations(rho), z[:, self.order]
        after = np.column_stack([r[:, 1:], np.zeros(len(r))])
        left, right = 1.0 - r * r, 1.0 - after * after
        precision = 1.0 / left + after * after / right
        mean = np.zeros_like(along)
        mean[:, 1:] += (r / left)[:, 1:] * along[:, :-1]
        mean[:, :-1] += (after / right)[:, :-1] * along[:, 1:]
        return self._back(mean / precision), self._back(1.0 / precision)

    def correlate(self, z: Array, rho: Array) -> Array:
        """Turn independent standard normals (k, n) into noise that is correlated."""
        r, along = self._correlations(rho), z[:, self.order]
        for i in range(1, along.shape[1]):
            own = np.sqrt(1.0 - r[:, i] ** 2)
            along[:, i] = r[:, i] * along[:, i - 1] + own * along[:, i]
        return self._back(along)

    def _correlations(self, rho: Array) -> Array:
        """Correlation of each row with the one before, (k, n)."""
        return np.asarray(rho**self.gap)

    def _back(self, along: Array) -> Array:
        out = np.empty_like(along)
        out[:, self.order] = along
        return out


def serial_of(along: Along, table: Table) -> Serial | None:
    """Return the order of a table's rows; None where they are independent.

    Parameters
    ----------
    along : {"", "run_order"}
        That column, in each ``run`` by itself where the table has this one. Rows that are missing
        leave a gap.
    table : Table

    Raises
    ------
    CalibError
        If there is no such column, or it does not say the order.
    """
    if not along:
        return None
    if along not in table:
        raise CalibError(
            f"the noise is to be correlated along {along}, a column that is not there",
            where=table.source, allowed=f"a column {along}",
            mend="add the column, with whole numbers in the order of the measurement",
        )  # fmt: skip
    place, n = table[along], len(table)
    run = table["run"] if "run" in table else np.zeros(n)
    order = np.lexsort((place, run)).astype(np.intp)
    gap = np.full(n, np.inf)
    gap[1:] = np.where(np.diff(run[order]) == 0.0, np.diff(place[order]), np.inf)
    # An empty cell is neither.
    wrong = np.flatnonzero(~(gap >= 1.0))
    if wrong.size:
        lines = sorted(table.lines[row] for row in order[np.union1d(wrong, wrong - 1)])
        raise CalibError(
            f"{table.header_of(along)} does not say in which order the rows of a run were "
            f"measured: see line{'s' if len(lines) > 1 else ''} "
            f"{', '.join(map(str, lines[:_SHOWN]))}"
            f"{' and others' if len(lines) > _SHOWN else ''}",
            where=table.source,
            allowed="a whole number in every row, another one for each row of a run",
            mend="number the rows of each run as they were measured, and label the runs (run)",
        )  # fmt: skip
    return Serial(order, gap)
