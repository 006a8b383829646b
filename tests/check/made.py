"""A small report, a whole one, a run and a comparison; the first three as another processor would.

As a program: python -m tests.check.made FOLDER KIND ...; each gets its name in the folder.
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

from calib.data import hold_out, read_table
from calib.he2019.audit import Seeds
from calib.he2019.embedded import he2019_tasks, load_he2019
from calib.he2019.gaps import paper_gaps
from calib.he2019.sections import AuditSection, GapsSection
from calib.inference.calibration import Calibration, calibrate
from calib.inference.diagnostics import Gate
from calib.inference.estimators import estimate
from calib.inference.io import save_calibration
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampler import SamplerSettings
from calib.models import example_csv
from calib.report.comparison import write_comparison
from calib.report.figures.bands import bands_plate
from calib.report.figures.posterior import learned_plate
from calib.report.figures.style import Plate, style
from calib.report.reference import NOTHING, Reference
from calib.report.sections import Report, work_out
from calib.report.study import OutputResult, Task
from calib.report.writer import write_report
from calib.validation.comparison import compare
from tests.check.kernels import Setting, skip_what_crashes

ROOT = Path(__file__).resolve().parents[2]
# Short chains, and a gate that lets them pass.
SETTINGS = SamplerSettings(steps=100, gate=Gate(taus_min=20.0))


def two_plates(result: OutputResult, reference: Reference = NOTHING) -> list[Plate]:
    """Drawing takes most of the time of a report: two figures do for these tests."""
    with style():
        return [
            bands_plate(result, reference=reference),
            learned_plate(result, reference=reference),
        ]


def rut_tasks() -> list[Task]:
    return [task for task in he2019_tasks() if task.output == "rut_depth"]


@cache
def rut_study(seed: int = 2019) -> Report:
    return work_out(rut_tasks(), seed, settings=SETTINGS)


def write(found: Report, out: Path, **kwargs: Any) -> Path:
    with patch("calib.report.figures.collect.plates", two_plates):
        write_report(
            found, out, settings=SETTINGS, command=["calib", "report"], title="A report", **kwargs
        )
    return out


def report(out: Path) -> Path:
    """A report of rut depth, posterior included."""
    return write(rut_study(), out)


def whole(out: Path) -> Path:
    """A report with one of the source's gaps, the audit and figures for print."""
    gaps = [gap for gap in paper_gaps() if gap.name == "plain_bekker"]
    sections = [GapsSection(gaps), AuditSection(Seeds(1, 1, 1))]
    found = work_out(rut_tasks(), 2019, settings=SETTINGS, sections=sections)
    return write(found, out, pdf=True)


def run(out: Path) -> Path:
    """A run as `calib fit` makes it."""
    table = load_he2019("rut_depth")
    fitted = table.take(table["inflation_pressure_psi"] != 30.0)
    out.mkdir()
    save_calibration(fitted_run(build_problem("modified_bekker", fitted), 2019), out)
    return out


def comparison(out: Path, seed: int = 2019) -> Path:
    """Two models of plates as `calib compare` compares them, one width held out."""
    path = out.with_suffix(".csv")
    path.write_text(example_csv("reece"))
    fitted, held = hold_out(read_table(path), "plate_width_mm", 80.0)
    found = compare(["bekker_plate", "bekker"], fitted, seed, held_out=held, settings=SETTINGS)
    out.mkdir()
    write_comparison(found, out, ["calib", "compare"], "plate_width_mm=80")
    return out


def fitted_run(problem: Problem, seed: int) -> Calibration:
    rng = generator(seed, problem.bound.model.name, "least_squares")
    point = estimate(problem, "least_squares", rng)
    return calibrate(problem, seed, estimates=(point,), settings=SETTINGS)


KINDS = {"report": report, "whole": whole, "run": run}


def elsewhere(folder: Path, setting: Setting, *kinds: str) -> Path:
    """Make some of them as another processor would, in one process."""
    skip_what_crashes(setting)
    subprocess.run(
        [sys.executable, "-m", "tests.check.made", str(folder), *kinds],
        env=setting.environment(), cwd=ROOT, check=True, capture_output=True,
    )  # fmt: skip
    return folder


if __name__ == "__main__":
    for kind in sys.argv[2:]:
        KINDS[kind](Path(sys.argv[1]) / kind)
