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

from calib.report.reference import Figure, FittedTable

__all__ = ["DOI", "PUBLISHED", "Figure", "FittedTable", "Published", "Setup"]

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


_SIGN_OF_E = (
    "negative inferred: a positive value leaves no peak inside the tested slips at 30 and 42 psi"
)
_SIGN_OF_E_18 = (
    "negative inferred from the other pressures; at 18 psi the evidence is weak in Table 4, where "
    "the magnitude is small"
)


def _frozen(**figures: Figure) -> Mapping[str, Figure]:
    return MappingProxyType(figures)


def _magic(table: int, psi: int, *printed: str) -> FittedTable:
    B, C, D, E, cost = printed
    note = _SIGN_OF_E_18 if psi == 18 else _SIGN_OF_E
    return FittedTable(
        source=f"Table {table}, {psi} psi",
        model="Eqs 3-5 with Sh = Sv = 0, slip in percent, drawbar pull in kN",
        estimates=_frozen(
            B=Figure(B, "1/%"), C=Figure(C), D=Figure(D, "kN"), E=Figure(E, "1", note)
        ),
        quality=_frozen(cost=Figure(cost, "kN^2")),
        note="cost is Eq 10, the sum of squared errors over the 14 slips",
    )


_BULK_DENSITY = FittedTable(
    source="Table 1",
    model="Eq 1, density in g/cm^3, cone index in kPa, gravimetric water content in g/g",
    estimates=_frozen(
        C1=Figure(
            "5.934e-10", "kPa (g/cm^3)^-C4",
            "negative exponent inferred: e+10 gives densities of 0.6 to 0.7 g/cm^3",
        ),
        C2=Figure("0.022"),
        C3=Figure("0.609", "g/g", "positive taken; a negative sign is about as plausible"),
        C4=Figure("42.996"),
    ),
    quality=_frozen(
        r_squared=Figure("0.731"), rmse=Figure("0.0282", "g/cm^3"),
        max_relative_error=Figure("0.0294"),
    ),
    note="RMSE is taken as sqrt(SSE/(n - 4)); the number of samples is not printed",
)  # fmt: skip

_PRESSURE = FittedTable(
    source="Table 5",
    model="Eqs 12-15 in inflation pressure in psi, least squares of Eq 16 over 42 points",
    estimates=_frozen(
        c1=Figure("3.272", "kN"),
        c2=Figure("-0.107", "kN/psi", "negative inferred: D falls with pressure in Table 4"),
        c3=Figure("0.001", "kN/psi^2"),
        c4=Figure("0.267", "kN/%"),
        c5=Figure("-0.007", "kN/%/psi", "negative inferred: BCD falls with pressure in Table 4"),
        c6=Figure("0.0001", "kN/%/psi^2"),
        c7=Figure("0.963"),
        c8=Figure("-0.139", "1/psi", "negative inferred: E falls with pressure in Table 4"),
        c9=Figure(
            "-0.0025",
            "1/psi^2",
            "open; negative gives E nearer to Table 4, positive the pull (see `calib audit`)",
        ),
        b0=Figure("1.554"),
    ),
    quality=_frozen(cost=Figure("0.1050", "kN^2")),
    note=(
        "the nomenclature says kPa, but only psi reproduces D; too few digits are printed to "
        "evaluate it (D at 42 psi comes out 0.542 against 0.595 kN in Table 4)"
    ),
)

_RUT_DEPTH = FittedTable(
    source="Table 6",
    model="Eq 22, ln pgr = ln k + (n0 + n1 s) ln zt, fitted to 18 and 42 psi, slips to 20 %",
    estimates=_frozen(
        n0=Figure("1.996"),
        n1=Figure("1.266", "1", "positive inferred: ruts deepen with slip"),
        k=Figure("3.306e5", "kPa/m^n"),
    ),
    quality=_frozen(
        r_squared=Figure("0.630"), rmse=Figure("0.159"),
        max_relative_error=Figure("0.13"),
        most_below=Figure("0.10"),
        held_out_max_relative_error=Figure("0.097"),
        held_out_threshold=Figure("0.06"),
        held_out_above_threshold=Figure("2"),
    ),
    note="RMSE is of ln pgr, taken as sqrt(SSE/(n - 3)); relative errors are of rut depth, Eq 21",
)  # fmt: skip

PUBLISHED = Published(
    bulk_density=_BULK_DENSITY,
    geometric=MappingProxyType(
        {
            18: _magic(3, 18, "0.0540", "1.4743", "1.6397", "-15.1235", "0.1721"),
            30: _magic(3, 30, "0.0566", "1.5664", "1.0058", "-14.0852", "0.0220"),
            42: _magic(3, 42, "0.0943", "1.4476", "0.5740", "-13.1655", "0.0214"),
        }
    ),
    genetic=MappingProxyType(
        {
            18: _magic(4, 18, "0.0794", "1.5619", "1.6480", "-0.1026", "0.0485"),
            30: _magic(4, 30, "0.0713", "1.5685", "1.0071", "-6.0844", "0.0091"),
            42: _magic(4, 42, "0.1265", "1.4802", "0.5954", "-8.1747", "0.0083"),
        }
    ),
    pressure=_PRESSURE,
    rut_depth=_RUT_DEPTH,
    setup=Setup(),
)
