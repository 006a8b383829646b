"""One verdict: what each verb says of the same rows, and what a prediction repeats of it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from calib.models import example_csv
from tests.commands import Calib

FEW = ["--max-steps", 800, "--workers", 1]
PLATES = Path(__file__).resolve().parents[3] / "shared" / "field" / "plates_negative_kc.csv"
KEPT = "plate_width_mm=80"


def soils(*factors: float) -> None:
    """Write the template once for each soil, which ruts are multiplied by, as my.csv."""
    head, *rows = csv.reader(example_csv("modified_bekker").splitlines())
    rut = head.index("rut_depth_mm")
    with Path("my.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow([*head, "soil bin"])
        for name, factor in zip("AB", factors, strict=True):
            for row in rows:
                out.writerow([*row[:rut], float(row[rut]) * factor, *row[rut + 1 :], name])


@pytest.mark.usefixtures("_one_figure")
def test_an_ignored_column_is_the_first_thing_that_fit_and_report_say(calib: Calib) -> None:
    soils(1.0, 0.6)
    ran = calib("fit", "my.csv", "--model", "modified_bekker", "--out", "run", *FEW)
    assert "the residuals differ with 'soil bin', a column that is not used" in ran.err
    said = "verdict: with care: A column explains the residuals"
    assert said in ran.out
    kept = json.loads(Path("run/run.json").read_text())["verdict"]
    assert kept["remarks"][0]["title"] == "A column explains the residuals"
    made = calib("report", "my.csv", "--model", "modified_bekker", "--out", "r", *FEW)
    assert f"rut_depth: {said}" in made.out
    page = Path("r/index.html").read_text(encoding="utf-8")
    card = page[page.index('class="card') : page.index("</article>")]
    assert card.index("not used") < card.index("Trust:")
    assert "Holds on unseen rows" not in card
    # The report holds what it takes to say so again.
    assert calib("check", "r", "--workers", 1).code == 0


def test_predict_says_first_that_rows_were_held_out_and_what_hangs_on_them(calib: Calib) -> None:
    Path("my.csv").write_text(example_csv("magic_formula_pressure"))
    fit = ("fit", "my.csv", "--model", "magic_formula_pressure", *FEW, "--overwrite")
    Path("between.csv").write_text("slip_percent,inflation_pressure_psi\n20,25\n")
    Path("fitted.csv").write_text("slip_percent,inflation_pressure_psi\n20,42\n")
    calib(*fit, "--out", "run", "--hold-out", "inflation_pressure_psi=30")
    between = calib("predict", "run", "--at", "between.csv")
    first, second, *_ = between.err.splitlines()
    assert "6 rows (inflation_pressure_psi = 30) were held out of this fit" in first
    assert "fit again without --hold-out" in first
    assert "two pressures do not determine a quadratic" in second
    fitted = calib("predict", "run", "--at", "fitted.csv").err
    assert "were held out" in fitted
    assert "quadratic" not in fitted
    told = json.loads(calib("predict", "run", "--at", "between.csv", "--json").out)
    assert "were held out" in told["doubts"][0]


@pytest.mark.skipif(not PLATES.exists(), reason="the shared field files are not here")
def test_sand_whose_pressures_grow_with_width(calib: Calib) -> None:
    """Least squares have kc = -406, sigma 0.09; with a share of at least zero 5 and 0.22."""
    ran = calib("fit", PLATES, "--model", "bekker_plate", "--hold-out", KEPT, "--out", "run",
                "--workers", 1, "--json")  # fmt: skip
    found = json.loads(ran.out)
    kc, sigma = found["posterior"]["kc"], found["posterior"]["sigma"]
    assert (kc["mean"], kc["sd"]) == (pytest.approx(-406.0, abs=25.0), pytest.approx(56.0, rel=0.2))
    assert sigma["mean"] == pytest.approx(0.092, abs=0.005)
    assert found["held_out"]["crps"] == pytest.approx(0.61, abs=0.03)
    calib("priors", "bekker_plate", "--out", "narrow.toml")
    text = Path("narrow.toml").read_text()
    bounded = 'dist = "uniform"\nlower = 0.0\nupper = 1.0'
    old = text[text.index('dist = "normal"') : text.index("upper = 1.0") + len("upper = 1.0")]
    Path("narrow.toml").write_text(text.replace(old, bounded))
    made = calib("compare", "bekker", "bekker_plate", PLATES, "--hold-out", KEPT, "--out", "c",
                 "--priors", "narrow.toml", "--workers", 1)  # fmt: skip
    assert "warning: bekker_plate: the posterior of share is pressed against 0" in made.err
    assert "bekker_plate: verdict: with care: Posterior at a bound" in made.out
    # As `fit` says of the model that leaves the width out.
    assert "bekker: verdict: with care: A column explains the residuals" in made.out
    assert "warning: bekker: plates_negative_kc.csv: residuals of neighbouring rows" in made.err
