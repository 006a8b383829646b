"""What a prediction prints, and what it answers."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

import calib as package
from calib.cli.prediction import _give
from calib.models import example_csv
from tests.commands import Calib, assert_refused

AT = "Average ground pressure [psi],slip_percent\n10,5\n20,10\n30,10\n"


@pytest.fixture
def at() -> str:
    Path("at.csv").write_text(AT, encoding="utf-8")
    return "at.csv"


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(text.splitlines()))


def column(text: str, name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows_of(text)])


def test_what_is_printed_is_the_file_that_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {"Rut depth [mm], mean": [1.5, 20.0], "note": ["wet, soft", 'a "dry" one']}
    _give(columns, None)
    printed = capsys.readouterr().out
    assert list(csv.reader(printed.splitlines())) == [
        [*columns], ["1.5", "wet, soft"], ["20", 'a "dry" one'],
    ]  # fmt: skip
    _give(columns, tmp_path / "written.csv")
    assert (tmp_path / "written.csv").read_text() == printed


def test_questions_are_answered_in_columns_of_their_own(calib: Calib, run: Path, at: str) -> None:
    asked = ["predict", run, "--at", at, "--exceeds", "rut_depth_cm=2", "--below",
             "rut_depth_mm=20", "--quantiles", "0.05,0.95"]  # fmt: skip
    ran = calib(*asked)
    assert ran.code == 0, ran.err
    deep, shallow = (column(ran.out, f"rut_depth_{n}") for n in
                     ("cm_mean_above_2", "mm_mean_below_20"))  # fmt: skip
    np.testing.assert_allclose(deep + shallow, 1.0, atol=1e-5)
    assert (column(ran.out, "rut_depth_cm_reading_above_2_error") > 0.0).all()
    for q, end in ((0.05, "lower"), (0.95, "upper")):
        for kind, banded in (("mean", "parameter"), ("reading", "predictive")):
            np.testing.assert_array_equal(
                column(ran.out, f"rut_depth_mm_{kind}_q{q}"),
                column(ran.out, f"rut_depth_mm_{banded}_90_{end}"),
            )
    assert ran.out.splitlines()[0].endswith(",outside_calibrated_range")
    assert "probability of rut_depth_cm > 2 in all rows: mean " in ran.err
    told = json.loads(calib(*asked, "--json").out)["everywhere"]
    assert [one["asked"] for one in told] == ["rut_depth_cm > 2", "rut_depth_mm < 20"]
    table = package.read_table(at)
    found = package.predict(package.load_calibration(run), table).probability(">", 20.0)
    np.testing.assert_allclose(deep, found.mean.value, atol=1e-5)
    assert told[0]["reading"] == pytest.approx(float(found.reading_everywhere.value))


def test_draws_are_written_beside(calib: Calib, run: Path, at: str) -> None:
    asked = ["predict", run, "--at", at, "--draws", 40, "--out", "p.csv"]
    assert calib(*asked).code == 0
    drawn = Path("p_draws.csv").read_text(encoding="utf-8")
    assert column(drawn, "row")[:4].tolist() == [1, 2, 3, 1]
    assert column(drawn, "draw")[[0, 3, -1]].tolist() == [1, 2, 40]
    found = package.predict(package.load_calibration(run), package.read_table(at)).draws(40)
    np.testing.assert_allclose(column(drawn, "rut_depth_mm_mean"), found.mean.values.ravel())
    np.testing.assert_allclose(column(drawn, "rut_depth_mm_reading"), found.reading.values.ravel())
    assert_refused(calib(*asked), ["p.csv", "the file exists already"])
    assert calib(*asked, "--overwrite").code == 0
    Path("p_draws.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    assert_refused(calib(*asked, "--overwrite"), ["p_draws.csv", "no prediction"])
    Path("p_draws.csv").unlink()
    many = calib(*asked[:5], 9000, *asked[6:], "--overwrite")
    assert "4000 draws of each row written to p_draws.csv" in many.out


def test_a_peak_is_sought_along_a_condition(calib: Calib, run: Path, at: str) -> None:
    """Ruts grow with slip, so that no peak is inside."""
    ran = calib("predict", run, "--at", at, "--peak-over", "slip_percent")
    assert ran.code == 0, ran.err
    assert column(ran.out, "Average ground pressure [psi]").tolist() == [10.0, 20.0, 30.0]
    assert (column(ran.out, "rut_depth_mm_peak_at_slip_percent_median") == 10.0).all()
    assert (column(ran.out, "rut_depth_mm_peak_inside") < 0.05).all()
    assert "at 3 of 3 settings the peak may lie beyond the range of slip_percent" in ran.err
    top = calib("predict", run, "--at", at).out
    np.testing.assert_allclose(
        column(ran.out, "rut_depth_mm_peak_median")[1:],
        column(top, "rut_depth_mm_parameter_50_lower")[1:] / 2.0
        + column(top, "rut_depth_mm_parameter_50_upper")[1:] / 2.0, rtol=0.01,
    )  # fmt: skip
    # What the model does not take tells no settings apart.
    with_more = AT.replace("percent\n", "percent,rut_depth_mm,note\n").replace(
        "0,10\n", "0,10,4,wet\n"
    ).replace("0,5\n", "0,5,3,dry\n") + "10,9,5,dry\n"  # fmt: skip
    Path("more.csv").write_text(with_more, encoding="utf-8")
    more = calib("predict", run, "--at", "more.csv", "--peak-over", "slip_percent").out
    assert column(more, "Average ground pressure [psi]").tolist() == [10.0, 20.0, 30.0]
    assert_refused(calib("predict", run, "--at", at, "--peak-over", "slip"), ["slip"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--exceeds", "drawbar_pull_kn=1"], ["no column drawbar_pull_kn here", "rut_depth_mm"]),
        (["--exceeds", "rut_depth_mm"], ["cannot read --exceeds", "COLUMN=VALUE"]),
        (["--below", "rut_depth=1"], ["does not say the unit"]),
        (["--below", "rut_depth_mm=nan"], ["is no comparison"]),
        (["--quantiles", "5%"], ["cannot read --quantiles"]),
        (["--quantiles", "5,95"], ["there is no quantile", "below 1"]),
        (["--draws", "3"], ["beside a file", "--out"]),
        (["--peak-over", "speed_m_s"], ["no column speed_m_s here"]),
        (
            ["--peak-over", "slip_percent", "--exceeds", "rut_depth_mm=1"],
            ["cannot be combined", "once for each"],
        ),
        (["--priors", "p.toml"], ["not clear what to predict with"]),
        (["--model", "bekker"], ["not clear what to predict with"]),
    ],
)
def test_what_is_asked_wrongly_is_refused(
    calib: Calib, run: Path, at: str, options: list[str], words: list[str]
) -> None:
    ran = calib("predict", run, "--at", at, *options)
    assert_refused(ran, words)


def test_priors_predict_before_there_are_data(calib: Calib, at: str) -> None:
    assert calib("priors", "modified_bekker", "--out", "mine.toml").code == 0
    asked = ["predict", "--model", "modified_bekker", "--priors", "mine.toml", "--at", at]
    ran = calib(*asked, "--exceeds", "rut_depth_mm=30")
    assert ran.code == 0, ran.err
    assert ran.err.startswith("calib: no data are known: this is what priors expect\n")
    assert "the parameters refer to the conditions that are predicted at: " in ran.err
    wide = column(ran.out, "rut_depth_mm_predictive_90_upper")
    text = Path("mine.toml").read_text(encoding="utf-8")
    wider = re.sub(r"sd_log = ([\d.]+)", lambda found: f"sd_log = {2 * float(found[1])}", text)
    Path("mine.toml").write_text(wider, encoding="utf-8")
    assert (column(calib(*asked).out, "rut_depth_mm_predictive_90_upper") > wide).all()
    assert_refused(calib("predict", "--at", at), ["not clear what to predict with"])
    assert_refused(calib("predict", "--at", at, "--model", "becker"), ["becker", "bekker"])
    pulls = ["predict", "--at", at, "--model", "magic_formula_pressure"]
    assert_refused(calib(*pulls), ["inflation_pressure"])


@pytest.mark.parametrize(
    ("slip", "code", "said"), [(0.2, 0, "check its unit"), (-0.2, 3, "no value")]
)
def test_an_answer_that_says_nothing_is_not_given_in_silence(
    calib: Calib, slip: float, code: int, said: str
) -> None:
    head = "slip_ratio,normal_load_kn,tyre_diameter_m,tyre_width_m\n"
    Path("wheel.csv").write_text(f"{head}{slip},2,0.5,0.2\n", encoding="utf-8")
    asked = ["predict", "--model", "wong_reece_pull", "--at", "wheel.csv"]
    ran = calib(*asked, "--exceeds", "drawbar_pull_kn=1200")
    assert (ran.code, said in ran.err) == (code, True)
    assert "check its unit" not in calib(*asked, "--exceeds", "drawbar_pull_kn=1.2").err


def test_an_answer_of_chains_that_did_not_converge_says_so(calib: Calib) -> None:
    Path("my.csv").write_text(example_csv("magic_formula_pressure"), encoding="utf-8")
    model = ["--model", "magic_formula_pressure", "--max-steps", 100]
    assert calib("fit", "my.csv", *model, "--out", "few").code == 3
    ran = calib("predict", "few", "--at", "my.csv", "--exceeds", "drawbar_pull_kn=1")
    assert ran.code == 3
    assert ran.err.startswith("calib: this calibration did not converge")
    assert ran.out.splitlines()[0].endswith(",outside_calibrated_range,converged")
    written = calib("export", "few", "--out", "few.json", "--draws", 2)
    assert written.code == 3
    assert json.loads(Path("few.json").read_text())["converged"] is False
