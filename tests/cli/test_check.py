"""`calib check`: the verdict first, then a table; exit codes; a document for machines."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from calib.he2019 import embedded
from tests.cli.test_cli import Calib, calib  # noqa: F401


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the run is kept, once it is made."""
    return tmp_path_factory.mktemp("kept") / "run"


@pytest.fixture
def run(calib: Calib, kept: Path) -> Path:  # noqa: F811
    """A run folder, in the current folder."""
    embedded.write(Path("data"))
    if not kept.exists():
        made = calib(
            "fit", "data/rut_depth.csv", "--model", "bekker", "--out", kept,
            "--hold-out", "inflation_pressure_psi=30", "--seed", 4,
        )  # fmt: skip
        assert made.code == 0, made.err
    return Path(shutil.copytree(kept, "run"))


def test_the_first_line_is_the_verdict(calib: Calib, run: Path) -> None:  # noqa: F811
    checked = calib("check", run)
    assert checked.code == 0, checked.err
    assert checked.out.splitlines()[0].startswith("SAME, bit for bit: ")
    for words in ("compared", "identical", "files and their hashes", "posterior", "estimates"):
        assert words in checked.out
    assert "Different" not in checked.out

    quick = calib("check", run, "--quick")
    assert quick.code == 0
    assert "ONLY ESTIMATES WERE COMPUTED AGAIN" in quick.out.splitlines()[0]

    every = calib("check", run, "--quick", "--all")
    assert "run.json: estimates.0.cost" in every.out


def test_what_differs_is_listed_and_ends_with_1(calib: Calib, run: Path) -> None:  # noqa: F811
    (run / "priors.toml").write_text((run / "priors.toml").read_text() + "# mine\n")
    checked = calib("check", run, "--quick")
    assert checked.code == 1
    assert checked.out.splitlines()[0] == "DIFFERENT: priors.toml"
    assert "changed" in checked.out
    assert "Traceback" not in checked.err


def test_machines_read_a_document(calib: Calib, run: Path) -> None:  # noqa: F811
    printed = calib("check", run, "--json")
    assert printed.code == 0
    document = json.loads(printed.out)
    assert document["schema"] == "calib/check/1"
    assert (document["verdict"], document["exit_code"], document["quick"]) == ("same", 0, False)
    assert document["kind"] == "run"
    assert document["counts"]["different"] == 0
    assert document["counts"]["identical"] == len(document["items"])
    by_name = {item["name"]: item for item in document["items"]}
    mean = by_name["run.json: posterior.sigma.mean"]
    assert mean["recorded"] == mean["found"]
    assert mean["status"] == "identical"

    (run / "data.csv").unlink()
    differs = calib("check", run, "--json")
    assert differs.code == 1
    document = json.loads(differs.out)
    assert (document["verdict"], document["exit_code"]) == ("different", 1)
    assert document["headline"].startswith("DIFFERENT: data.csv")


def test_what_cannot_be_checked_ends_with_2(calib: Calib, run: Path) -> None:  # noqa: F811
    for folder in ("absent", "data"):
        refused = calib("check", folder, "--json")
        assert refused.code == 2
        assert "no folder that can be checked" in refused.err
        assert "hint:" in refused.err
        document = json.loads(refused.out)
        assert (document["verdict"], document["exit_code"]) == ("cannot be checked", 2)
    Path("simulated").mkdir()
    for name in ("run.json", "sbc.json"):
        Path("simulated", name).write_text('{"seed": 1}')
    simulated = calib("check", "simulated")
    assert simulated.code == 2
    assert "no folder that can be checked (it is one of `calib sbc`)" in simulated.err
    (run / "run.json").write_text("{")
    damaged = calib("check", run)
    assert damaged.code == 2
    assert "run.json" in damaged.err


@pytest.mark.slow
def test_a_report_without_posteriors_is_whole(calib: Calib) -> None:  # noqa: F811
    """And one with an output that failed can be checked too."""
    embedded.write(Path("data"))
    Path("few.csv").write_text("slip_ratio,drawbar_pull_kn\n0.1,1\n0.2,1.1\n")
    made = calib(
        "report", "data/rut_depth.csv", "few.csv", "--out", "rep", "--model", "bekker",
        "--no-posteriors",
    )  # fmt: skip
    assert made.code == 1, made.err
    assert not list(Path("rep").glob("*.nc"))
    manifest = json.loads(Path("rep/manifest.json").read_text())
    assert list(manifest["left_out"]) == ["rut_depth.nc"]
    assert manifest["tasks"]["rut_depth"]["label"] == "reconstructed"
    checked = calib("check", "rep")
    assert checked.code == 0, checked.out
    assert checked.out.startswith("SAME, bit for bit")
    quick = calib("check", "rep", "--quick")
    assert quick.code == 0, quick.out
    assert "2 not judged" in quick.out.splitlines()[0]
