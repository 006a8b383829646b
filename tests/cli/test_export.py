"""`calib export`, and `calib priors --from-tir`: files of other programs."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet

import calib as package
from calib.models import example_csv
from calib.models.base import BoundModel
from tests.commands import Calib, assert_refused


@pytest.fixture(scope="module")
def _made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the run is kept, once it is made."""
    return tmp_path_factory.mktemp("made") / "pulls"


@pytest.fixture
def pulls(calib: Calib, _made: Path) -> Path:
    """The folder of a run of the Magic Formula at several pressures, beside its file my.csv."""
    Path("my.csv").write_text(example_csv("magic_formula_pressure"))
    if not _made.exists():
        made = calib("fit", "my.csv", "--model", "magic_formula_pressure", "--out", _made)
        assert made.code == 0, made.err
    return Path(shutil.copytree(_made, "pulls"))


def test_the_median_and_draws_are_written_and_read_back(calib: Calib, pulls: Path) -> None:
    wanted = ["export", pulls, "--at", "inflation_pressure_psi=30", "--out", "a/tyre.tir"]
    ran = calib(*wanted, "--draws", 3, "--each", "--json")
    assert ran.code == 0, ran.err
    files = json.loads(ran.out)["files"]
    assert files == [
        "a/tyre.tir", "a/tyre_draws.csv", *(f"a/tyre_draws/000{i}.tir" for i in (1, 2, 3))
    ]  # fmt: skip
    tyres = [package.read_tir(Path(f)) for f in files if f.endswith(".tir")]
    assert all(t.longitudinal_force(0.25, t.nominal_load_n) > 500.0 for t in tyres)
    with Path("a/tyre_draws.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row, tyre in zip(rows, tyres[1:], strict=True):
        assert float(row["FNOMIN"]) == 5000.0
        assert float(row["PDX1"]) == tyre.sections["LONGITUDINAL_COEFFICIENTS"]["PDX1"]
    assert_refused(calib(*wanted), ["a/tyre.tir: the file exists already"])
    wanted[-1] = "b.tir"
    plain = calib(*wanted).out
    assert plain.endswith("\nb.tir\n")
    assert "% of the largest" in plain
    assert not Path("b_draws.csv").exists()
    priors = calib("priors", "magic_formula", "--from-tir", "b.tir", "--out", "priors.toml")
    assert priors.code == 0, priors.err
    fitted = calib("fit", "my.csv", "--model", "magic_formula", "--priors", "priors.toml",
                   "--dry-run")  # fmt: skip
    assert fitted.code == 0, fitted.err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], ["for one inflation pressure", "--at inflation_pressure_psi=30"]),
        (["--at", "inflation_pressure_psi"], ["cannot read --at", "COLUMN=VALUE"]),
        (["--at", "inflation_pressure=30"], ["does not say the unit"]),
        (["--format", "tri"], ["there is no format 'tri'", "did you mean tir?"]),
        (["--each"], ["--each is for draws", "add --draws N"]),
    ],
)
def test_what_is_asked_for_wrongly_is_refused(
    calib: Calib, pulls: Path, options: list[str], words: list[str]
) -> None:
    assert_refused(calib("export", pulls, "--out", "tyre.tir", *options), words)
    assert not Path("tyre.tir").exists()


def test_draws_of_parameters_are_written_with_units(calib: Calib, pulls: Path) -> None:
    calibration = package.load_calibration(pulls)
    n, flat = 7, calibration.draws.flat
    picked = np.linspace(0, len(flat) - 1, n).round().astype(int)
    for form in ("csv", "json", "parquet"):
        ran = calib("export", pulls, "--draws", n, "--out", f"d.{form}")
        assert ran.code == 0, ran.err
        assert f"{n} of {len(flat)} draws" in ran.out
    document = json.loads(Path("d.json").read_text(encoding="utf-8"))
    frames = {
        "csv": pd.read_csv("d.csv"),
        "parquet": pd.read_parquet("d.parquet"),
        "json": pd.DataFrame(
            {f"{p} [{one['unit']}]": one["values"] for p, one in document["parameters"].items()}
        ),
    }
    assert {"D_lo [kN]", "c1 [kN]", "sigma [kN]"} <= {*frames["csv"]} == {*frames["parquet"]}
    assert frames["csv"]["draw"].tolist() == [*range(1, n + 1)]
    for frame in frames.values():
        for name, values in calibration.parameters.items():
            header = f"{name} [{calibration.summary[name].unit}]"
            np.testing.assert_allclose(frame[header], values.ravel()[picked], rtol=1e-12)
    # What is written computes the curve again, with nothing else.
    theta = np.array([document["parameters"][p]["values"] for p in calibration.problem.names]).T
    bound = BoundModel(package.MODELS[document["model"]], document["references"])
    rows = calibration.problem.conditions
    np.testing.assert_allclose(
        bound.predict(theta[:, :-1], rows), calibration.problem.bound.predict(
            calibration.problem.theta(flat[picked])[:, :-1], rows
        ), rtol=1e-9,
    )  # fmt: skip
    assert document["converged"] is True
    described = parquet.read_schema("d.parquet").metadata[b"calib"]
    assert json.loads(described)["equation"] == document["equation"]


def test_an_export_replaces_an_earlier_one_only(calib: Calib, pulls: Path) -> None:
    made = ["export", pulls, "--draws", 2, "--out"]
    for name in ("d.csv", "d.json", "d.parquet"):
        assert calib(*made, name).code == 0
        before = Path(name).read_bytes()
        assert_refused(calib(*made, name), [name, "exists already", "--overwrite"])
        assert calib("export", pulls, "--draws", 3, "--out", name, "--overwrite").code == 0
        assert Path(name).read_bytes() != before
        shutil.copy("my.csv", name)
        assert_refused(calib(*made, name, "--overwrite"), [name, "no earlier export"])
        assert Path(name).read_text() == Path("my.csv").read_text()
    assert_refused(calib(*made, "d.xlsx"), ["no format 'xlsx'", "parquet"])
    at = ["--at", "inflation_pressure_psi=30"]
    assert_refused(calib(*made, "e.csv", *at), ["for no condition", "tir"])


def test_without_the_library_parquet_is_refused(
    calib: Calib, pulls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert_refused(calib("export", pulls, "--out", "d.parquet"), ["terracalib[import]", "CSV"])


def test_other_models_have_no_property_file(calib: Calib, run: Path) -> None:
    assert_refused(calib("export", run, "--out", "t.tir"), ["modified_bekker", "magic_formula"])
    Path("t.tir").write_text("[VERTICAL]\nFNOMIN = 1\n", encoding="utf-8")
    assert_refused(calib("priors", "bekker", "--from-tir", "t.tir"), ["--from-tir", "bekker"])
    assert_refused(calib("priors", "magic_formula", "--from-tir", "t.tir"), ["there is no PCX1"])
