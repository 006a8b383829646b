"""Tables as a user might bring them."""

from __future__ import annotations

import numpy as np

from calib.data import Table, table_from_arrays
from calib.data.quantities import OUTPUTS


def table(source: str = "my.csv", **columns) -> Table:
    return table_from_arrays(columns, source=source, allow_missing=tuple(OUTPUTS.values()))


def pulls(psi=(18.0, 30.0, 42.0), n: int = 8, source: str = "my.csv", scale: float = 0.6) -> Table:
    slip = np.tile(np.linspace(0.0, 0.6, n), len(psi))
    pressure = np.repeat(psi, n)
    rng = np.random.default_rng(1)
    pull = scale * np.sin(1.5 * np.arctan(12 * slip)) * (60 - pressure) / 30
    pull += 0.01 * rng.standard_normal(slip.size)
    return table(source, slip_ratio=slip, inflation_pressure_psi=pressure, drawbar_pull_kn=pull)
