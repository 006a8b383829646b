"""Figures in print: a journal's sizes, text that is read and does not collide, colours for all."""

from __future__ import annotations

import hashlib
import itertools
import os
import re
import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest
from colorspacious import cspace_convert
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from calib.report.figures.bands import FILLS
from calib.report.figures.posterior import ensembles_plate
from calib.report.figures.style import (
    CYCLE,
    DASHES,
    DOUBLE_MM,
    MARKERS,
    MIDDLE_MM,
    SINGLE_MM,
    SMALLEST_PT,
    Plate,
    pdf_bytes,
    png_bytes,
    style,
)
from calib.report.page.template import png_size


@pytest.fixture(scope="module")
def drawn(all_plates) -> dict[str, Plate]:
    return {f"{key} {p.name}": p for key, found in all_plates.items() for p in found}


def words(figure: Figure) -> list[Text]:
    """Every text that is seen."""
    hidden = set()
    for ax in figure.axes:
        if not ax.get_visible() or not ax.axison:
            hidden |= set(map(id, [ax.xaxis.label, ax.yaxis.label, ax.title]))
        for axis, (low, high) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
            low, high = sorted((low, high))
            slack = 1e-6 * (high - low)
            shown = ax.get_visible() and ax.axison
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not shown or not low - slack <= tick.get_loc() <= high + slack:
                    hidden |= {id(tick.label1), id(tick.label2)}
    return [
        t for t in figure.findobj(Text)
        if t.get_visible() and t.get_text().strip() and id(t) not in hidden
    ]  # fmt: skip


def test_text_is_read_in_print_and_hides_nothing(drawn):
    """In a journal's widths no text is too small, cut off, too pale or over another."""
    for name, p in drawn.items():
        width, height = p.figure.get_size_inches() * 25.4
        assert min(abs(width - w) for w in (SINGLE_MM, MIDDLE_MM, DOUBLE_MM)) < 0.01, (name, width)
        assert height < 240.0, name
        seen, edge = [(t, t.get_window_extent()) for t in words(p.figure)], p.figure.bbox
        for t, box in seen:
            assert t.get_fontsize() >= SMALLEST_PT, (name, t.get_text())
            if re.search(r"\$.*[_^].*\$", t.get_text()):
                # Matplotlib sets subscripts at 0.7 of the size: 6 pt is the least in journals.
                assert 0.7 * t.get_fontsize() >= 6.0, (name, t.get_text())
            assert contrast(t.get_color(), "white") >= 4.5, (name, t.get_text())
            assert edge.x0 <= box.x0 <= box.x1 <= edge.x1, (name, t.get_text())
            assert edge.y0 <= box.y0 <= box.y1 <= edge.y1, (name, t.get_text())
        for (a, one), (b, other) in itertools.combinations(seen, 2):
            width = min(one.x1, other.x1) - max(one.x0, other.x0)
            height = min(one.y1, other.y1) - max(one.y0, other.y0)
            assert width <= 1.0 or height <= 1.0, (name, a.get_text(), b.get_text())
        for legend in p.figure.legends:
            box = legend.get_window_extent()
            for ax in p.figure.axes:
                if ax.get_visible() and ax.axison:
                    assert not box.overlaps(ax.get_window_extent()), name


def test_labels_of_traces_have_room_beside_long_tick_labels(drawbar):
    with style():
        figure = ensembles_plate(drawbar).figure
        seen = [ax for ax in figure.axes if ax.get_visible()]
        traces = seen[::2]
        for ax in traces:
            ax.set_yticks([np.mean(ax.get_ylim())], ["0.0555"])
        figure.draw_without_rendering()
    millimetre = figure.dpi / 25.4
    for ax in traces:
        label = ax.yaxis.label.get_window_extent()
        for other in seen:
            below = [other.xaxis.label, *other.get_xticklabels()] if other is not ax else []
            for box in [other.get_window_extent(), *(t.get_window_extent() for t in below)]:
                assert not label.overlaps(box.padded(millimetre)), ax.get_ylabel()


