"""What is drawn, and what the captions say of it, checked against the numbers."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.collections import LineCollection

from calib.data import table_from_arrays
from calib.data.quantities import QUANTITIES
from calib.he2019.published import HE2019
from calib.report.figures import collect
from calib.report.figures.bands import bands_plate, density_plate, prior_predictive_plate
from calib.report.figures.collect import plates
from calib.report.figures.estimates import estimates_plate
from calib.report.figures.plate import Plate
from calib.report.figures.posterior import corner_plate, ensembles_plate, learned_plate
from calib.report.figures.style import style
from calib.report.figures.validation import residuals_plate, validation_plate
from calib.report.labels import axis_of, units_of
from calib.report.reference import NOTHING
from calib.report.rows import groups, signs_along
from calib.report.verdict import judge_evidence
from calib.validation.scores import BOTH, DATA, MOVED, PRIOR, role_of, standardise

UNIT = re.compile(r"\(.+\)$")
NAMES = ("bands", "validation", "prior_predictive", "learned", "corner", "ensembles", "residuals",
         "estimates")  # fmt: skip


@pytest.fixture(scope="module")
def drawn(all_plates) -> dict[str, list[Plate]]:
    return all_plates


def test_every_output_has_its_figures(drawn):
    for key, found in drawn.items():
        assert [p.caption for p in found if p.figure is None] == []
        expected = (*NAMES, "by_pressure") if key == "drawbar" else NAMES
        assert tuple(p.name for p in found) == expected


def test_every_axis_has_a_label_with_a_unit(drawn):
    for found in drawn.values():
        for p in found:
            if p.name == "corner":
                continue
            for ax in p.figure.axes:
                if not ax.get_visible() or not ax.axison:
                    continue
                shared_x = p.name in ("bands", "prior_predictive", "ensembles")
                hidden_y = not ax.spines["left"].get_visible() or shared_x
                label = ax.get_xlabel()
                assert UNIT.search(label) or (shared_x and not label), (p.name, label)
                assert UNIT.search(ax.get_ylabel()) or hidden_y, (p.name, ax.get_ylabel())


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


def test_shared_axes_are_labelled_at_the_edge(drawn):
    bands = drawn["drawbar"][0].figure
    assert [ax.get_ylabel() for ax in bands.axes] == ["Drawbar pull (kN)", "", ""]
    assert {ax.get_xlabel() for ax in bands.axes} == {"Slip (%)"}


def test_corner_labels_every_parameter_with_its_unit(drawbar):
    texts = [t.get_text() for t in corner_plate(drawbar, reference=HE2019).figure.axes[0].texts]
    for symbol in ("$K_\\mathrm{lo}$\n(kN/%)", "$D_\\mathrm{hi}$\n(kN)", "$\\sigma$\n(kN)"):
        assert symbol in texts
    assert any("dashed: published" in t for t in texts)


def test_saved_without_a_warning(plate):
    for draw in (bands_plate, validation_plate):
        draw(plate).figure.savefig(io.BytesIO(), format="png", dpi=40)


def test_nothing_is_cut_off(drawn):
    # The most parameters and panels, and the longest tick labels.
    for found in (drawn["drawbar"], drawn["density"][:1]):
        for p in found:
            inside = p.figure.bbox.padded(2.0)
            for ax in p.figure.axes:
                box = ax.get_tightbbox()
                if ax.get_visible() and ax.axison and box is not None:
                    assert inside.x0 <= box.x0, (p.name, box)
                    assert box.x1 <= inside.x1, (p.name, box)
                    assert inside.y0 <= box.y0, (p.name, box)
                    assert box.y1 <= inside.y1, (p.name, box)


def test_bands_caption_counts_what_the_bands_cover(drawbar):
    caption = bands_plate(drawbar, reference=HE2019).caption
    low, high = np.nanquantile(drawbar.posterior_predictive, [0.05, 0.95], axis=0)
    observed = drawbar.calibration.problem.observed
    inside = ((low <= observed) & (observed <= high)).sum()
    c = drawbar.validation.scores.coverage[0.9]
    assert f"covers {inside} of 28 calibrated points and {c.hits} of 14 held-out" in caption


def test_bands_say_what_was_held_out_and_show_each_point_once(drawbar):
    fig = bands_plate(drawbar, reference=HE2019).figure
    assert [ax.get_title() for ax in fig.axes] == ["18 psi", "30 psi, held out", "42 psi"]
    points = [sum(len(li.get_xdata()) for li in ax.lines if li.get_marker() == "o")
              for ax in fig.axes]  # fmt: skip
    assert points == [14, 14, 14]
    labels = [t.get_text() for t in fig.legends[0].get_texts()]
    assert "reconstructed data, held out" in labels


def test_published_curves_only_where_wanted(rut):
    def legend(reference):
        fig = bands_plate(rut, reference=reference).figure
        return [t.get_text() for t in fig.legends[0].get_texts()]

    assert "published fit (Table 6)" in legend(HE2019)
    assert not any("published" in t for t in legend(NOTHING))


def test_published_curve_of_the_rut_is_equation_21(rut):
    conditions = {"average_ground_pressure_kpa": np.array([150.0]), "slip_ratio": np.array([0.1])}
    depth, source = HE2019.curve("modified_bekker", conditions)
    assert depth[0] == pytest.approx(1000 * (150 / 3.306e5) ** (1 / (1.996 + 0.1266)))
    assert source == "Table 6"


def test_published_figures_on_the_sampled_scale(drawbar):
    marks = HE2019.sampled(drawbar.calibration.problem.bound)
    assert marks["D_lo"] == pytest.approx(1.6480)
    assert marks["K_hi"] == pytest.approx(0.1265 * 1.4802 * 0.5954)
    mean = 0.5 * (1.6480 + 0.5954)
    assert marks["D_bend"] == pytest.approx(1.0 - 1.0071 / mean)
    assert set(marks) <= set(drawbar.calibration.problem.names)


def test_validation_caption_has_the_scores(rut):
    s = rut.validation.scores
    caption = validation_plate(rut, reference=HE2019).caption
    assert "9 held-out rows (reconstructed data)" in caption
    assert f"{100 * s.max_relative_error:.1f} % at most" in caption
    assert f"90 % band {s.coverage[0.9].hits} of 9" in caption


def test_validation_shows_the_limits_of_the_source(rut):
    labels = [t.get_text() for t in validation_plate(rut, reference=HE2019).figure.legends[0]
              .get_texts()]  # fmt: skip
    assert any("held out: 9.7 %" in t for t in labels)
    assert any("fitted: 13 %" in t for t in labels)


def test_leave_one_out_shows_pareto_k(density):
    plate = validation_plate(density, reference=HE2019)
    assert plate.figure.axes[0].get_ylabel().startswith("Pareto k")
    assert plate.caption.endswith(f"{len(density.validation.refitted)} of 36 rows needed a refit "
                                  "(Pareto k above 0.7).")  # fmt: skip


def test_ensembles_caption_says_when_the_gate_is_not_passed(rut, unconverged):
    assert "agree" in ensembles_plate(rut).caption
    assert "do NOT pass" in ensembles_plate(unconverged).caption


def test_estimates_caption_names_the_published_figures_outside(rut):
    caption = estimates_plate(rut, reference=HE2019).caption
    outside = [
        name
        for name, figure in (("n0", 1.996), ("n1", 1.266), ("k", 3.306e5))
        if not rut.calibration.summary[name].hdi_lower
        <= figure
        <= rut.calibration.summary[name].hdi_upper
    ]
    assert ("All published" in caption) == (not outside)
    for name in outside:
        assert name in caption


@pytest.mark.parametrize(
    ("ratio", "moved", "role"),
    [(0.99, 0.1, PRIOR), (0.99, 0.8, MOVED), (0.7, 0.0, BOTH), (0.2, 3.0, DATA), (0.9, 0.0, BOTH),
     (float("nan"), 0.0, "")],
)  # fmt: skip
def test_roles(ratio, moved, role):
    assert role_of(ratio, moved) == role


def test_two_pressures_leave_the_curvature_to_the_prior(drawbar):
    caption = learned_plate(drawbar, reference=HE2019).caption
    part = next(p for p in caption.split(";") if "set by the prior" in p)
    assert "K_bend" in part
    assert "D_bend" in part


def test_prior_predictive_caption_compares_widths(rut):
    caption = prior_predictive_plate(rut).caption
    ratio = float(re.search(r"is (\d[\d.]*) times as wide", caption).group(1))
    assert ratio > 2.0


def test_residuals_are_in_noise_sds(rut):
    residual = standardise(rut.calibration, rut.calibration.problem).residual
    assert residual.std() == pytest.approx(1.0, abs=0.25)
    changes, pairs = signs_along(rut, residual)
    assert pairs == 18 - 2
    assert 0 <= changes <= pairs
    assert signs_along(rut, np.ones(18)) == (0, 16)


def with_residuals(drawbar, high, low):
    """Give the two calibrated pressures residuals of a known spread."""
    problem = drawbar.calibration.problem
    table = problem.table
    rng = np.random.default_rng(5)
    noise = np.where(table["inflation_pressure_psi"] < 30.0, high, low)
    predicted = standardise(drawbar.calibration, problem).predicted
    columns = dict(table.columns) | {
        "drawbar_pull_kn": predicted + noise * rng.standard_normal(len(table))
    }
    told = problem.with_table(replace(table, columns=columns))
    return replace(drawbar, calibration=replace(drawbar.calibration, problem=told))


def test_scatter_that_differs_between_pressures_is_on_the_card(drawbar):
    found = judge_evidence(with_residuals(drawbar, 0.2, 0.02).evidence)
    (uneven,) = (remark for remark in found.remarks if remark.title == "Scatter is uneven")
    assert "too narrow at 18 psi" in uneven.text
    assert "too wide at 42 psi" in uneven.text
    assert uneven.text in found.fails
    assert found.trust.startswith("the median at 18 and 42 psi")
    # Of two pressures each value is nearest to one.
    assert all(uneven.concerns({"inflation_pressure_psi": np.array([p])}) for p in (10.0, 25.0))
    same = judge_evidence(with_residuals(drawbar, 0.05, 0.05).evidence)
    assert not any("too narrow" in text for text in same.fails)


def test_by_pressure_says_which_pressures_were_calibrated(drawn):
    figure = next(p for p in drawn["drawbar"] if p.name == "by_pressure").figure
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert "18 and 42 psi calibrated jointly, 90 %" in labels
    assert not any("all pressures" in label for label in labels)


def test_residuals_show_every_row(drawbar):
    fig = residuals_plate(drawbar).figure
    shown = sum(len(line.get_xdata()) for line in fig.axes[1].lines if line.get_marker() != "None")
    assert shown == 42


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


def test_a_figure_that_fails_does_not_stop_the_rest(rut, monkeypatch):
    def broken(*args, **kwargs):
        raise RuntimeError("no luck")

    monkeypatch.setattr(collect, "learned_plate", broken)
    found = {p.name: p for p in plates(rut, reference=HE2019)}
    assert found["learned"].figure is None
    assert "no luck" in found["learned"].caption
    assert found["corner"].figure is not None


def test_the_users_style_neither_leaks_in_nor_is_changed():
    rcParams["font.size"] = 33.0
    try:
        with style():
            assert rcParams["font.size"] == 8.0
        assert rcParams["font.size"] == 33.0
    finally:
        rcParams["font.size"] = 10.0


def test_corner_marks_lie_inside_their_panels(drawbar):
    ax = corner_plate(drawbar, reference=HE2019).figure.axes[0]
    dashed = [c for c in ax.collections if isinstance(c, LineCollection)
              and c.get_linestyle()[0][1] is not None]  # fmt: skip
    ends = np.concatenate([np.array(s) for c in dashed for s in c.get_segments()])
    assert ends.size
    assert ends.min() >= 0.0
    assert ends.max() <= 11.0
