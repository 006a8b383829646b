"""Table 1, bulk density: the exponent of C1, the sign of C3, the unit of cone index, the quality.

Eq 1, density = {(CI/C1) [C2 + (theta - C3)^2]}^(1/C4), has every coefficient once, so its extremes
over all that print alike are those of interval arithmetic.
"""

from __future__ import annotations

import numpy as np

from calib.he2019.audit.bounds import Interval, exact, exp, log, printed, root_of_rest, square
from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    beside_rival,
    between,
    consistent_if,
    finding,
    rounded,
)
from calib.he2019.published import Published

# Cone indices of soils that carry a wheel but let it sink, kPa.
_CONE_INDEX = Interval(np.array(100.0), np.array(3000.0))
# Dry bulk density of mineral soils, g/cm^3: 1.0 to 1.9 (Brady & Weil 2016, The Nature and
# Properties of Soils), with a tenth to either side.
_MINERAL = 0.9, 2.0


def density_range(
    published: Published, *, exponent: int = 1, C3_sign: int = 1, cone_index: Interval = _CONE_INDEX
) -> Interval:
    """Return the densities (g/cm^3) that Table 1 gives over the tested water contents.

    1 takes the exponent of C1, or C3, with the sign that it is read with, -1 with the other; cone
    index is in the unit of Eq 1.
    """
    figures = published.bulk_density.estimates
    C1, C2, C3, C4 = (printed(figures[name]) for name in ("C1", "C2", "C3", "C4"))
    if exponent < 0:
        mantissa = exact(10.0 ** np.floor(np.log10(figures["C1"].value)))
        C1 = C1 / mantissa / mantissa
    if C3_sign < 0:
        C3 = -C3
    largest = published.setup.largest_water_content
    water = Interval(np.array(0.0), np.array(largest.value + largest.half_unit))
    return exp((log(cone_index) - log(C1) + log(C2 + square(water - C3))) / C4)


def density_findings(published: Published) -> list[Finding]:
    """Judge Table 1."""
    return [
        _exponent(published), _sign_of_C3(published), _unit(published), _quality(published),
        finding("table1_values", Verdict.UNTESTABLE),
    ]  # fmt: skip


def _mineral(density: Interval) -> bool:
    low, high = _MINERAL
    return bool(density.lower >= low and density.upper <= high)


def _density(name: str, density: Interval) -> Quantity:
    ends = float(density.lower), float(density.upper)
    return between(name, *ends, "g/cm^3", "over conditions and rounding")


def _exponent(published: Published) -> Finding:
    figure = published.bulk_density.estimates["C1"]
    read, other = density_range(published), density_range(published, exponent=-1)
    verdict = beside_rival(_mineral(read), _mineral(other))
    wrong = other if verdict is Verdict.CONFIRMED else read
    power = int(np.floor(np.log10(figure.value)))
    return finding(
        "table1_exponent_of_C1", verdict,
        (_density(f"density with an exponent of {power:+d}", read),
         _density(f"density with an exponent of {-power:+d}", other)),
        C1=figure, mineral=_MINERAL, power=-power if wrong is other else power, wrong=wrong,
        read=read, most=_most_samples(published, float(wrong.upper)),
    )  # fmt: skip


def _most_samples(published: Published, densest: float) -> int | str:
    """Return how many samples could have both the RMSE and the largest relative error printed.

    Some error is at least sqrt(SSE/n) = RMSE sqrt((n - p)/n), and none exceeds the largest
    relative error of the densest sample.
    """
    table = published.bulk_density
    rmse, relative = table.quality["rmse"], table.quality["max_relative_error"]
    part = relative.value + relative.half_unit
    largest = part * densest / (1.0 - part)
    share = (largest / (rmse.value - rmse.half_unit)) ** 2
    return "any number of" if share >= 1.0 else int(len(table.estimates) / (1.0 - share))


def _sign_of_C3(published: Published) -> Finding:
    rmse = published.bulk_density.quality["rmse"].value
    read, other = (
        density_range(published, C3_sign=sign, cone_index=exact(400.0)) for sign in (1, -1)
    )
    apart = float(max(other.upper - read.lower, read.upper - other.lower))
    return finding(
        "table1_sign_of_C3", Verdict.UNTESTABLE if apart <= 2.0 * rmse else Verdict.CONSISTENT,
        (_density("density with C3 positive", read), _density("density with C3 negative", other),
         Quantity("largest difference", apart, "g/cm^3", published=f"RMSE {rmse:g}")),
        C3=published.bulk_density.estimates["C3"], apart=apart, rmse=rmse,
    )  # fmt: skip


def _unit(published: Published) -> Finding:
    mpa = Interval(_CONE_INDEX.lower / 1000.0, _CONE_INDEX.upper / 1000.0)
    in_kpa, in_mpa = density_range(published), density_range(published, cone_index=mpa)
    verdict = beside_rival(_mineral(in_kpa), _mineral(in_mpa))
    # That only kPa gives a soil does not prove it; that both do decides nothing.
    weaker = {Verdict.CONFIRMED: Verdict.CONSISTENT, Verdict.CONSISTENT: Verdict.UNTESTABLE}
    return finding(
        "table1_unit_of_cone_index", weaker.get(verdict, verdict),
        (_density("density with kPa", in_kpa), _density("density with MPa", in_mpa)),
        in_kpa=in_kpa, in_mpa=in_mpa,
    )  # fmt: skip


def _quality(published: Published) -> Finding:
    table = published.bulk_density
    r_squared, rmse, relative = (
        printed(table.quality[name]) for name in ("r_squared", "rmse", "max_relative_error")
    )
    density = density_range(published)
    # One error squared is no more than all of them: (relative x density)^2 <= RMSE^2 (n - p).
    largest = relative * density
    fewest = len(table.estimates) + float(np.ceil((largest.lower / rmse.upper) ** 2))
    most = _most_samples(published, float(density.upper))
    # The sd of the observed densities, and the factor of cone index that the explained part needs.
    spread = rmse / root_of_rest(r_squared)
    explained = np.sqrt(r_squared.upper) * spread.upper / density.lower
    factor = float(np.exp(table.values["C4"] * explained))
    possible = isinstance(most, str) or most >= fewest
    return finding(
        "table1_quality", consistent_if(possible and factor < 30.0),
        (Quantity("samples at least", fewest),
         rounded("sd of the measured densities", spread, "g/cm^3"),
         Quantity("factor of cone index per sd of the fitted densities, at most", factor)),
        quality=table.quality, fewest=int(fewest), factor=factor,
        spread=float(spread.middle / density.middle),
    )  # fmt: skip