def contrast(one: str, other: str) -> float:
    """Contrast of two colours (WCAG 2.2)."""
    found = []
    for colour in (one, other):
        c = np.array(to_rgb(colour))
        linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        found.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    return (max(found) + 0.05) / (min(found) + 0.05)


def seen(colour: str, deficiency: str | None) -> np.ndarray:
    """Coordinates in CAM02-UCS, as eyes with a deficiency see it (Machado et al. 2009)."""
    rgb = np.array(to_rgb(colour))
    if deficiency is not None:
        space = {"name": "sRGB1+CVD", "cvd_type": deficiency, "severity": 100}
        rgb = np.clip(cspace_convert(rgb, space, "sRGB1"), 0.0, 1.0)
    return np.asarray(cspace_convert(rgb, "sRGB1", "CAM02-UCS"))


@pytest.mark.parametrize("deficiency", [None, "deuteranomaly", "protanomaly", "tritanomaly"])
def test_colours_are_told_apart_by_all_eyes(deficiency):
    # A difference of one is just seen side by side.
    points = [seen(colour, deficiency) for colour in CYCLE]
    nearest = min(float(np.linalg.norm(a - b)) for a, b in itertools.combinations(points, 2))
    assert nearest > 10.0
    # Colour is never alone: a marker, or a line style, says the same.
    assert len(set(MARKERS)) == len(CYCLE)
    assert len({str(d) for d in DASHES}) == len(DASHES)


@pytest.mark.parametrize("deficiency", [None, "deuteranomaly", "protanomaly", "tritanomaly"])
def test_bands_are_told_apart_by_lightness_alone(deficiency):
    lightness = [float(seen(c, deficiency)[0]) for c in ("#ffffff", *FILLS.values())]
    steps = -np.diff(lightness)
    assert (steps > 4.0).all(), steps


def test_a_pdf_has_true_type_fonts_and_its_size_in_print(drawn):
    figure = drawn["drawbar bands"].figure
    content = pdf_bytes(figure)
    assert b"/Subtype /Type3" not in content
    assert b"/FontFile2" in content
    assert b"CreationDate" not in content
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
    assert float(box[1]) / 72.0 * 25.4 == pytest.approx(DOUBLE_MM, abs=0.01)
    theirs = {"savefig.bbox": "tight", "pdf.fonttype": 3, "ytick.labelsize": 20.0}
    plain = png_bytes(figure)
    with mpl.rc_context(theirs):
        assert (pdf_bytes(figure), png_bytes(figure)) == (content, plain)
        with style():
            assert mpl.rcParams["pdf.fonttype"] == 42
        assert mpl.rcParams["pdf.fonttype"] == 3


def test_files_depend_neither_on_the_process_nor_on_what_was_drawn_before():
    code = (
        "import hashlib\n"
        "from calib.report.figures.style import panels, pdf_bytes, png_bytes, style\n"
        "with style():\n"
        "    figure, axes = panels(1, 1, height=30.0)\n"
        "    axes[0, 0].plot([0, 1], [1, 0], label='a')\n"
        "    axes[0, 0].set_xlabel(r'$\\gamma_\\mathrm{ref}$ (g/cm$^{3}$)')\n"
        "content = png_bytes(figure) + pdf_bytes(figure)\n"
    )
    other = subprocess.run(
        [sys.executable, "-c", code + "print(hashlib.sha256(content).hexdigest())"],
        capture_output=True, text=True, check=True, env=os.environ | {"PYTHONHASHSEED": "1"},
    ).stdout  # fmt: skip
    found: dict[str, bytes] = {}
    exec(code, found)
    assert hashlib.sha256(found["content"]).hexdigest() == other.strip()
    assert png_size(found["content"])[0] == int(DOUBLE_MM / 25.4 * 150)


def test_the_page_of_a_diagnosis_needs_no_study():
    code = "import sys, calib.report.page.diagnosis; print('calib.report.study' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert done.stdout.strip() == "False"
