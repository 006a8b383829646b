"""What is drawn, and what the captions say of it, checked against the numbers."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from calib.data import table_from_arrays
from calib.data.quantities import QUANTITIES
from calib.he2019.published import HE2019
from calib.report.figures.bands import bands_plate, density_plate, prior_predictive_plate
from calib.report.figures.collect import NARROW, draw
from calib.report.figures.posterior import (
    ensembles_plate,
)
from calib.report.figures.style import Plate, draw_all, style
from calib.report.figures.validation import residuals_plate, validation_plate
from calib.report.labels import axis_of, units_of
from calib.report.rows import groups, signs_along
from calib.validation.scores import standardise

UNIT = re.compile(r"\(.+\)$")
NAMES = ("bands", "validation", "prior_predictive", "learned", "corner", "ensembles", "residuals",
         "estimates")  # fmt: skip


@pytest.fixture(scope="module")
def drawn(all_plates) -> dict[str, dict[str, Plate]]:
    return {key: {p.name: p for p in found} for key, found in all_plates.items()}


def legend(plate: Plate) -> list[str]:
    return [t.get_text() for t in plate.figure.legends[0].get_texts()]


def test_every_output_has_its_figures_with_units_on_every_axis(drawn):
    for key, found in drawn.items():
        assert tuple(found) == ((*NAMES, "by_pressure") if key == "drawbar" else NAMES)
        for p in found.values():
            for ax in p.figure.axes:
                if not ax.get_visible() or not ax.axison or p.name == "corner":
                    continue
                shared_x = p.name in ("bands", "prior_predictive", "ensembles")
                hidden_y = not ax.spines["left"].get_visible() or shared_x
                label = ax.get_xlabel()
                assert UNIT.search(label) or (shared_x and not label), (p.name, label)
                assert UNIT.search(ax.get_ylabel()) or hidden_y, (p.name, ax.get_ylabel())
    labels = {ax.get_xlabel() for ax in drawn["drawbar"]["corner"].figure.axes}
    assert {"$K_\\mathrm{lo}$\n(kN/%)", "$\\sigma$\n(kN)"} <= labels
    bands = drawn["drawbar"]["bands"].figure
    assert [ax.get_ylabel() for ax in bands.axes] == ["Drawbar pull (kN)", "", ""]
    assert {ax.get_xlabel() for ax in bands.axes} == {"Slip (%)"}


@pytest.mark.parametrize(("key", "headers"), [
    ("drawbar", ("Pull [lbf]", "Drawbar pull [lbf]", "inflation_pressure_kpa")),
    ("rut", ("rut_depth_inch", "average_ground_pressure_psi")),
    ("density", ("bulk_density_kg_m3", "cone_index_mpa")),
])  # fmt: skip
def test_in_the_units_of_a_file_the_same_is_drawn(request, key, headers):
    """Every number beside a unit that is another one is that many times larger."""
    result = request.getfixturevalue(key)
    draw = [density_plate if key == "density" else bands_plate, prior_predictive_plate,
            validation_plate, residuals_plate]  # fmt: skip
    output = result.calibration.problem.bound.model.output
    for one in draw:
        usual = one(result)
        with units_of(headers):
            own, factors = one(result), {}
            for column in (output, *result.calibration.problem.bound.model.conditions):
                factors[axis_of(column).unit] = axis_of(column).factor
        before = {axis_of(c).unit: axis_of(c).factor for c in QUANTITIES}
        changed = 0
        for old, new in zip(usual.figure.axes, own.figure.axes, strict=True):
            for way in ("x", "y"):
                label, was = (getattr(a, f"get_{way}label")() for a in (new, old))
                ends, before_ends = (getattr(a.dataLim, f"interval{way}") for a in (new, old))
                units = [(UNIT.search(text) or [""])[0].strip("()") for text in (label, was)]
                if units[0] == units[1]:
                    continue
                changed += 1
                ratio = factors[units[0]] / before[units[1]]
                np.testing.assert_allclose(ends, ratio * before_ends, rtol=1e-6, atol=1e-9)
        assert changed or one is residuals_plate


def test_nothing_is_cut_off(drawn):
    # The most parameters and panels, and the longest tick labels.
    for p in (*drawn["drawbar"].values(), drawn["density"]["bands"]):
        inside = p.figure.bbox.padded(2.0)
        for ax in p.figure.axes:
            box = ax.get_tightbbox()
            if ax.get_visible() and ax.axison and box is not None:
                assert inside.x0 <= box.x0 <= box.x1 <= inside.x1, (p.name, box)
                assert inside.y0 <= box.y0 <= box.y1 <= inside.y1, (p.name, box)


def test_bands_show_each_point_once_and_count_what_they_cover(drawn, drawbar):
    plate = drawn["drawbar"]["bands"]
    titles = [ax.get_title() for ax in plate.figure.axes]
    assert titles == ["18 psi", "30 psi, held out", "42 psi"]
    points = [sum(len(li.get_xdata()) for li in ax.lines if li.get_marker() == "o")
              for ax in plate.figure.axes]  # fmt: skip
    assert points == [14, 14, 14]
    assert "reconstructed data, held out" in legend(plate)
    low, high = np.nanquantile(drawbar.posterior_predictive, [0.05, 0.95], axis=0)
    observed = drawbar.calibration.problem.observed
    inside = ((low <= observed) & (observed <= high)).sum()
    c = drawbar.validation.scores.coverage[0.9]
    assert f"covers {inside} of 28 calibrated points and {c.hits} of 14 held-out" in plate.caption
    lines = drawn["drawbar"]["residuals"].figure.axes[1].lines
    assert sum(len(line.get_xdata()) for line in lines if line.get_marker() != "None") == 42


def test_what_was_published_is_shown_only_where_wanted(drawn, rut, drawbar):
    assert "published fit (Table 6)" in legend(drawn["rut"]["bands"])
    labels = legend(drawn["rut"]["validation"])
    assert any("held out: 9.7 %" in t for t in labels)
    assert any("fitted: 13 %" in t for t in labels)
    assert not any("published" in t for t in legend(drawn["plate"]["bands"]))
    conditions = {"average_ground_pressure_kpa": np.array([150.0]), "slip_ratio": np.array([0.1])}
    depth, source = HE2019.curve("modified_bekker", conditions)
    assert depth[0] == pytest.approx(1000 * (150 / 3.306e5) ** (1 / (1.996 + 0.1266)))
    assert source == "Table 6"
    marks = HE2019.sampled(drawbar.calibration.problem.bound)
    assert marks["D_lo"] == pytest.approx(1.6480)
    assert marks["K_hi"] == pytest.approx(0.1265 * 1.4802 * 0.5954)
    assert marks["D_bend"] == pytest.approx(1.0 - 1.0071 / (0.5 * (1.6480 + 0.5954)))
    assert set(marks) <= set(drawbar.calibration.problem.names)
    assert "18 and 42 psi calibrated jointly, 90 %" in legend(drawn["drawbar"]["by_pressure"])


def test_captions_have_the_numbers(drawn, rut, density, unconverged):
    s, summary = rut.validation.scores, rut.calibration.summary
    caption = drawn["rut"]["validation"].caption
    assert "9 held-out rows, (reconstructed data)" in caption.replace("rows (", "rows, (")
    assert f"{100 * s.max_relative_error:.1f} % at most" in caption
    assert f"90 % band {s.coverage[0.9].hits} of 9" in caption
    plate = drawn["density"]["validation"]
    assert plate.figure.axes[0].get_ylabel().startswith("Pareto k")
    refitted = len(density.validation.refitted)
    assert f"{refitted} of 36 rows needed a refit (Pareto k above 0.7)." in plate.caption
    assert "agree" in drawn["rut"]["ensembles"].caption
    with style():
        assert "do NOT pass" in ensembles_plate(unconverged).caption
    printed = {"n0": 1.996, "n1": 1.266, "k": 3.306e5}
    outside = [n for n, v in printed.items()
               if not summary[n].hdi_lower <= v <= summary[n].hdi_upper]  # fmt: skip
    caption = drawn["rut"]["estimates"].caption
    assert all(name in caption for name in outside)
    said = drawn["drawbar"]["learned"].caption
    assert said.startswith("The data do not identify K_bend, D_bend")
    wide = re.search(r"is (\d[\d.]*) times as wide", drawn["rut"]["prior_predictive"].caption)
    assert float(wide[1]) > 2.0


def test_residuals_are_in_noise_sds(rut):
    residual = standardise(rut.calibration, rut.calibration.problem).residual
    assert residual.std() == pytest.approx(1.0, abs=0.25)
    changes, pairs = signs_along(rut, residual)
    assert pairs == 18 - 2
    assert 0 <= changes <= pairs
    assert signs_along(rut, np.ones(18)) == (0, 16)


def test_many_pressures_are_cut_to_six_spread_out(drawbar):
    psi = np.repeat(np.arange(10.0, 42.0, 4.0), 5)
    whole = table_from_arrays(
        {"inflation_pressure_psi": psi, "slip_ratio": np.tile(np.linspace(0.05, 0.6, 5), 8),
         "drawbar_pull_kn": np.ones(40)},
    )  # fmt: skip
    calibration = replace(
        drawbar.calibration, problem=drawbar.calibration.problem.with_table(whole)
    )
    validation = replace(drawbar.validation, method="leave_one_out")
    result = replace(drawbar, calibration=calibration, validation=validation,
                     task=replace(drawbar.task, table=whole))  # fmt: skip
    shown = [g.value for g in groups(result)]
    assert len(shown) == 6
    assert (shown[0], shown[-1]) == (10.0, 38.0)
    assert sum(g.size for g in groups(result, most=False)) == 40


def test_a_figure_that_fails_does_not_stop_the_rest():
    def broken():
        raise RuntimeError("no luck")

    found = draw_all({"a": broken, "b": lambda: Plate(None, "b", "drawn"), "c": lambda: None})
    assert [(p.name, p.figure) for p in found] == [("a", None), ("b", None)]
    assert "no luck" in found[0].caption
    assert found[1].caption == "drawn"


@pytest.mark.slow
def test_points_say_what_was_measured_and_expected_there(rut, density):
    """Where they lie in the image: within it, to the right with slip."""
    for key, result in (("rut_depth", rut), ("bulk_density", density)):
        (bands,) = (p for p in draw(key, result).plates if p.name == "bands")
        x, y, said = zip(*bands.points, strict=True)
        assert 0.0 < min(x) < max(x) < 1.0
        assert 0.0 < min(y) < max(y) < 1.0
        assert all("measured" in text and "90 % band" in text for text in said)
    points = draw("rut_depth", rut).plates[0].points
    assert len(points) == 27
    said = [text for _, _, text in points]
    assert any(s.startswith("Slip 20") and ", held out: measured" in s for s in said)


@pytest.mark.slow
def test_panels_are_stacked_for_narrow_screens(drawbar, density):
    for key, result, panels in (("drawbar_pull", drawbar, 3), ("bulk_density", density, 2)):
        files = draw(key, result).files
        wide, narrow = (
            Image.open(io.BytesIO(files[f"{key}_bands{which}.png"])).size for which in ("", NARROW)
        )
        assert wide[0] > wide[1]
        assert narrow[0] < 0.6 * wide[0]
        assert narrow[1] > 0.5 * panels * wide[1]
