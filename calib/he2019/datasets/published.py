"""Every figure He, Sandu & Osorio (2019) print, as printed, frozen.

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
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from calib.he2019 import declared
from calib.report.reference import Figure, FittedTable

DOI = "10.1016/j.jterra.2019.07.003"


@dataclass(frozen=True)
class Setup:
    """The experiment as described, and the settings of the genetic algorithm.

    Pressures are keys in psi; lengths in mm, load in kN, slips as nominal fractions.
    """

    inflation_pressures_psi: tuple[int, ...] = (18, 30, 42)
    held_out_psi: int = 30
    tyre_width_mm: Figure = Figure("225", "mm")
    normal_load_kn: Figure = Figure("5", "kN")
    speed_m_s: Figure = Figure("0.06", "m/s")
    contact_width_mm: Figure = Figure("176", "mm")
    contact_length_mm: Mapping[int, Figure] = field(
        default_factory=lambda: MappingProxyType(
            {18: Figure("266.56", "mm"), 30: Figure("201.59", "mm"), 42: Figure("159.43", "mm")}
        )
    )
    slip_levels: Figure = Figure("14")
    named_slips: tuple[Figure, ...] = (Figure("0"), Figure("0.025"))
    largest_rut_slip: Figure = Figure("0.20")
    rebound_slip: Figure = Figure("0.30")
    largest_water_content: Figure = Figure("0.088", "g/g")
    genetic_settings: Mapping[str, Figure] = field(
        default_factory=lambda: MappingProxyType(
            {
                "F": Figure("0.4"), "CP": Figure("0.6"), "MP": Figure("0.1"),
                "mutation_low": Figure("0"), "mutation_high": Figure("1"),
                "NP": Figure("50"), "iterations": Figure("4000"),
            }
        )
    )  # fmt: skip


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


_PRINTED = declared("datasets/published.toml")


def _figures(printed: Mapping[str, list[str]]) -> Mapping[str, Figure]:
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


PUBLISHED = Published(
    bulk_density=_table(_PRINTED["bulk_density"]),
    geometric=_by_pressure(3, "geometric"),
    genetic=_by_pressure(4, "genetic"),
    pressure=_table(_PRINTED["pressure"]),
    rut_depth=_table(_PRINTED["rut_depth"]),
    setup=Setup(),
)
