"""Table 1: the exponent of C1, the sign of C3, the unit of cone index, the goodness of fit.

Eq 1, density = {(CI/C1) [C2 + (theta - C3)^2]}^(1/C4), has every coefficient once: over all that
print alike its extremes are those of interval arithmetic.
"""

from __future__ import annotations

import numpy as np

from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    beside_rival,
    between,
    finding,
    rounded,
)
from calib.he2019.audit.intervals import Interval, exact, exp, log, printed, square
from calib.he2019.datasets.published import Published

# Cone indices of soils that carry a wheel but let it sink, kPa.
_CONE_INDEX = Interval(np.array(100.0), np.array(3000.0))
# Dry bulk density of mineral soils, g/cm^3: 1.0 to 1.9 (Brady & Weil 2016, The Nature and
# Properties of Soils), with a tenth to either side.
_MINERAL = (0.9, 2.0)
_KPA_PER_MPA = 1000.0


def density_range(
    published: Published,
    *,
    exponent: int = 1,
    C3_sign: int = 1,
    cone_index: Interval = _CONE_INDEX,
) -> Interval:
    """Return the densities (g/cm^3) that Table 1 gives over the tested water contents.

    1 takes the exponent of C1, or C3, with the sign that it is read with, -1 with the other; cone
    index is in the unit of Eq 1.
    """
    figures = published.bulk_density.estimates
    C1, C2, C3, C4 = (printed(figures[name]) for name in ("C1", "C2", "C3", "C4"))
    if exponent < 0:
        mantissa = 10.0 ** np.floor(np.log10(figures["C1"].value))
        C1 = C1 / exact(mantissa) / exact(mantissa)
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


def _plausible(density: Interval) -> bool:
    low, high = _MINERAL
    return bool(density.lower >= low and density.upper <= high)


def _quantity(name: str, density: Interval) -> Quantity:
    what = "over conditions and rounding"
    return between(name, float(density.lower), float(density.upper), "g/cm^3", what)


def _exponent(published: Published) -> Finding:
    figure = published.bulk_density.estimates["C1"]
    read, other = density_range(published), density_range(published, exponent=-1)
    verdict = beside_rival(_plausible(read), _plausible(other))
    wrong = other if verdict is Verdict.CONFIRMED else read
    power = int(np.floor(np.log10(figure.value)))
    return finding(
        "table1_exponent_of_C1", verdict,
        (_quantity(f"density with an exponent of {power:+d}", read),
         _quantity(f"density with an exponent of {-power:+d}", other)),
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
    p = len(table.estimates)
    return "any number of" if share >= 1.0 else int(p / (1.0 - share))


def _sign_of_C3(published: Published) -> Finding:
    rmse = published.bulk_density.quality["rmse"].value
    one = Interval(np.array(400.0), np.array(400.0))
    read = density_range(published, cone_index=one)
    other = density_range(published, C3_sign=-1, cone_index=one)
    apart = float(max(other.upper - read.lower, read.upper - other.lower))
    return finding(
        "table1_sign_of_C3",
        Verdict.UNTESTABLE if apart <= 2.0 * rmse else Verdict.CONSISTENT,
        (_quantity("density with C3 positive", read), _quantity("density with C3 negative", other),
         Quantity("largest difference", apart, "g/cm^3", published=f"RMSE {rmse:g}")),
        C3=published.bulk_density.estimates["C3"], apart=apart, rmse=rmse,
    )  # fmt: skip


def _unit(published: Published) -> Finding:
    in_kpa = density_range(published)
    low, high = (end / _KPA_PER_MPA for end in (_CONE_INDEX.lower, _CONE_INDEX.upper))
    in_mpa = density_range(published, cone_index=Interval(low, high))
    fine = _plausible(in_kpa), _plausible(in_mpa)
    return finding(
        "table1_unit_of_cone_index",
        # That only kPa gives a soil would not prove it.
        {(True, True): Verdict.UNTESTABLE, (True, False): Verdict.CONSISTENT}.get(
            fine, beside_rival(*fine)
        ),
        (_quantity("density with kPa", in_kpa), _quantity("density with MPa", in_mpa)),
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
    spread = rmse / Interval(*(np.sqrt(1.0 - e) for e in (r_squared.upper, r_squared.lower)))
    explained = np.sqrt(r_squared.upper) * spread.upper / density.lower
    factor = float(np.exp(table.values["C4"] * explained))
    possible = isinstance(most, str) or most >= fewest
    return finding(
        "table1_quality",
        Verdict.CONSISTENT if possible and factor < 30.0 else Verdict.CONTRADICTED,
        (Quantity("samples at least", fewest),
         rounded("sd of the measured densities", spread, "g/cm^3"),
         Quantity("factor of cone index per sd of the fitted densities, at most", factor)),
        quality=table.quality, fewest=int(fewest), factor=factor,
        spread=float(spread.middle / density.middle),
    )  # fmt: skip
