"""What a plan of tests prints and writes."""

from __future__ import annotations

import json
import re
from pathlib import Path

from calib.models import example_csv
from tests.commands import Calib
from tests.docs.pages import DOCS

GRID = """\
slip_percent,average_ground_pressure_psi,cost,note
5,15,1,near
20,20,2,far
95,20,1,off
"""


def test_a_plan_is_printed_and_written_to_be_filled_in(calib: Calib, run: Path) -> None:
    Path("grid.csv").write_text(GRID)
    found = calib("plan", "run", "--grid", "grid.csv", "--budget", 3, "--out", "tests.csv")
    assert found.code == 0, found.err
    first = r"\d tests? reduces? the width of the 90 % band of the mean from 100 % to \d+ %"
    assert re.match(first, found.out)
    header, *rows = Path("tests.csv").read_text().splitlines()
    assert header == "slip_percent,average_ground_pressure_psi,cost,note,rut_depth_mm"
    assert all(row.rsplit(",", 1)[0] in GRID for row in rows)
    assert all(row.endswith(",") for row in rows)
    assert ("outside the calibrated range" in found.err) == ("95,20" in "".join(rows))
    again = calib("plan", "run", "--grid", "grid.csv", "--budget", 3, "--out", "tests.csv")
    assert again.code == 2
    assert "may be filled in" in again.err


def test_every_key_of_its_json_is_told(calib: Calib, run: Path) -> None:
    Path("grid.csv").write_text(GRID)
    Path("at.csv").write_text("slip_percent,average_ground_pressure_psi\n10,18\n")
    median = json.loads(calib("predict", "run", "--at", "at.csv", "--json").out)["columns"]
    level = f"rut_depth_mm={median['rut_depth_mm_median'][0]}"
    words = ("--budget", 2, "--at", "at.csv", "--exceeds", level, "--json")
    ran = calib("plan", "run", "--grid", "grid.csv", *words)
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert found["aim"] == "decision"
    assert len(found["tests"]["slip_percent"]) == len(found["cost"])
    told = (DOCS / "formats" / "results.md").read_text(encoding="utf-8")
    assert all(f"`{key}`" in told for key in found)


def test_a_run_that_did_not_converge_is_said_first(calib: Calib) -> None:
    Path("my.csv").write_text(example_csv("magic_formula_pressure"))
    calib("fit", "my.csv", "--model", "magic_formula_pressure", "--max-steps", 100, "--out", "run")
    found = calib("plan", "run", "--grid", "my.csv", "--budget", 2, "--out", "tests.csv")
    assert found.code == 3
    assert found.err.startswith("calib: this calibration did not converge")
    assert Path("tests.csv").read_text().splitlines()[0].endswith(",converged,drawbar_pull_kn")
