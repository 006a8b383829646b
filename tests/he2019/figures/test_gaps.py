"""The figure of a gap shows the errors that it is given, with units and a key."""

from __future__ import annotations

import re

import numpy as np
import pytest

from calib.he2019.figures import gap_plate
from calib.report.gap_facts import output_rows

UNIT = re.compile(r"\(.+\)$")


@pytest.mark.parametrize(
    "name", ["plain_bekker", "nominal_slip", "held_out_pull", "post_peak_18_psi"]
)
def test_errors_before_and_after_are_drawn_with_units_and_a_key(found_gaps, name):
    result = found_gaps[name]
    plate = gap_plate(result)
    assert plate.figure is not None
    before, after, which = plate.figure.axes
    own = output_rows(result.found)[0]
    for ax, predicted in ((before, own.before), (after, own.after)):
        drawn = np.concatenate(
            [line.get_ydata() for line in ax.lines if line.get_marker() not in ("None", "", None)]
        )
        errors = own.measured - predicted
        assert all(np.isclose(drawn, error).any() for error in errors)
        kept_out = 0 if result.gap.unfitted is None else len(result.gap.unfitted)
        assert drawn.size == errors.size + kept_out
    assert before.get_ylim() == after.get_ylim()
    assert UNIT.search(before.get_ylabel())
    assert all(UNIT.search(ax.get_xlabel()) for ax in plate.figure.axes)
    (legend,) = plate.figure.legends
    words = [text.get_text() for text in legend.get_texts()]
    assert "90 % of the noise" in words
    assert any("psi" in word for word in words)
    widths = [bar.get_width() for bar in which.patches]
    p = result.found.ranking.probability
    assert widths == pytest.approx([p[n] for n in result.found.ranking.order[: len(widths)]])
    # What is written beside the longest bar stays on the figure.
    plate.figure.canvas.draw()
    right = max(text.get_window_extent().x1 for text in which.texts)
    assert right <= plate.figure.bbox.x1


def test_the_caption_tells_the_errors(found_gaps):
    result = found_gaps["plain_bekker"]
    own = output_rows(result.found)[0]
    rms = float(np.sqrt(np.mean((own.measured - own.before) ** 2)))
    assert f"{rms:.1f} mm rms" in gap_plate(result).caption
