"""The tyre of the tests: contact patch on firm ground and the arc that meets soft soil."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]

CONTACT_WIDTH_M = 0.176
PSI_KPA = 6.894757293168
REFERENCE_LOAD_KN = 5.0
_GAUGED_KPA = np.array([18.0, 30.0, 42.0]) * PSI_KPA
_LENGTH_M = np.array([0.26656, 0.20159, 0.15943])
# One parabola in ln-ln through the three measured lengths: smooth between and around them.
_LENGTH_FIT = np.polyfit(np.log(_GAUGED_KPA), np.log(_LENGTH_M), 2)
_LOAD_POWER = 0.4


@dataclass(frozen=True)
class Tyre:
    """A pneumatic tyre.

    Attributes
    ----------
    radius_m : float
        Unloaded radius.
    length_factor : float
        Contact length relative to the tyre that was measured (1 in the lab).
    """

    radius_m: float = 0.33
    length_factor: float = 1.0

    def contact_length(self, inflation_kpa: Array, load_kn: Array) -> Array:
        """Return the contact length in m, from static deflection tests at 18, 30 and 42 psi.

        He, Sandu, Osorio (2019), doi 10.1016/j.jterra.2019.07.003, at 5 kN; other loads by a
        power of 0.4, between the one half of a parabolic deflection and a stiffening carcass.
        """
        log_length = np.polyval(_LENGTH_FIT, np.log(inflation_kpa))
        length = np.exp(log_length) * (load_kn / REFERENCE_LOAD_KN) ** _LOAD_POWER
        return np.asarray(np.minimum(length * self.length_factor, 0.5), dtype=np.float64)


def average_ground_pressure(inflation_kpa: Array, load_kn: Array) -> Array:
    """Return load over contact area in kPa for the tyre of the tests, shape ``(N,)``."""
    length = Tyre().contact_length(inflation_kpa, load_kn)
    return np.asarray(load_kn / (CONTACT_WIDTH_M * length), dtype=np.float64)
