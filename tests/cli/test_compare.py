"""`calib compare`, and `calib predict` on what it leaves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calib.batch.folders import check_folder
from calib.imports.tables import read_raw
from calib.models import example_csv
from calib.report.comparison import table
from tests.browser import Browser, faults
from tests.commands import Calib
from tests.inference.emulation.test_emulate import as_before as as_before
from tests.models.simulators.examples import lab, write_program

FEW = ["--max-steps", 200, "--workers", 1]


def test_models_are_compared_and_the_stack_predicts(calib: Calib) -> None:
    Path("plates.csv").write_text(example_csv("reece"))
    made = calib("compare", "reece", "bekker_plate", "plates.csv", "--out", "c", *FEW,
                 "--hold-out", "plate_width_mm=80")  # fmt: skip
    assert made.code in (0, 3), made.err
    found = json.loads(Path("c/comparison.json").read_text())
    assert found["verdict"] in made.out
    assert set(found["models"]) == {"reece", "bekker_plate"}
    assert abs(sum(m["weight"] for m in found["models"].values()) - 1.0) < 1e-9
    assert all(m["held_out"]["rows"] == 4 for m in found["models"].values())
    assert "figures/bands.png" in {p.relative_to("c").as_posix() for p in Path("c").rglob("*")}
    told = calib("predict", "c", "--at", "plates.csv", "--out", "bands.csv", "--exceeds",
                 "rut_depth_mm=20", "--draws", 50)  # fmt: skip
    assert told.code == (0 if found["converged"] else 3), told.err
    assert "rut_depth_mm_predictive_90_lower" in Path("bands.csv").read_text()
    answer = read_raw("bands.csv").frame
    deep, drawn = answer["rut_depth_mm_reading_above_20"], read_raw("bands_draws.csv").frame
    share = drawn.groupby("row")["rut_depth_mm_reading"].agg(lambda v: (v > 20.0).mean())
    np.testing.assert_allclose(share, deep, atol=5.0 * np.sqrt(0.25 / 50))
    again = calib("compare", "reece", "bekker_plate", "plates.csv", "--out", "c", *FEW)
    assert again.code == 2
    assert "--overwrite" in again.err
    Path("c/comparison.json").write_text("{}")
    broken = calib("predict", "c", "--at", "plates.csv")
    assert broken.code == 2
    assert "run `calib compare` again" in broken.err


@pytest.mark.slow
@pytest.mark.usefixtures("_one_figure")
def test_a_report_has_it_as_a_section(calib: Calib) -> None:
    rows = [line.rpartition(",") for line in example_csv("reece").split()[1:]]
    lines = ["average_ground_pressure_kpa,plate_width_mm,Sinkage [inch]"]
    lines += [f"{conditions},{float(depth) / 25.4!r}" for conditions, _, depth in rows]
    Path("plates.csv").write_text("\n".join(lines) + "\n")
    made = calib("report", "plates.csv", "--compare", "reece", "--compare", "bekker_plate",
                 "--hold-out", "plate_width_mm=80", "--out", "r", *FEW)  # fmt: skip
    assert made.code in (0, 3), made.err
    found = json.loads(Path("r/compared/comparison.json").read_text())
    assert found["verdict"] in made.out
    assert found["held_out"] == "plate_width_mm = 80"
    assert (
        json.loads(Path("r/manifest.json").read_text())["comparison"]["models"] == found["models"]
    )
    # In the unit of the file, and in millimetres for a machine.
    for page in ("r/index.html", "r/compared/index.html"):
        assert "held-out RMSE (inch)" in Path(page).read_text(encoding="utf-8")
    best, numbers = next(iter(found["models"].items()))
    (row,) = [cells for cells in table(found)[1] if cells[0] == best]
    assert float(row[4]) == pytest.approx(numbers["rmse"] / 25.4, rel=5e-3)
    for folder in ("r", "r/compared"):
        check_folder(Path(folder), overwrite=True)
    told = calib("check", "r", "--quick")
    assert told.code == 0, told.out
    assert calib("predict", "r/compared", "--at", "plates.csv").code == made.code


@pytest.mark.slow
@pytest.mark.parametrize("fitted", ["wheel", "upadhyaya"])
def test_a_report_compares_an_emulated_simulator_with_a_closed_form(
    calib: Calib, fitted: str
) -> None:
    columns = lab(np.random.default_rng(1))
    np.savetxt("lab.csv", np.stack(list(columns.values()), axis=1), delimiter=",",
               header=",".join(columns), comments="")  # fmt: skip
    simulator = write_program(Path())
    made = calib("report", "lab.csv", "--model", fitted, "--compare", "wheel",
                 "--compare", "upadhyaya", "--simulator", simulator, "--out", "r",
                 "--hold-out", "normal_load_kn=5", "--workers", 1, "--max-steps", 3200)  # fmt: skip
    assert made.code in (0, 3), made.err
    assert "wheel: emulated from" in made.out
    found = json.loads(Path("r/compared/comparison.json").read_text())
    assert found["verdict"] in made.out
    assert set(found["models"]) == {"wheel", "upadhyaya"}
    assert all(m["held_out"]["rows"] == 6 for m in found["models"].values())
    # The data are of the simulator's own equation, of which the noise is 0.03 kN.
    assert found["models"]["wheel"]["held_out"]["rmse"] < 0.06
    manifest = json.loads(Path("r/manifest.json").read_text())
    assert manifest["comparison"]["models"] == found["models"]
    assert manifest["emulators"]["wheel"]["passed"]
    told = calib("check", "r", "--quick", "--simulator", simulator)
    assert told.code == 0, told.out + told.err
    bands = calib("predict", "r/compared", "--at", "lab.csv", "--simulator", simulator,
                  "--out", "bands.csv")  # fmt: skip
    assert bands.code in (0, 3), bands.err
    assert len(Path("bands.csv").read_text().splitlines()) == 19


@pytest.mark.slow  # as pages of a report and a diagnosis do
def test_the_page_holds_in_a_browser(calib: Calib, browser: Browser) -> None:
    Path("plates.csv").write_text(example_csv("reece"))
    made = calib("compare", "reece", "bekker_plate", "plates.csv", "--out", "c", *FEW)
    assert made.code in (0, 3), made.err
    assert faults(browser, Path("c/index.html")) == []


def test_what_cannot_be_compared_is_refused(calib: Calib) -> None:
    Path("plates.csv").write_text(example_csv("bekker"))
    lone = calib("compare", "reece", "plates.csv")
    assert lone.code == 2
    assert "two or more models" in lone.err
    other = calib("compare", "reece", "magic_formula", "plates.csv")
    assert "the models predict different outputs" in other.err
    lacking = calib("compare", "reece", "bekker", "plates.csv")
    assert lacking.code == 2
    assert "plate_width_mm" in lacking.err
    assert not Path("calib-comparison").exists()
