"""What a curve would cost on data that nobody printed.

The data y of one pressure are not printed, but Table 4 prints a curve f and its cost |y - f|^2.
Any other curve g at a distance d = g - f from it therefore costs

    (|d| - r)^2 <= |y - g|^2 <= (|d| + r)^2,      r^2 = |y - f|^2,

whatever the data (the triangle inequality). If f is their least-squares optimum, the residuals are
orthogonal to the derivatives of f, and only the part d' of d that these do not span matters:

    |d|^2 + r^2 - 2 r |d'| <= |y - g|^2 <= |d|^2 + r^2 + 2 r |d'|.

Both need the slips of the tests, which are assumed; neither needs the pulls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.he2019.datasets.drawbar import NOMINAL_SLIPS, SLIP_SHIFT, magic_formula_jacobian
from calib.he2019.datasets.published import Published
from calib.he2019.datasets.reconstruct import normalised_basis
from calib.models.base import Array
from calib.models.magic_formula import magic_formula, sine_of
from calib.report.reference import FittedTable

ASSUMED_SLIPS = 100.0 * (np.array(NOMINAL_SLIPS) + SLIP_SHIFT)
"""Slips in percent at which the 14 tests of each pressure are assumed."""


COEFFICIENTS = ("c1", "c2", "c3", "c4", "c5", "c6", "c7", "c8", "c9", "b0")
"""Of Eqs 12-15, in the order of every array of them here."""


@dataclass(frozen=True, eq=False)
class Reference:
    """A published curve of one pressure and what is known of the data about it.

    Parameters
    ----------
    curve : ndarray, shape (n,)
        Table 4 at the slips, kN.
    span : ndarray, shape (n, 4)
        Orthonormal basis of its derivatives.
    cost : float
        Its cost, kN^2.
    """

    psi: int
    curve: Array
    span: Array
    cost: float

    def bounds(self, pull: Array, *, optimal: bool) -> tuple[Array, Array]:
        """Return the least and the largest cost of curves (k, n), each of shape (k,).

        `optimal` takes Table 4 for the least-squares optimum of the data.
        """
        apart = pull - self.curve
        squared = np.einsum("kn,kn->k", apart, apart)
        r = np.sqrt(self.cost)
        if not optimal:
            return (np.sqrt(squared) - r) ** 2, (np.sqrt(squared) + r) ** 2
        inside = apart @ self.span
        beyond = np.sqrt(np.maximum(squared - np.einsum("kj,kj->k", inside, inside), 0.0))
        least = squared + self.cost - 2.0 * r * beyond
        return least, least + 4.0 * r * beyond


def references(published: Published, slips: Array = ASSUMED_SLIPS) -> tuple[Reference, ...]:
    """Return Table 4, pressure by pressure, at some slips (percent)."""
    return tuple(_reference(psi, table, slips) for psi, table in published.genetic.items())


def _reference(psi: int, table: FittedTable, slips: Array) -> Reference:
    jacobian = magic_formula_jacobian(slips, **table.values)
    return Reference(
        psi,
        magic_formula(slips, **table.values),
        normalised_basis(jacobian),
        table.quality["cost"].value,
    )


def printed_coefficients(published: Published) -> Array:
    """Return Table 5 as printed, shape (10,)."""
    return np.array([published.pressure.estimates[name].value for name in COEFFICIENTS])


def pressure_curves(coefficients: Array, pressures: Array, slips: Array) -> Array:
    """Evaluate Eqs 3-5 and 12-15 with c1 to c9 and b0, shape (k, 10), as they are printed.

    Pressures (m,) in psi and slips (n,) in percent give pulls (k, m, n) in kN; infinite where K or
    D is not positive.
    """
    powers = np.vander(pressures, 3, increasing=True)
    D, K, E = (np.asarray(coefficients[:, j : j + 3] @ powers.T)[:, :, None] for j in (0, 3, 6))
    C = coefficients[:, 9, None, None]
    with np.errstate(all="ignore"):
        pull: Array = D * sine_of(K / (C * D) * slips, C, 1.0 - E)
    # Only a positive K and D have a sense; what is not finite has none either.
    pull[~((D > 0.0) & (K > 0.0) & np.isfinite(pull))] = np.inf
    return pull


def joint_bounds(
    coefficients: Array, known: tuple[Reference, ...], slips: Array, *, optimal: bool
) -> tuple[Array, Array]:
    """Return the least and largest total cost (Eq 16) of c1 to c9 and b0, shape (k, 10) to (k,).

    Infinite where the formula has no value; `optimal` as for `Reference.bounds`.
    """
    pressures = np.array([float(r.psi) for r in known])
    pull = pressure_curves(coefficients, pressures, slips)
    fine = np.isfinite(pull).all(axis=(1, 2))
    least, largest = (np.full(pull.shape[0], np.inf) for _ in range(2))
    if fine.any():
        each = [r.bounds(pull[fine, i], optimal=optimal) for i, r in enumerate(known)]
        least[fine] = sum(low for low, _ in each)
        largest[fine] = sum(high for _, high in each)
    return least, largest
