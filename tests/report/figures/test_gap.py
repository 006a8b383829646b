"""Figures of a diagnosis: complete, labelled, and showing the numbers that they are given."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.collections import PathCollection

from calib.gap.diagnose import placebos
from calib.gap.effects import EFFECTS
from calib.gap.mixture import Region
from calib.report.figures import gap as collect
from calib.report.figures.gap import (
    gap_plates,
    in_play,
    placebo_plate,
    probability_text,
    which_plate,
)
from calib.report.gap_facts import (
    EVERYWHERE,
    output_axis,
    output_rows,
    panel_groups,
    region_text,
    short_name,
    title_of,
)
from tests.gap.cases import diagnosis_of, pull_diagnosis

NAMES = ("isolability", "where", "where_conditions", "which", "how_far", "placebo", "left_over")
UNIT = re.compile(r"\(.+\)$")


@pytest.fixture(scope="module")
def found():
    return diagnosis_of("sensor_drift")


@pytest.fixture(scope="module")
def drawn(found):
    return {p.name: p for p in gap_plates(found)}


def test_every_figure_is_drawn(drawn):
    assert [p.caption for p in drawn.values() if p.figure is None] == []
    assert tuple(drawn) == NAMES
    assert all(p.heading and len(p.caption) > 60 for p in drawn.values())


@pytest.mark.parametrize("case", [None, "pull"])
def test_a_null_and_a_single_output_are_drawn_too(case):
    other = diagnosis_of(None) if case is None else pull_diagnosis(None)
    plates = gap_plates(other)
    assert [p.caption for p in plates if p.figure is None] == []
    assert tuple(p.name for p in plates) == NAMES


def test_labels_have_units(drawn):
    for name in ("where", "how_far", "left_over", "which", "placebo"):
        for ax in drawn[name].figure.axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                assert not label or UNIT.search(label), (name, label)


def test_nothing_is_cut_off(found, drawn):
    for p in [*drawn.values(), *gap_plates(with_long_names(found), ["isolability"])]:
        p.figure.draw_without_rendering()
        inside = p.figure.bbox.padded(2.0)
        for ax in p.figure.axes:
            box = ax.get_tightbbox()
            if ax.axison and box is not None:
                assert inside.x0 <= box.x0, (p.name, box)
                assert box.x1 <= inside.x1, (p.name, box)
                assert inside.y0 <= box.y0, (p.name, box)
                assert box.y1 <= inside.y1, (p.name, box)


def with_long_names(found):
    """Return the diagnosis with effects in its design of longer names than those shipped."""
    design = found.ranking.identifiability
    new = {name: f"depends_on_{name}_and_soil_temperature" for name in sorted(design.absorbed)}
    new[min(new)] = "depends_on_soil_temperature"
    design = replace(
        design,
        absorbed={new[n]: v for n, v in design.absorbed.items()},
        detectable={new[n]: v for n, v in design.detectable.items()},
        cosine_similarity={
            tuple(sorted((new[a], new[b]))): v for (a, b), v in design.cosine_similarity.items()
        },
    )
    return replace(found, ranking=replace(found.ranking, identifiability=design))


def test_every_row_is_shown_once_in_where(found, drawn):
    points = [c for ax in drawn["where"].figure.axes for c in ax.collections
              if isinstance(c, PathCollection)]  # fmt: skip
    assert sum(len(c.get_offsets()) for c in points) == 2 * 27
    shown = np.sort(np.concatenate([np.asarray(c.get_array()) for c in points]))
    given = np.sort(np.concatenate([g.probability for g in found.gaps]))
    np.testing.assert_allclose(shown, given)
    pull = output_rows(found)[0]
    groups = panel_groups(found, pull.rows)
    assert [title for title, _ in groups] == ["18 psi", "30 psi", "42 psi"]
    counts = np.sum([mask for _, mask in groups], axis=0)
    np.testing.assert_array_equal(counts, 1)


def test_many_pressures_are_binned_each_row_once(found):
    view = found.data.view
    psi = np.linspace(10.0, 50.0, 27)
    many = replace(
        found,
        data=replace(
            found.data,
            view=replace(view, conditions={**view.conditions, "inflation_pressure_psi": psi}),
        ),
    )
    groups = panel_groups(many, many.data.outputs[0].rows)
    assert len(groups) == 3
    np.testing.assert_array_equal(np.sum([mask for _, mask in groups], axis=0), 1)


def test_rows_hold_what_was_measured_and_predicted(found):
    pull, rut = output_rows(found)
    np.testing.assert_array_equal(pull.measured, found.data.case.field["drawbar_pull_kn"])
    np.testing.assert_array_equal(rut.measured, found.data.case.field["rut_depth_mm"])
    # The correction explains the drift: it leaves less than the simulator does.
    before, after = pull.measured - pull.before, pull.measured - pull.after
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))


def test_captions_count_what_the_records_say(found, drawn):
    likely = int((found.gaps[0].probability > 0.5).sum())
    assert f"Drawbar pull: {likely} of 27 rows" in drawn["where"].caption
    for region in found.regions:
        assert region_text(found, region) in drawn["where_conditions"].caption
    beyond = sum(
        int((np.abs(r) > 2.0).sum())
        for r in found.ranking.best("sensor_drift").field_residuals.values()
    )
    assert f"{beyond} of 54 lie beyond" in drawn["left_over"].caption


def test_bars_have_the_probabilities(found, drawn):
    ax = drawn["which"].figure.axes[0]
    widths = [bar.get_width() for bar in ax.patches]
    labels = [t.get_text().replace("\n", " ") for t in ax.get_yticklabels()]
    expected = {short_name(n): p for n, p in found.ranking.probability.items()}
    assert {"none (noise)", "unknown effect", "parameter shift"} <= set(labels)
    for label, width in zip(labels, widths, strict=True):
        assert width == pytest.approx(expected[label])


def test_the_longest_names_stay_on_the_paper(found):
    longest = "+".join([*sorted(EFFECTS, key=len)[-2:], "unknown"])
    p = found.ranking.probability | {longest: 1.0}
    fits = found.ranking.fits | {longest: found.ranking.fits[found.ranking.order[0]]}
    other = replace(found, ranking=replace(found.ranking, probability=p, fits=fits))
    figure = which_plate(other).figure
    figure.draw_without_rendering()
    label = figure.axes[0].get_yticklabels()[0]
    assert label.get_text().replace("\n", " ") == short_name(longest)
    assert label.get_window_extent().x0 >= 0.0


def test_names_of_several_causes_have_the_room_of_their_lines(found):
    names = ["+".join(sorted(EFFECTS)[i : i + 4]) for i in range(5)]
    even = {**dict.fromkeys(names, 0.19), "none": 0.05}
    many = replace(found, ranking=replace(found.ranking, probability=even))
    figure = which_plate(many).figure
    figure.draw_without_rendering()
    boxes = [label.get_window_extent() for label in figure.axes[0].get_yticklabels()]
    assert all(label.get_text() for label in figure.axes[0].get_yticklabels())
    assert all(above.y0 >= below.y1 for above, below in pairwise(boxes))


def test_a_tie_is_said_and_hatched(found):
    even = dict.fromkeys(found.ranking.probability, 0.0)
    even |= {"lug_thrust": 0.5, "force_offset": 0.4, "none": 0.1}
    tied = replace(found, ranking=replace(found.ranking, probability=even))
    assert in_play(tied) == ["lug_thrust", "force_offset", "none"]
    plate = {p.name: p for p in gap_plates(tied)}["which"]
    assert "No data here separate lug thrust (50 %), force offset (40 %)" in plate.caption
    hatched = [bar for bar in plate.figure.axes[0].patches if bar.get_hatch()]
    assert len(hatched) == 3


def test_placebos_do_not_depend_on_the_unit_that_is_drawn(found, monkeypatch):
    in_kn = placebos(found)
    monkeypatch.setattr("calib.report.gap_facts._SMALL_PULL", np.inf)  # as a small wheel's, in N
    assert output_axis(found, "drawbar_pull").unit == "N"
    assert placebos(found).before == pytest.approx(in_kn.before)


def test_what_no_effect_removes_is_explained(found):
    caption = placebo_plate(found).caption
    assert "Without any effect, none (noise), " in caption
    assert "estimates the model's parameters anew from both campaigns" in caption


def test_shrink_bars_have_the_shrink(found, drawn):
    s = found.shrink["drawbar_pull"]
    heights = [bar.get_height() for bar in drawn["how_far"].figure.axes[2].patches]
    assert heights == pytest.approx([s.rmse_before, s.rmse_after])
    assert f"{100 * s.fraction:.0f} %" in drawn["how_far"].caption


def test_the_pull_of_a_small_wheel_is_in_newtons(found):
    case = found.data.case
    assert output_axis(found, "drawbar_pull").unit == "kN"
    columns = dict(case.field.columns)
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"] * 1e-3
    small = replace(case, field=replace(case.field, columns=columns))
    axis = output_axis(replace(found, data=replace(found.data, case=small)), "drawbar_pull")
    assert (axis.unit, axis.factor) == ("N", 1000.0)


def test_words():
    assert short_name("lug_thrust+rate_effect") == "lug thrust + rate effect"
    assert title_of(diagnosis_of(None), "lug_thrust").startswith("tread lugs")
    assert title_of(diagnosis_of(None), "force_offset+lug_thrust").count(", and ") == 1
    assert probability_text(0.999) == "> 99 %"
    assert probability_text(0.004) == "< 1 %"
    assert probability_text(0.42) == "42 %"


def test_words_of_regions():
    found = diagnosis_of(None)

    def text(column: str, *ends: float) -> str:
        return region_text(found, Region("drawbar_pull", {column: ends}, 1.0, (0.5, 1.5), 1.0))

    assert text("slip_ratio", 0.304, 0.6) == "slip 30 to 60 %"
    assert text("pass_number", 3.0, 3.0) == "pass 3"
    slip = found.data.view.conditions["slip_ratio"]
    assert text("slip_ratio", float(slip.min()), float(slip.max())) == EVERYWHERE


def test_a_figure_that_fails_does_not_stop_the_rest(found, monkeypatch):
    def broken(found):
        raise RuntimeError("no luck")

    monkeypatch.setitem(collect._DRAWINGS, "which", broken)
    plates = {p.name: p for p in gap_plates(found)}
    assert plates["which"].figure is None
    assert "no luck" in plates["which"].caption
    assert plates["how_far"].figure is not None
