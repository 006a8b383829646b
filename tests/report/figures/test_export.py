"""Pictures depend neither on what was drawn before nor on more imports than a diagnosis needs."""

import subprocess
import sys
from pathlib import Path

from matplotlib.figure import Figure

from calib.report.figures.style import png_bytes, style
from calib.report.page.template import png_size


def _figure(title: str) -> Figure:
    with style():
        figure = Figure(figsize=(2.0, 1.5))
        figure.subplots().set_title(title)
    return figure


def test_a_picture_is_the_same_whatever_was_drawn_before() -> None:
    code = (
        "import sys; from tests.report.figures.test_export import _figure, png_bytes\n"
        "sys.stdout.buffer.write(png_bytes(_figure('$k_\\\\phi$')))"
    )
    here = Path(__file__).parents[3]
    alone = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, cwd=here)
    png_bytes(_figure(r"$\sigma^2$"))
    assert png_bytes(_figure(r"$k_\phi$")) == alone.stdout
    assert png_bytes(_figure(r"$k_c$")) != alone.stdout


def test_a_picture_has_the_size_of_its_figure() -> None:
    assert png_size(png_bytes(_figure("x"))) == (300, 225)


def test_the_page_of_a_diagnosis_needs_no_study() -> None:
    code = "import sys, calib.report.page.diagnosis; print('calib.report.study' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert done.stdout.strip() == "False"
