from __future__ import annotations

import numpy as np
import pytest

from calib.data.quantities import QUANTITIES, Quantity
from calib.report.figures.posterior import _log_ticks
from calib.report.labels import (
    axis_of,
    joined,
    parameter_label,
    percent,
    plain,
    short,
    symbol,
    unit_plain,
    unit_text,
    units_of,
)
from calib.report.markup import latex_unit, unit_html

MINUS = "\N{MINUS SIGN}"
TIMES = "\N{MULTIPLICATION SIGN}"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (0.0996, "0.10"), (1234.0, "1200"), (-0.5, f"{MINUS}0.50"),
     (4.3e8, f"4.3{TIMES}10⁸"), (1.9e-6, f"1.9{TIMES}10⁻⁶"),
     (float("nan"), "\N{EN DASH}"), (99.6, "100")],
)  # fmt: skip
def test_short(value, text):
    assert short(value) == text


def test_percent_and_joined():
    assert percent(0.0294) == "2.9 %"
    assert joined(["a"]) == "a"
    assert joined(["a", "b", "c"]) == "a, b and c"


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


def test_slip_is_drawn_in_percent():
    axis = axis_of("slip_ratio")
    assert axis.label == "Slip (%)"
    assert axis.scale(np.array([0.2]))[0] == pytest.approx(20.0)
    assert axis.range_text(np.array([-0.00141, 0.9])) == f"{MINUS}0.141 to 90 %"
    assert axis_of("cone_index_kpa").value_text(1893.4) == "1893"


@pytest.mark.parametrize(("values", "said"), [
    (np.full(9, 0.1), "10 %"),
    (np.linspace(0.01, 0.6, 8), "1 to 60 %"),
    (np.repeat([0.1, 0.5], 9), "10 to 50 %"),
    ([0.01, 0.02, 0.03, 0.04, 0.45, 0.5, 0.55, 0.6], "1 to 4 % and 45 to 60 %"),
    ([*np.linspace(0.01, 0.04, 8), 0.6], "1 to 4 % and 60 %"),
])  # fmt: skip
def test_a_range_has_a_value_wherever_it_is_said_to(values, said):
    assert axis_of("slip_ratio").range_text(np.asarray(values)) == said


def test_a_column_without_an_entry_still_has_a_unit():
    assert axis_of("speed_m_s").label == "Speed (m/s)"


@pytest.mark.parametrize(("low", "high"), [(0.02, 1.5), (1e-5, 0.3), (8.0, 12.0), (1e-9, 1e3)])
def test_log_ticks_lie_inside_and_are_few(low, high):
    ticks = _log_ticks(low, high)
    assert len(ticks) <= 4
    assert all(low <= v <= high for v in ticks)
    assert ticks
