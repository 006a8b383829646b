"""The published figures that belong beside a result: parameters, curves and stated limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from calib.he2019.datasets.embedded import LABEL
from calib.he2019.datasets.published import PUBLISHED
from calib.models.ayers_perumpral import bulk_density
from calib.models.base import Array, BoundModel
from calib.models.bekker import rut_depth
from calib.models.magic_formula import magic_formula
from calib.report.reference import Figure, FittedTable, Limit, Reference

_TABLES = {
    "ayers_perumpral": PUBLISHED.bulk_density,
    "magic_formula_pressure": PUBLISHED.pressure,
    "modified_bekker": PUBLISHED.rut_depth,
}


class _He2019(Reference):
    """The tables of He, Sandu & Osorio (2019)."""

    label = LABEL
    alone: ClassVar[Mapping[str, Mapping[int, FittedTable]]] = {
        "geometric": PUBLISHED.geometric,
        "genetic": PUBLISHED.genetic,
    }

    def table(self, model: str) -> FittedTable | None:
        """Return the published table of a model, if there is one."""
        return _TABLES.get(model)

    def quality(self, model: str) -> Mapping[str, Figure]:
        """Return the published goodness of fit that can stand beside ours; empty where none can.

        Table 6 gives that of ln pgr, the pressure regressed on the rut; ours is of ln z.
        """
        return {} if model not in _TABLES or model == "modified_bekker" else _TABLES[model].quality

    def curve(self, model: str, conditions: Mapping[str, Array]) -> tuple[Array, str] | None:
        """Return the published fit at given conditions, and the table it follows from.

        For drawbar pull this is Table 4, pressure by pressure: Table 5 prints too few digits to be
        evaluated. None where a condition was not fitted by the source.
        """
        values = {name: figure.value for name, figure in self.parameters(model).items()}
        if model == "ayers_perumpral":
            ci, water = conditions["cone_index_kpa"], conditions["gravimetric_water_content"]
            density = bulk_density(ci, water, *(values[c] for c in ("C1", "C2", "C3", "C4")))
            return density, "Table 1"
        if model == "modified_bekker":
            pressure, slip = conditions["average_ground_pressure_kpa"], conditions["slip_ratio"]
            depth = rut_depth(pressure, slip, values["k"], values["n0"], values["n1"])
            return 1000.0 * depth, "Table 6"
        if model == "magic_formula_pressure":
            pressure = conditions["inflation_pressure_psi"]
            pull = np.full(pressure.shape, np.nan)
            for psi, table in PUBLISHED.genetic.items():
                here = np.isclose(pressure, psi)
                pull[here] = magic_formula(100.0 * conditions["slip_ratio"][here], **table.values)
            return None if np.isnan(pull).any() else (pull, "Table 4")
        return None

    def sampled(self, bound: BoundModel) -> dict[str, float]:
        """Return the sampled parameters that the published figures amount to."""
        model = bound.model.name
        if model in ("ayers_perumpral", "modified_bekker"):
            values = {k: figure.value for k, figure in self.parameters(model).items()}
            return dict(zip(bound.model.parameters, bound.theta(values).tolist(), strict=True))
        if model != "magic_formula_pressure":
            return {}
        middle, half = bound.references["p_mid_psi"], bound.references["p_half_psi"]
        low, mid, high = (_slope_peak_curvature(p) for p in (middle - half, middle, middle + half))
        if low is None or mid is None or high is None:
            return {}
        found: dict[str, float] = {}
        for i, name in enumerate("KDG"):
            mean = 0.5 * (low[i] + high[i])
            found |= {
                f"{name}_lo": low[i],
                f"{name}_hi": high[i],
                f"{name}_bend": 1.0 - mid[i] / mean,
            }
        return {name: value for name, value in found.items() if name in bound.model.parameters}

    def limits(self, model: str) -> tuple[Limit, ...]:
        """Return the largest relative errors that the source states, and on what."""
        if model == "ayers_perumpral":
            return ((PUBLISHED.bulk_density.quality["max_relative_error"].value, "source, fitted"),)
        if model == "modified_bekker":
            quality = PUBLISHED.rut_depth.quality
            return (
                (quality["max_relative_error"].value, "source, fitted"),
                (quality["held_out_max_relative_error"].value, "source, held out"),
            )
        return ()


def _slope_peak_curvature(psi: float) -> tuple[float, float, float] | None:
    """K = BCD, D and G = 1 - E of Table 4."""
    table = PUBLISHED.genetic.get(round(psi))
    if table is None or abs(psi - round(psi)) > 1e-6:
        return None
    v = table.values
    return v["B"] * v["C"] * v["D"], v["D"], 1.0 - v["E"]


HE2019 = _He2019()
