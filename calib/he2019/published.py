"""Every figure He, Sandu & Osorio (2019) print, as printed, and those that stand beside a result.

A `Figure` keeps the printed text, because a comparison "to the printed digits" needs to know how
many were printed. The text of the source reached us without its minus signs: where a sign was
inferred, the note says from what.

References
----------
He, R., Sandu, C., Osorio, J. (2019). Systematic tests for study of tire tractive performance on
soft soil: Part II - Parameterization of terramechanics model and tire model. Journal of
Terramechanics. doi:10.1016/j.jterra.2019.07.003.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from calib.he2019 import declared
from calib.models.base import Array, BoundModel
from calib.models.magic_formula import magic_formula
from calib.models.soil import bulk_density, rut_depth
from calib.report.reference import Figure, FittedTable, Limit, Reference

LABEL = "reconstructed"
DOI = "10.1016/j.jterra.2019.07.003"


@dataclass(frozen=True)
class Setup:
    """The experiment, by psi, mm, kN and nominal slip fractions, and Table 2's settings."""

    inflation_pressures_psi: tuple[int, ...]
    held_out_psi: int
    named_slips: tuple[Figure, ...]
    contact_length_mm: Mapping[int, Figure]
    genetic_settings: Mapping[str, Figure]
    tyre_width_mm: Figure
    normal_load_kn: Figure
    speed_m_s: Figure
    contact_width_mm: Figure
    slip_levels: Figure
    largest_rut_slip: Figure
    rebound_slip: Figure
    largest_water_content: Figure


@dataclass(frozen=True)
class Published:
    """All published figures: Tables 1 to 6, those of several pressures one for each, by psi."""

    bulk_density: FittedTable
    geometric: Mapping[int, FittedTable]
    genetic: Mapping[int, FittedTable]
    pressure: FittedTable
    rut_depth: FittedTable
    setup: Setup

    def __reduce__(self) -> str | tuple[Any, ...]:
        # By its name: another process knows it, and mapping proxies do not travel.
        return "PUBLISHED" if self is PUBLISHED else super().__reduce__()


_PRINTED = declared("published.toml")


def _figures[K](printed: Mapping[K, list[str]]) -> Mapping[K, Figure]:
    return MappingProxyType({name: Figure(*figure) for name, figure in printed.items()})


def _table(printed: Mapping[str, Any]) -> FittedTable:
    estimates, quality = _figures(printed["estimates"]), _figures(printed["quality"])
    return FittedTable(printed["source"], printed["model"], estimates, quality, printed["note"])


def _by_pressure(number: int, method: str) -> Mapping[int, FittedTable]:
    printed = _PRINTED["magic_formula"]
    tables = {}
    for psi, texts in printed[method].items():
        *estimates, cost = ([t, unit] for t, unit in zip(texts, printed["units"], strict=True))
        estimates[3].append(printed["sign_of_E"][psi])
        named = {"estimates": dict(zip("BCDE", estimates, strict=True)), "quality": {"cost": cost}}
        tables[int(psi)] = _table({**printed, "source": f"Table {number}, {psi} psi", **named})
    return MappingProxyType(tables)


def _setup(printed: Mapping[str, Any]) -> Setup:
    lengths = _figures(printed["contact_length_mm"])
    return Setup(
        tuple(map(int, lengths)), printed["held_out_psi"],
        tuple(map(Figure, printed["named_slips"])),
        MappingProxyType({int(psi): length for psi, length in lengths.items()}),
        _figures(printed["genetic_settings"]), **_figures(printed["figures"]),
    )  # fmt: skip


PUBLISHED = Published(
    bulk_density=_table(_PRINTED["bulk_density"]),
    geometric=_by_pressure(3, "geometric"),
    genetic=_by_pressure(4, "genetic"),
    pressure=_table(_PRINTED["pressure"]),
    rut_depth=_table(_PRINTED["rut_depth"]),
    setup=_setup(_PRINTED["setup"]),
)


class _He2019(Reference):
    """The tables of He, Sandu & Osorio (2019)."""

    label = LABEL
    alone: ClassVar[Mapping[str, Mapping[int, FittedTable]]] = {
        "geometric": PUBLISHED.geometric,
        "genetic": PUBLISHED.genetic,
    }

    def table(self, model: str) -> FittedTable | None:
        """Return the published table of a model, if there is one."""
        own = {
            "ayers_perumpral": PUBLISHED.bulk_density,
            "magic_formula_pressure": PUBLISHED.pressure,
            "modified_bekker": PUBLISHED.rut_depth,
        }
        return own.get(model)

    def quality(self, model: str) -> Mapping[str, Figure]:
        """Return the published goodness of fit; Table 6 gives that of ln pgr, ours is of ln z."""
        table = self.table(model)
        return {} if table is None or model == "modified_bekker" else table.quality

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
            bend = 1.0 - mid[i] / mean
            found |= {f"{name}_lo": low[i], f"{name}_hi": high[i], f"{name}_bend": bend}
        return {name: value for name, value in found.items() if name in bound.model.parameters}

    def limits(self, model: str) -> tuple[Limit, ...]:
        """Return the largest relative errors that the source states, and on what."""
        if model == "ayers_perumpral":
            return ((PUBLISHED.bulk_density.quality["max_relative_error"].value, "source, fitted"),)
        if model == "modified_bekker":
            quality = PUBLISHED.rut_depth.quality
            held_out = quality["held_out_max_relative_error"].value, "source, held out"
            return (quality["max_relative_error"].value, "source, fitted"), held_out
        return ()


def _slope_peak_curvature(psi: float) -> tuple[float, float, float] | None:
    """K = BCD, D and G = 1 - E of Table 4."""
    table = PUBLISHED.genetic.get(round(psi))
    if table is None or abs(psi - round(psi)) > 1e-6:
        return None
    v = table.values
    return v["B"] * v["C"] * v["D"], v["D"], 1.0 - v["E"]


HE2019 = _He2019()
