"""How a soil of a given density and water content resists a cone penetrometer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]

_SOLIDS_G_CM3 = 2.65


@dataclass(frozen=True)
class ConeLaw:
    """Cone resistance from the state of the soil relative to its critical state.

    Resistance grows exponentially as the void ratio falls below that of the critical state
    [1]_, times the mean effective stress, to which matric suction adds by Campbell's retention
    curve [2]_. The law is used backwards: from cone index and water content to density.

    Attributes
    ----------
    critical_void_ratio : float
        Void ratio at which the cone index is `reference_kpa` in nearly saturated soil.
    slope : float
        Fall of the void ratio per e-fold of the cone index.
    reference_kpa : float
        Cone index at the critical void ratio without suction.
    suction_share : float
        Suction's part of the mean effective stress at 5 % water, relative to the rest.
    retention : float
        Campbell's exponent b.

    References
    ----------
    .. [1] K. Been, M. G. Jefferies, Geotechnique 35 (1985) 99-112, doi 10.1680/geot.1985.35.2.99.
    .. [2] G. S. Campbell, Soil Science 117 (1974) 311-314.
    """

    critical_void_ratio: float
    slope: float
    reference_kpa: float
    suction_share: float
    retention: float

    def density(self, cone_index_kpa: Array, water_content: Array) -> Array:
        """Return the dry bulk density in g/cm^3, shape ``(N,)``."""
        water = np.maximum(water_content, 0.005)
        stress = 1.0 + self.suction_share * (0.05 / water) ** self.retention
        ratio = np.maximum(cone_index_kpa, 1.0) / (self.reference_kpa * stress)
        void = np.maximum(self.critical_void_ratio - self.slope * np.log(ratio), 0.15)
        return np.asarray(_SOLIDS_G_CM3 / (1.0 + void), dtype=np.float64)


def draw_cone_law(rng: np.random.Generator) -> ConeLaw:
    """Draw a sandy loam's cone law: void ratio 0.6-0.8, slope 0.05-0.16, weak to strong suction."""
    return ConeLaw(
        critical_void_ratio=float(rng.uniform(0.6, 0.8)),
        slope=float(rng.uniform(0.05, 0.16)),
        reference_kpa=float(np.exp(rng.uniform(np.log(250.0), np.log(700.0)))),
        suction_share=float(rng.uniform(0.3, 2.0)),
        retention=float(rng.uniform(0.7, 2.5)),
    )
