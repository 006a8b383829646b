"""Table 1: the exponent of C1, the sign of C3, the unit of cone index, the goodness of fit.

Eq 1, density = {(CI/C1) [C2 + (theta - C3)^2]}^(1/C4), has every coefficient once: over all that
print alike its extremes are those of interval arithmetic.
"""

from __future__ import annotations

import numpy as np

from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, number, percent, rounded
from calib.he2019.audit.intervals import Interval, exact, exp, log, printed, square
from calib.he2019.datasets.published import Published

_FAMILY = "Table 1, Eq 1"
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
        _unchecked(published),
    ]  # fmt: skip


def _plausible(density: Interval) -> bool:
    low, high = _MINERAL
    return bool(density.lower >= low and density.upper <= high)


def _quantity(name: str, density: Interval) -> Quantity:
    what = "over conditions and rounding"
    return Quantity(name, float("nan"), "g/cm^3", float(density.lower), float(density.upper), what)


def _exponent(published: Published) -> Finding:
    figure = published.bulk_density.estimates["C1"]
    read, other = density_range(published), density_range(published, exponent=-1)
    verdict = {
        (True, False): Verdict.CONFIRMED, (True, True): Verdict.CONSISTENT,
        (False, True): Verdict.CORRECTED, (False, False): Verdict.CONTRADICTED,
    }[_plausible(read), _plausible(other)]  # fmt: skip
    wrong = other if verdict is Verdict.CONFIRMED else read
    most = _most_samples(published, float(wrong.upper))
    power = int(np.floor(np.log10(figure.value)))
    return Finding(
        "table1_exponent_of_C1", _FAMILY, "Table 1, Eq 1", ("Table 1: C1",),
        f"C1 = {figure.text}, the sign of its exponent inferred",
        f"densities over cone indices of 100 to 3000 kPa and the tested water contents, over all "
        f"coefficients that print alike, beside those of mineral soils ({_MINERAL[0]} to "
        f"{_MINERAL[1]} g/cm^3); the printed errors against each other",
        (
            _quantity(f"density with an exponent of {power:+d}", read),
            _quantity(f"density with an exponent of {-power:+d}", other),
        ),
        verdict,
        f"An exponent of {-power if wrong is other else power:+d} gives "
        f"{number(float(wrong.lower))} to {number(float(wrong.upper))} g/cm^3, which no mineral "
        f"soil has; at such densities the printed RMSE and largest relative error could stand "
        f"together only with {most} samples or fewer.",
        f"The other exponent gives {number(float(read.lower))} to {number(float(read.upper))} "
        "g/cm^3, a compacted soil; see the unit of cone index.",
        Basis.PHYSICS,
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
    figure = published.bulk_density.estimates["C3"]
    rmse = published.bulk_density.quality["rmse"].value
    one = Interval(np.array(400.0), np.array(400.0))
    read = density_range(published, cone_index=one)
    other = density_range(published, C3_sign=-1, cone_index=one)
    apart = float(max(other.upper - read.lower, read.upper - other.lower))
    return Finding(
        "table1_sign_of_C3", _FAMILY, "Table 1, Eq 1", ("Table 1: C3",),
        f"C3 = {figure.text}, its sign open",
        "densities at one cone index over the tested water contents, under either sign, beside "
        "the printed RMSE",
        (_quantity("density with C3 positive", read), _quantity("density with C3 negative", other),
         Quantity("largest difference", apart, "g/cm^3", published=f"RMSE {rmse:g}")),
        Verdict.UNTESTABLE if apart <= 2.0 * rmse else Verdict.CONSISTENT,
        f"The sign moves the density by {number(apart, 2)} g/cm^3 at most, where the RMSE is "
        f"{rmse:g}, and a shift of C1 takes up most of it.",
        "Whether soil of one density resists more (positive) or less (negative) when wetter; the "
        "reconstructed data take the positive sign and cannot decide.",
        Basis.PHYSICS,
    )  # fmt: skip


def _unit(published: Published) -> Finding:
    in_kpa = density_range(published)
    in_mpa = density_range(
        published,
        cone_index=Interval(_CONE_INDEX.lower / _KPA_PER_MPA, _CONE_INDEX.upper / _KPA_PER_MPA),
    )
    fine = _plausible(in_kpa), _plausible(in_mpa)
    verdict = Verdict.UNTESTABLE if all(fine) else Verdict.CONSISTENT
    if not fine[0]:
        verdict = Verdict.CORRECTED if fine[1] else Verdict.CONTRADICTED
    return Finding(
        "table1_unit_of_cone_index", _FAMILY, "Table 1, Eq 1, nomenclature",
        ("Table 1: C1", "Table 1: C4"),
        "cone index enters Eq 1 in kPa",
        "densities over cone indices of 100 to 3000 kPa, over all coefficients that print alike, "
        "with cone index in kPa and in MPa",
        (_quantity("density with kPa", in_kpa), _quantity("density with MPa", in_mpa)),
        verdict,
        f"In kPa the tested soil would be {number(float(in_kpa.lower))} to "
        f"{number(float(in_kpa.upper))} g/cm^3, in MPa {number(float(in_mpa.lower))} to "
        f"{number(float(in_mpa.upper))}: both are soils, the second the commoner sandy loam.",
        "One printed density, or one printed cone index, would decide; Table 5 shows that a "
        "declared unit need not be the one that was used.",
        Basis.PHYSICS,
    )  # fmt: skip


def _quality(published: Published) -> Finding:
    table = published.bulk_density
    r_squared, rmse, relative = (
        printed(table.quality[name]) for name in ("r_squared", "rmse", "max_relative_error")
    )
    density = density_range(published)
    p = len(table.estimates)
    # One error squared is no more than all of them: (relative x density)^2 <= RMSE^2 (n - p).
    largest = relative * density
    fewest = p + float(np.ceil((largest.lower / rmse.upper) ** 2))
    most = _most_samples(published, float(density.upper))
    # The sd of the observed densities, and the factor of cone index that the explained part needs.
    spread = rmse / Interval(*(np.sqrt(1.0 - e) for e in (r_squared.upper, r_squared.lower)))
    explained = np.sqrt(r_squared.upper) * spread.upper / density.lower
    factor = float(np.exp(table.values["C4"] * explained))
    possible = isinstance(most, str) or most >= fewest
    sensible = factor < 30.0
    return Finding(
        "table1_quality", _FAMILY, "Table 1",
        ("Table 1: r_squared", "Table 1: rmse", "Table 1: max_relative_error"),
        f"R^2 = {table.quality['r_squared'].text}, RMSE = {table.quality['rmse'].text} g/cm^3 and "
        f"a largest relative error of {percent(table.quality['max_relative_error'].value)} belong "
        "to one fit",
        "what each of the three allows the others to be",
        (
            Quantity("samples at least", fewest),
            rounded("sd of the measured densities", spread, "g/cm^3"),
            Quantity("factor of cone index per sd of the fitted densities, at most", factor),
        ),
        Verdict.CONSISTENT if possible and sensible else Verdict.CONTRADICTED,
        f"They can stand together with {int(fewest)} samples or more, whose densities vary by "
        f"{percent(float(spread.middle / density.middle), 2)} (sd) and whose cone indices vary by "
        f"a factor of {number(factor, 2)} or less about their middle.",
        "The number of samples is not printed, so the RMSE's convention cannot be checked.",
        Basis.PHYSICS,
    )  # fmt: skip


def _unchecked(published: Published) -> Finding:
    return Finding(
        "table1_values", _FAMILY, "Table 1", ("Table 1: C2", "Table 1: C4"),
        "C1 to C4 are the least-squares estimates",
        "none: neither the samples nor their number are printed",
        (), Verdict.UNTESTABLE,
        "Any values are the optimum of some data; those used here were made so that these are.",
        "The measured densities, cone indices and water contents.", Basis.RECONSTRUCTED,
    )  # fmt: skip
