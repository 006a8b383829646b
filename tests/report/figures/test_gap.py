"""Figures of a diagnosis: complete, labelled, and showing the numbers that they are given."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.collections import PathCollection

from calib.gap.effects import EFFECTS
from calib.report.figures.gap import gap_plates
from calib.report.gap_words import short_name
from calib.report.rows import output_rows, panel_groups
from tests.report.gap_documents import DOCUMENTS, PULL
from tests.report.gap_documents import gap as document

NAMES = ("isolability", "where", "where_conditions", "which", "how_far", "placebo", "left_over")
UNIT = re.compile(r"\(.+\)$")


LIKELY = DOCUMENTS["likely"]


@pytest.fixture(scope="module")
def drawn():
    return {p.name: p for p in gap_plates(LIKELY)}


@pytest.mark.parametrize("name", ["none", "trend"])
def test_every_figure_is_drawn(name):
    plates = gap_plates(DOCUMENTS[name])
    assert [p.caption for p in plates if p.figure is None] == []
    assert tuple(p.name for p in plates) == NAMES
    assert all(p.heading and len(p.caption) > 60 for p in plates)


def test_captions(drawn, snapshot):
    quiet = gap_plates(DOCUMENTS["unknown"])
    said = [f"{p.name}: {p.heading}. {p.caption}" for p in (*drawn.values(), *quiet)]
    assert "\n".join(said) == snapshot


def test_labels_have_units(drawn):
    for name in ("where", "how_far", "left_over", "which", "placebo"):
        for ax in drawn[name].figure.axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                assert not label or UNIT.search(label), (name, label)


def test_nothing_is_cut_off(drawn):
    design = LIKELY.design
    long = {n: f"depends_on_{n}_and_soil_temperature" for n in design.absorbed}
    design = replace(
        design, absorbed={long[n]: v for n, v in design.absorbed.items()},
        detectable={long[n]: v for n, v in design.detectable.items()}, likeness=(), alike=(),
    )  # fmt: skip
    for p in [*drawn.values(), *gap_plates(replace(LIKELY, design=design), ["isolability"])]:
        p.figure.draw_without_rendering()
        inside = p.figure.bbox.padded(2.0)
        for ax in p.figure.axes:
            box = ax.get_tightbbox()
            if ax.axison and box is not None:
                assert inside.x0 <= box.x0 <= box.x1 <= inside.x1, (p.name, box)
                assert inside.y0 <= box.y0 <= box.y1 <= inside.y1, (p.name, box)


def test_every_row_is_shown_once_in_where(drawn):
    points = [c for ax in drawn["where"].figure.axes for c in ax.collections
              if isinstance(c, PathCollection)]  # fmt: skip
    shown = np.sort(np.concatenate([np.asarray(c.get_array()) for c in points]))
    np.testing.assert_allclose(shown, np.sort(np.tile(PULL.probability, 2)))
    groups = panel_groups(LIKELY, np.arange(4))
    assert [title for title, _ in groups] == ["18 psi", "30 psi", "42 psi"]
    np.testing.assert_array_equal(np.sum([mask for _, mask in groups], axis=0), 1)


def test_many_pressures_are_binned_each_row_once():
    psi = tuple(np.linspace(10.0, 50.0, 27).tolist())
    groups = panel_groups(
        replace(LIKELY, conditions={"inflation_pressure_psi": psi}), np.arange(27)
    )
    assert len(groups) == 3
    np.testing.assert_array_equal(np.sum([mask for _, mask in groups], axis=0), 1)


def test_rows_are_on_the_scale_of_their_axis():
    small = replace(PULL, measured=tuple(1e-3 * v for v in PULL.measured))
    (own,) = output_rows(document("effect", {"lug_thrust": 0.9}, outputs=(small,)))
    np.testing.assert_allclose(own.measured, PULL.measured)
    np.testing.assert_allclose(own.gap, 1e3 * np.array(PULL.gap))


def test_bars_have_the_numbers(drawn):
    ax = drawn["which"].figure.axes[0]
    shown = {label.get_text().replace("\n", " "): bar.get_width()
             for label, bar in zip(ax.get_yticklabels(), ax.patches, strict=True)}  # fmt: skip
    assert shown == pytest.approx({short_name(n): p for n, p in LIKELY.probability.items()})
    heights = [bar.get_height() for bar in drawn["how_far"].figure.axes[2].patches]
    assert heights == pytest.approx([0.11, 0.04])


def test_a_tie_is_hatched_and_probable_special_hypotheses_are_shown():
    many = {f"e{i}": 0.1 for i in range(9)} | {"none": 0.05, "unknown": 0.05}
    (plate,) = gap_plates(document("ambiguous", many), ["which"])
    (ax,) = plate.figure.axes
    assert len([bar for bar in ax.patches if bar.get_hatch()]) == 8
    labels = [t.get_text() for t in ax.get_yticklabels()]
    assert labels[-2:] == ["none (noise)", "unknown effect"]


def test_long_names_have_the_room_of_their_lines_and_stay_on_the_paper():
    names = ["+".join(sorted(EFFECTS, key=len)[-4 - i :][:4]) for i in range(5)]
    (plate,) = gap_plates(document("ambiguous", dict.fromkeys(names, 0.19)), ["which"])
    plate.figure.draw_without_rendering()
    boxes = [label.get_window_extent() for label in plate.figure.axes[0].get_yticklabels()]
    assert all(box.x0 >= 0.0 for box in boxes)
    assert all(above.y0 >= below.y1 for above, below in pairwise(boxes))
