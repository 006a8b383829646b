"""Numbers, symbols and units as a reader needs them."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from calib.data.quantities import QUANTITIES, Quantity
from calib.inference.calibration import Calibration, ParameterSummary
from calib.inference.diagnostics import hdi, hdi_error, median_error
from calib.report.figures.posterior import _log_ticks
from calib.report.labels import (
    axis_of,
    joined,
    parameter_label,
    parameter_unit,
    percent,
    plain,
    symbol,
    unit_plain,
    unit_text,
    units_of,
)
from calib.report.markup import latex_unit, unit_html
from calib.report.numbers import (
    NOTHING,
    TIMES,
    ascii_number,
    ascii_text,
    centre_text,
    format_as_printed,
    format_at,
    format_interval,
    format_like,
    format_number,
    format_value,
    interval_text,
    last_place,
    skewed,
)

MINUS = "\N{MINUS SIGN}"
SUPER = str.maketrans("\N{SUPERSCRIPT MINUS}⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
POWER = re.compile(rf"{TIMES}10([\N{{SUPERSCRIPT MINUS}}⁰¹²³⁴⁵⁶⁷⁸⁹]+)")
finite = st.floats(-1e9, 1e9, allow_nan=False)
spread = st.floats(1e-9, 1e9, allow_nan=False)


def read(text: str) -> list[float]:
    """Read numbers back from a formatted text."""
    body, _, power = text.replace(MINUS, "-").partition(f"{TIMES}10")
    scale = 10.0 ** int(power.translate(SUPER)) if power else 1.0
    return [float(t) * scale for t in re.split(r" ± | to ", body.strip("()"))]


def read_interval(text: str) -> list[float]:
    """Read the ends of an interval, each with a power of its own or with a common one."""
    if text.startswith("("):
        return read(text)
    return [read(end)[0] for end in text.split(" to ")]


def parts(text: str) -> list[str]:
    """The mantissas of a formatted text."""
    return re.split(r" ± | to ", POWER.sub("", text).strip("()").replace(MINUS, "-"))


@pytest.mark.parametrize(
    ("mean", "sd", "text"),
    [
        (1.64812, 0.0251, "1.648 ± 0.025"),
        (1.64812, 0.0996, "1.65 ± 0.10"),
        (3.31e5, 1.2e5, f"(3.3 ± 1.2){TIMES}10⁵"),
        (-0.1026, 1.3, f"{MINUS}0.1 ± 1.3"),
        (1234.5, 67.0, "1234 ± 67"),
        (12345.0, 678.0, "12340 ± 680"),
        (5.9e-10, 2.0e-10, f"(5.9 ± 2.0){TIMES}10\N{SUPERSCRIPT MINUS}¹⁰"),
        (-0.0001, 0.1, "0.00 ± 0.10"),
        (2.5, 0.0, "2.50000"),
        (float("nan"), 1.0, NOTHING),
        (1.0, float("inf"), NOTHING),
    ],
)
def test_format_value(mean, sd, text):
    assert format_value(mean, sd) == text


def exponent_at_two_digits(value: float) -> int:
    """Of a number as it is written: 0.995 is 1.0, though the float lies just below."""
    written = Decimal(repr(value))
    return round(written, 1 - written.adjusted()).adjusted()


@given(st.floats(-1e12, 1e12).filter(lambda x: abs(x) > 1e-12), st.integers(1, 6))
def test_numbers_keep_their_digits(value, digits):
    (shown,) = read(format_number(value, digits))
    assert shown == pytest.approx(value, rel=0.5001 * 10.0 ** (1 - digits))


def test_intervals_share_the_decimals_of_the_value():
    assert format_interval(2e-21, 1.1e-8, (8e-11, 1.1e-8)) == f"0 to 1.1{TIMES}10⁻⁸"
    assert format_interval(0.01, 90.0, 40.0) == "0 to 90"
    assert format_interval(-1.0, 1.0, float("nan")) == NOTHING
    assert format_interval(1e5, 5e5, 1.2e5) == f"(1.0 to 5.0){TIMES}10⁵"


@pytest.mark.parametrize(
    ("uncertainty", "mcse", "text"),
    [
        (0.0251, (0.0, 0.0), "1.601 to 1.695"),
        (0.0251, (0.0009, 0.0009), "1.601 to 1.695"),  # errors below the last digit
        (0.0251, (0.0011, 0.0011), "1.60 to 1.69"),  # just above it
        (0.0251, (0.0005, 0.0011), "1.60 to 1.69"),  # neighbours share the coarser
        (0.0251, (0.3, 0.3), "1.60 to 1.69"),  # one digit of the uncertainty stays
        ((0.0251, 2.51), (0.0, 0.0), "1.601 to 1.7"),  # ends of a long tail do not
        ((0.0251, 25.1), (0.0, 0.0), "1.601 to 2"),
    ],
)
def test_intervals_are_cut_by_their_monte_carlo_errors(uncertainty, mcse, text):
    assert format_interval(1.6012, 1.6949, uncertainty, mcse) == text


def unit_of(uncertainty: float, mcse: float) -> float:
    """The rule, written a second time: two digits of the uncertainty, none below the error."""
    size = exponent_at_two_digits(uncertainty)
    fine, coarse = 10.0 ** (size - 1), 10.0**size
    return fine if fine >= mcse else coarse


@given(finite, spread, st.floats(0.0, 1.0))
@example(1.75, 0.995, 0.0)
def test_the_last_digit_is_never_finer_than_the_rule_allows(mean, sd, part):
    text = format_value(mean, sd, part * sd)
    shown_mean, shown_sd = read(text)
    assert "-" not in text
    unit = unit_of(sd, part * sd * (1.0 - 1e-12))
    for shown, value in ((shown_mean, mean), (shown_sd, sd)):
        assert abs(shown - value) <= 0.5 * unit * (1.0 + 1e-6) + 1e-12 * abs(value)
        assert abs(shown / unit - round(shown / unit)) < 1e-6 * max(1.0, abs(shown / unit))
    assert shown_sd > 0.0
    # Machines read the same digits.
    written = ascii_number(mean, last_place(sd, part * sd))
    assert float(written) == pytest.approx(shown_mean, rel=1e-9, abs=1e-300)


@given(finite, finite, spread, st.floats(0.0, 0.2), st.floats(0.0, 0.2))
def test_an_interval_holds_what_its_errors_allow(a, b, sd, first, second):
    lower, upper = sorted((a, b))
    errors = (first * sd, second * sd)
    shown = read_interval(format_interval(lower, upper, sd, errors))
    unit = max(unit_of(sd, e * (1.0 - 1e-12)) for e in errors)
    for value, end in zip(shown, (lower, upper), strict=True):
        assert abs(value - end) <= 0.5 * unit * (1.0 + 1e-6) + 1e-12 * abs(end)
    assert unit >= max(errors) * (1.0 - 1e-9) or unit > 0.1 * sd


@given(finite, spread, spread)
def test_digits_do_not_depend_on_the_unit(mean, sd, scale):
    """The same measurement in another unit, a power of ten apart, has the same digits."""
    assume(abs(mean) < 1e12 * sd)  # a double has no more digits
    power = round(math.log10(scale))
    there = format_value(*(float(Decimal(repr(v)).scaleb(power)) for v in (mean, sd)))
    here = format_value(mean, sd)
    digits = [
        [f"{Decimal(part):f}".replace(".", "").lstrip("-0").rstrip("0") for part in parts(text)]
        for text in (here, there)
    ]
    assert digits[0] == digits[1]


def test_format_like_prints_what_the_source_would():
    assert format_like(1.99612, "1.996") == "1.996"
    assert format_like(3.3061e5, "3.306e5") == f"3.306{TIMES}10⁵"
    assert format_like(5.934e-10, "5.934e-10") == f"5.934{TIMES}10\N{SUPERSCRIPT MINUS}¹⁰"
    assert format_like(-0.00001, "0.01") == "0.00"
    assert format_like(float("nan"), "1.0") == NOTHING

    assert format_as_printed(1.99612, "1.996") == "1.996"
    assert format_as_printed(45_649_312.0, "3.306e5") == f"4.565{TIMES}10⁷"
    assert format_as_printed(0.000213, "0.05") == f"2.13{TIMES}10⁻⁴"
    assert format_as_printed(float("nan"), "0.05") == NOTHING


def test_numbers_for_machines():
    assert ascii_number(-1.6481, -3) == "-1.648"
    assert ascii_number(5.9e-10, -11) == "5.9e-10"
    assert ascii_number(330_600.0, 2) == "3.306e+05"
    assert ascii_number(1e-9, -3) == "0"
    assert ascii_number(float("nan"), -3) == ""


@pytest.mark.parametrize(
    ("value", "last", "expected"),
    [(9.7e7, 7, "1.0e+08"), (9.4e7, 7, "9e+07"), (9.7e-8, -8, "1.0e-07"), (97.0, 1, "100")],
)
def test_a_number_that_rounds_up_to_the_next_power_is_written_with_it(value, last, expected):
    assert ascii_text(format_at(value, last)) == expected


# Posteriors


def summary(mean, sd, low, high, median=2.0) -> ParameterSummary:
    return ParameterSummary(
        "C1", "kPa", mean, sd, median, low, high, 900.0, 900.0, 1.0, 0.1, float("nan")
    )


@pytest.mark.parametrize(
    ("s", "expected"),
    [
        (summary(2.1, 0.5, 1.2, 3.1), False),
        (summary(2.4, 0.9, 1.2, 3.7), True),
        (summary(-2.4, 0.9, -3.7, -1.2, -2.0), True),
        (summary(1.6, 0.9, 0.3, 2.8), True),
        (summary(0.05, 0.29, -0.5, 0.6, 0.05), False),
        (summary(2.0, 1.0, 0.1, 3.5), True),
        (summary(-2.0, 1.0, -3.5, -0.1, -2.0), True),
        (summary(2.0, 1.0, 0.13, 3.5), False),
        (summary(2.0, 1.0, -0.01, 3.5), False),
        (summary(2.0, 2.0, 0.1, 3.8), True),
    ],
)
def test_where_a_mean_would_mislead(s, expected):
    assert skewed(s) is expected


@pytest.mark.parametrize(
    ("s", "errors", "centre", "interval"),
    [
        (summary(1.64812, 0.0251, 1.6012, 1.6949, 1.648), (4e-4, 6e-4, 9e-4), "1.648 ± 0.025",
         "1.601 to 1.695"),
        # No finer than the Monte Carlo error of the ends.
        (summary(1.64812, 0.0251, 1.6012, 1.6949, 1.648), (4e-4, 6e-4, 1.5e-3), "1.648 ± 0.025",
         "1.60 to 1.69"),
        # A lower end that is nothing.
        (summary(5e-9, 9.5e-8, 2.6e-21, 1.09e-8, 8.13e-11), (9e-13, 1e-13, 4e-10),
         f"median 8.1{TIMES}10⁻¹¹", f"0 to 1.1{TIMES}10⁻⁸"),
        # A tail of many decades does not round the median away.
        (summary(1.2e12, 1.0e14, 3.52e3, 1.2e8, 6.598e5), (5e3, 300.0, 5e6),
         f"median 6.6{TIMES}10⁵", f"0 to 1.2{TIMES}10⁸"),
    ],
)  # fmt: skip
def test_how_a_posterior_is_written(s, errors, centre, interval):
    centre_error, low, high = errors
    s = replace(s, mcse_mean=centre_error, mcse_median=centre_error, mcse_hdi_lower=low,
                mcse_hdi_upper=high)  # fmt: skip
    assert centre_text(s) == centre
    assert interval_text(s) == interval


@pytest.mark.parametrize("kind", ["normal", "lognormal"])
def test_monte_carlo_errors_are_those_of_repeated_sampling(kind):
    rng = np.random.default_rng(3)
    draws = rng.standard_normal((150, 16, 250))
    draws = np.exp(draws) if kind == "lognormal" else draws
    ends = np.array([hdi(d.ravel(), 0.95) for d in draws])
    stated = np.array([hdi_error(d, 0.95) for d in draws]).mean(axis=0)
    actual = ends.std(axis=0)
    assert (stated > 0.8 * actual).all()
    assert (stated < 2.0 * actual).all()
    medians = np.median(draws.reshape(150, -1), axis=1).std()
    assert np.mean([median_error(d) for d in draws]) == pytest.approx(medians, rel=0.2)


def test_every_parameter_of_a_calibration_has_its_errors(rut_calibration: Calibration):
    ensembles = rut_calibration.draws.t.shape[0]
    for name, s in rut_calibration.summary.items():
        assert 0.0 < s.mcse_median < 0.2 * s.sd
        values = rut_calibration.parameters[name].reshape(ensembles, -1)
        between = np.array([hdi(v, 0.95) for v in values]).std(axis=0, ddof=1)
        for error, scatter in zip((s.mcse_hdi_lower, s.mcse_hdi_upper), between, strict=True):
            # The ensembles' own scatter, from four of them, allows no closer comparison.
            assert error > 0.1 * scatter
            assert error < 0.5 * s.sd


# Symbols and units


def test_percent_and_joined():
    assert percent(0.0294) == "2.9 %"
    assert joined(["a"]) == "a"
    assert joined(["a", "b", "c"]) == "a, b and c"


@pytest.mark.parametrize(
    ("unit", "shown", "factor"),
    [
        ("kN", "N", 1e3),
        ("kN/%/psi^2", "N/%/kPa^2", 1e3 / 6.894757**2),
        ("1/psi", "1/kPa", 1.0 / 6.894757),
        ("kPa/m^n", "psi/m^n", 1.0 / 6.894757),
        ("kPa (g/cm^3)^-C4", "psi (g/cm^3)^-C4", 1.0 / 6.894757),
        ("mm", "mm", 1.0),
        ("1", "1", 1.0),
    ],
)
def test_parameters_may_have_the_units_of_the_file(unit, shown, factor):
    headers = ["drawbar_pull_n", "inflation_pressure_kpa", "average_ground_pressure_psi"]
    columns = ["drawbar_pull_kn", "inflation_pressure_psi", "average_ground_pressure_kpa"]
    with units_of(headers):
        found = parameter_unit(unit, [*columns, "slip_ratio", "normal_load_kn"])
    assert found == (shown, pytest.approx(factor))


def test_a_page_has_the_units_of_its_file():
    usual = axis_of("drawbar_pull_kn")
    headers = ("Drawbar pull [lbf]", "drawbar_pull_n", "slip_ratio", "note", "bulk_density_kg_m3",
               "average_ground_pressure_lbf_in2", "rut_depth_furlong")  # fmt: skip
    with units_of(headers):
        pull = axis_of("drawbar_pull_kn")
        assert pull.label == "Drawbar pull (lbf)"
        assert pull.range_text(np.array([1.0, 2.0])) == "225 to 450 lbf"
        assert axis_of("slip_ratio").label == "Slip (%)"
        assert axis_of("bulk_density_g_cm3").label == "Dry bulk density (kg/m³)"
        assert axis_of("average_ground_pressure_kpa").unit == "lbf/in²"
        assert axis_of("rut_depth_mm").unit == "mm"
    assert axis_of("drawbar_pull_kn") == usual


def test_symbols():
    assert symbol("K_lo") == r"$K_\mathrm{lo}$"
    assert symbol("C2") == r"$C_\mathrm{2}$"
    assert symbol("Sh") == r"$S_\mathrm{h}$"
    assert symbol("sigma") == r"$\sigma$"
    assert plain("gamma_ref") == "\N{GREEK SMALL LETTER GAMMA}_ref"


def test_units():
    assert axis_of("slip_ratio").label == "Slip (%)"
    assert axis_of("speed_m_s").label == "Speed (m/s)"
    assert axis_of("cone_index_kpa").value_text(1893.4) == "1893"
    assert unit_text("g/cm^3") == "g/cm$^{3}$"
    assert unit_text("kPa (g/cm^3)^-C4") == "kPa (g/cm$^{3}$)$^{-C4}$"
    assert unit_text("kPa/degC^2") == "kPa/°C$^{2}$"
    assert unit_plain("degF") == "°F"
    assert latex_unit("degC") == r"$^{\circ}$C"
    assert unit_html("degC") == "°C"
    assert parameter_label("n0", "1").endswith("(\N{EN DASH})")
    assert parameter_label("C2", "1", log=True).startswith("log$_{10}$")


def test_temperatures_have_the_sign_of_degrees():
    heat = Quantity("soil_heat", "soil_heat_c", "temperature", "degC", "condition", "how warm",
                    suffixes={"c": "degC"})  # fmt: skip
    QUANTITIES.add(heat)
    try:
        assert axis_of("soil_heat_c").label == "Soil heat (°C)"
    finally:
        QUANTITIES.discard("soil_heat_c")


@pytest.mark.parametrize(("values", "said"), [
    (np.full(9, 0.1), "10 %"),
    (np.array([-0.00141, 0.9]), f"{MINUS}0.141 to 90 %"),
    (np.linspace(0.01, 0.6, 8), "1 to 60 %"),
    (np.repeat([0.1, 0.5], 9), "10 to 50 %"),
    ([0.01, 0.02, 0.03, 0.04, 0.45, 0.5, 0.55, 0.6], "1 to 4 % and 45 to 60 %"),
    ([*np.linspace(0.01, 0.04, 8), 0.6], "1 to 4 % and 60 %"),
])  # fmt: skip
def test_a_range_has_a_value_wherever_it_is_said_to(values, said):
    assert axis_of("slip_ratio").range_text(np.asarray(values)) == said


@pytest.mark.parametrize(("low", "high"), [(0.02, 1.5), (1e-5, 0.3), (8.0, 12.0), (1e-9, 1e3)])
def test_log_ticks_lie_inside_and_are_few(low, high):
    ticks = _log_ticks(low, high)
    assert len(ticks) <= 4
    assert all(low <= v <= high for v in ticks)
    assert ticks
