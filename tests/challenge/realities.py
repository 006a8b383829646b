"""Shared realities."""

from __future__ import annotations

import numpy as np

from challenge.density import ConeLaw
from challenge.mechanics import Reality
from challenge.mechanism import Conditions
from challenge.soil import Soil
from challenge.tyre import Tyre


def sandy_loam(**changes: float) -> Soil:
    """Return a fixed soil that sinks under slip."""
    base: dict[str, float] = {
        "cohesion_kpa": 4.0,
        "tan_friction": 0.3,
        "shear_modulus_m": 0.008,
        "cohesive_bearing": 60.0,
        "frictional_bearing_kpa": 900.0,
        "exponent": 1.0,
        "slip_flow": 1.0,
        "slip_dig": 0.2,
    }
    return Soil(**(base | changes))  # type: ignore[arg-type]


def reality(**changes: float) -> Reality:
    """Return a fixed undisturbed reality."""
    return Reality(sandy_loam(**changes), Tyre(), ConeLaw(0.7, 0.1, 400.0, 1.0, 1.5))


def conditions(n: int = 12, **changes: float | np.ndarray) -> Conditions:
    """Return a slip sweep at 30 psi, 5 kN, with chosen conditions changed."""
    base: dict[str, object] = {
        "run_order": np.arange(n, dtype=float),
        "slip": np.linspace(0.0, 0.7, n),
        "inflation_kpa": 206.843,
        "load_kn": 5.0,
        "speed_m_s": 0.06,
        "pass_number": 1.0,
        "water_content": 0.05,
        "cone_index_kpa": 600.0,
    }
    filled = {
        name: np.broadcast_to(np.asarray(v, dtype=float), (n,)).copy()
        for name, v in (base | changes).items()
    }
    return Conditions(**filled)
