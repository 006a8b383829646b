"""`calib joint`, and what is predicted and checked of its folders."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path

import pytest

from calib.models import example_csv
from tests.commands import Calib, assert_refused

PRESSURES = (60, 100, 140)
DEPTHS = {
    "A": (10.1, 18.4, 25.2), "B": (13.2, 22.9, 31.5), "C": (9.1, 16.3, 23.4), "D": (12.2, 20.7, 28)
}  # fmt: skip
FIT = ["joint", "bins.csv", "--model", "bekker", "--group", "bin", "--pool", "z_ref"]


@pytest.fixture(scope="module")
def _made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the fit of all bins is kept, once it is made."""
    return tmp_path_factory.mktemp("made") / "bins"


@pytest.fixture
def bins(calib: Calib, _made: Path) -> Path:
    rows = [
        f"{p},{z},{b}" for b, own in DEPTHS.items() for p, z in zip(PRESSURES, own, strict=True)
    ]
    header = "average_ground_pressure_kpa,rut_depth_mm,bin"
    Path("bins.csv").write_text("\n".join([header, *rows]) + "\n")
    Path("at.csv").write_text("average_ground_pressure_kpa\n80\n170\n")
    if not _made.exists():
        made = calib(*FIT, "--out", _made)
        assert made.code == 0, made.err
        assert "z_ref may differ between 4 groups (bin)" in made.out
        assert "rut_depth B: verdict: fine" in made.out
    return Path(shutil.copytree(_made, "bins"))


def test_a_known_group_is_predicted_more_closely_than_a_new_one(calib: Calib, bins: Path) -> None:
    def width(*group: str) -> float:
        ran = calib("predict", bins, "--at", "at.csv", *group, "--json")
        assert ran.code == 0, ran.err
        assert "1 row lies outside the calibrated range" in ran.err
        columns = json.loads(ran.out)["columns"]
        assert columns["outside_calibrated_range"] == ["", "average_ground_pressure_kpa"]
        ends = (columns[f"rut_depth_mm_predictive_90_{e}"][0] for e in ("lower", "upper"))
        low, high = ends
        return high - low

    assert 2.0 * width("--group", "B") < width()
    assert_refused(calib("predict", bins, "--at", "at.csv", "--group", "E"), ["of group 'E'"])


def test_a_folder_is_computed_again_and_what_was_changed_is_found(calib: Calib, bins: Path) -> None:
    again = calib("report", bins, "--reviewer", "--out", "review")
    assert again.code == 0, again.out
    claimed = dict(json.loads(Path("review/review.json").read_text())["claimed"]["rows"])
    assert claimed["rut_depth B"].startswith("fine")
    assert "tau_z_ref" in claimed
    assert_refused(calib("plan", bins, "--grid", "at.csv", "--budget", 2), ["not a run folder"])
    data = bins / "rut_depth.csv"
    data.write_text(data.read_text().replace("31.5", "35.1"))
    assert calib("check", bins, "--quick").code == 1
    assert_refused(calib("predict", bins, "--at", "at.csv"), ["the file has changed"])


@pytest.mark.usefixtures("bins")
def test_rows_of_a_group_held_out_are_those_of_a_new_one(calib: Calib) -> None:
    ran = calib(*FIT, "--hold-out", "bin=D", "--out", "held", "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert "z_ref[D]" not in found["posterior"]
    assert found["scores"]["rut_depth D"]["sentence"].startswith("rut_depth D, held out as a new")
    assert found["scores"]["rut_depth D"]["covered_90"] == 3
    assert_refused(calib(*FIT, "--hold-out", "bin=E"), ["there is no group E", "A, B, C, D"])
    assert_refused(
        calib(*FIT, "--hold-out", "slip_percent=3"), ["none of the files has this column"]
    )


def test_each_model_may_have_its_own_file(calib: Calib) -> None:
    Path("ruts.csv").write_text(example_csv("bekker"))
    Path("shear.csv").write_text(example_csv("janosi_hanamoto"))
    both = ["joint", "ruts.csv", "--model", "bekker", "--model", "janosi_hanamoto"]
    own = ["--data", "janosi_hanamoto=shear.csv"]
    made = calib(*both, *own, "--out", "both")
    assert made.code == 0, made.err
    assert "rut_depth, shear_stress share no parameter" in made.out
    dry = calib(*both, *own, "--out", "dry", "--dry-run", "--json")
    assert set(json.loads(dry.out)["models"]) == {"bekker", "janosi_hanamoto"}
    assert_refused(calib(*both, "--data", "brixius=x.csv"), ["cannot read --data"])
    assert_refused(calib(*both), ["shear_displacement_mm"])


def test_the_posterior_of_plates_is_a_prior_for_the_wheel(calib: Calib) -> None:
    Path("plates.csv").write_text(example_csv("reece_plate"))
    Path("wheel.csv").write_text(example_csv("wong_reece_sinkage"))
    made = calib("fit", "plates.csv", "--model", "reece_plate", "--out", "plates", "--json")
    assert made.code == 0, made.err
    posterior = json.loads(made.out)["posterior"]
    wrote = calib("priors", "wong_reece_sinkage", "--from-run", "plates", "--out", "soil.toml")
    assert wrote.code == 0, wrote.err
    priors = tomllib.loads(Path("soil.toml").read_text())["parameters"]
    assert set(priors) == {"k1", "k2", "n"}
    assert priors["n"]["median"] == pytest.approx(posterior["n"]["median"], rel=0.02)
    assert priors["n"]["sd_log"] == pytest.approx(
        posterior["n"]["sd"] / posterior["n"]["mean"], rel=0.1
    )
    assert (priors["n"]["lower"], priors["n"]["upper"]) == (0.2, 2.0)
    dry = calib("fit", "wheel.csv", "--model", "wong_reece_sinkage", "--priors", "soil.toml",
                "--dry-run")  # fmt: skip
    assert dry.code == 0, dry.err
    refused = calib("priors", "brixius", "--from-run", "plates")
    assert_refused(refused, ["reece_plate has no parameter of brixius"])
