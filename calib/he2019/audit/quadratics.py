"""How near Table 5's printed digits can bring a quadratic in pressure to Table 4.

All coefficients that print as c, c' and c'' form a box, and the quadratic is linear in them: the
smallest possible largest relative deviation from Table 4 at its pressures is a linear programme,
solved exactly. A reading (of signs, of the unit of pressure) under which even the best
coefficients of the box are far from Table 4 cannot be what the source fitted.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from calib.he2019.datasets.published import Published
from calib.models.base import Array

type Signs = tuple[int, int, int]

NAMES: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {"D": ("c1", "c2", "c3"), "BCD": ("c4", "c5", "c6"), "E": ("c7", "c8", "c9")}
)


class Nearest(NamedTuple):
    """The best a box of coefficients can do.

    The smallest possible largest relative deviation over the pressures, the coefficients (3,) that
    reach it, and the quadratic there (m,).
    """

    deviation: float
    coefficients: Array
    values: Array


def targets(published: Published, what: str) -> tuple[Array, Array]:
    """Return the pressures of Table 4 (psi) and its D (kN), BCD (kN/%) or E at them."""
    tables = published.genetic
    values = [t.values for t in tables.values()]
    read = {
        "D": [v["D"] for v in values],
        "BCD": [v["B"] * v["C"] * v["D"] for v in values],
        "E": [v["E"] for v in values],
    }
    return np.array([float(psi) for psi in tables]), np.array(read[what])


def printed_signs(published: Published, what: str) -> Signs:
    """Return the signs of a quadratic's coefficients as they are read."""
    a, b, c = (int(np.sign(published.pressure.estimates[n].value)) for n in NAMES[what])
    return a, b, c


def nearest(
    published: Published, what: str, *, signs: Signs | None = None, psi_per_unit: float = 1.0
) -> Nearest:
    """Return the best that coefficients of D, BCD or E printed as in Table 5 can do.

    Signs are as they are read by default; pressure enters in units of so many psi.
    """
    figures = [published.pressure.estimates[name] for name in NAMES[what]]
    read = signs or printed_signs(published, what)
    middle = [sign * abs(f.value) for sign, f in zip(read, figures, strict=True)]
    pressures, wanted = targets(published, what)
    powers = np.vander(pressures / psi_per_unit, 3, increasing=True)
    scaled = powers / np.abs(wanted)[:, None]
    ones, sign = np.ones((pressures.size, 1)), np.sign(wanted)
    found = linprog(
        [0.0, 0.0, 0.0, 1.0],
        A_ub=np.block([[scaled, -ones], [-scaled, -ones]]),
        b_ub=np.concatenate([sign, -sign]),
        bounds=[
            *((m - f.half_unit, m + f.half_unit) for m, f in zip(middle, figures, strict=True)),
            (0.0, None),
        ],
    )
    if found.x is None:  # the largest deviation is free to grow, so this cannot happen
        raise RuntimeError(f"the linear programme failed: {found.message}")
    coefficients = np.asarray(found.x[:3])
    return Nearest(float(found.x[3]), coefficients, np.asarray(powers @ coefficients))


def nearest_by_signs(
    published: Published, what: str, *, psi_per_unit: float = 1.0
) -> dict[Signs, Nearest]:
    """Return the best for each of the eight readings of three signs."""
    readings = list(product((1, -1), repeat=3))
    return {
        (a, b, c): nearest(published, what, signs=(a, b, c), psi_per_unit=psi_per_unit)
        for a, b, c in readings
    }
