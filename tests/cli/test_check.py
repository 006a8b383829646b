"""`calib check` and `calib doctor`: the verdict first, a table, exit codes, one for machines."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path

import pytest

from calib.checking.check import Outcome
from calib.checking.compare import Item, Status
from calib.checking.tolerances import MONTE_CARLO
from calib.cli.check import show
from calib.errors import CalibError
from calib.he2019 import embedded
from calib.models import MODELS
from tests.commands import Calib


def test_the_verdict_is_first_and_machines_read_a_document(calib: Calib, run: Path) -> None:
    quick = calib("check", run, "--quick", "--all")
    assert quick.code == 0
    lines = quick.out.splitlines()
    assert "ONLY ESTIMATES WERE COMPUTED AGAIN" in lines[0]
    for words in ("compared", "identical", "files and their hashes", "run.json: estimates.0.cost"):
        assert words in quick.out
    assert "Different" not in quick.out

    printed = calib("check", run, "--json")
    assert printed.code == 0
    document = json.loads(printed.out)
    assert document["schema"] == "calib/check/1"
    assert (document["verdict"], document["exit_code"], document["quick"]) == ("same", 0, False)
    assert document["headline"].startswith("SAME, bit for bit: ")
    assert document["kind"] == "run"
    assert document["counts"]["different"] == 0
    assert document["counts"]["identical"] == len(document["items"])
    by_name = {item["name"]: item for item in document["items"]}
    mean = by_name["run.json: posterior.sigma.mean"]
    assert mean["recorded"] == mean["found"]
    assert mean["status"] == "identical"


def test_what_differs_is_listed_and_ends_with_1(calib: Calib, run: Path) -> None:
    (run / "priors.toml").write_text((run / "priors.toml").read_text() + "# mine\n")
    checked = calib("check", run, "--quick")
    assert checked.code == 1
    assert checked.out.splitlines()[0] == "DIFFERENT: priors.toml"
    assert "changed" in checked.out
    document = json.loads(calib("check", run, "--quick", "--json").out)
    assert (document["verdict"], document["exit_code"]) == ("different", 1)
    told = calib("doctor", "--report", run, "--quick")
    assert (told.code, "DIFFERENT: priors.toml" in told.out) == (1, True)


def test_what_cannot_be_checked_ends_with_2(calib: Calib, run: Path) -> None:
    Path("data").mkdir()
    for folder, said in (
        ("absent", "there is no such folder"),
        ("data", "no folder that can be checked"),
    ):
        refused = calib("check", folder, "--json")
        assert refused.code == 2
        assert said in refused.err
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
    assert (damaged.code, "run.json" in damaged.err) == (2, True)


@pytest.mark.slow
def test_a_report_without_posteriors_is_whole(calib: Calib) -> None:
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
    assert (quick.code, "2 not judged" in quick.out.splitlines()[0]) == (0, True)


# What is printed where not everything is the same


def printed(
    capsys: pytest.CaptureFixture[str], *items: Item, there: bool = False, every: bool = False
) -> str:
    environment = {"numpy": ("1.0", "2.0")} if there else {}
    show(Outcome("run", "run", False, items, environment, "seven standard errors"), every=every)
    return capsys.readouterr().out


def test_what_differs_is_shown_with_both_numbers_and_what_is_allowed(
    capsys: pytest.CaptureFixture[str], snapshot
) -> None:
    items = (
        Item("estimates (rut)", "rut: n", Status.DIFFERENT, 1.25, 1.75, 0.125, "an optimum"),
        Item("estimates (pull)", "pull: C", Status.WITHIN, 2.0, 2.001, 0.01),
        Item("files", "data.csv", Status.UNJUDGED, "a" * 40, None, None, "not there"),
        *(Item("files", f"number {i}", Status.DIFFERENT, i, i + 1, 0.5) for i in range(40)),
    )
    assert printed(capsys, *items, every=True) == snapshot


@pytest.mark.parametrize("there", [True, False])
def test_other_draws_are_explained(capsys: pytest.CaptureFixture[str], there: bool) -> None:
    drawn = Item("rut: posterior", "mean", Status.WITHIN, 1.0, 1.01, 0.1, MONTE_CARLO)
    found = printed(capsys, drawn, there=there)
    assert found.startswith("SAME within Monte Carlo error, not bit for bit")
    assert "Allowed: seven standard errors." in found
    assert ("numpy: there 1.0; here 2.0" in found) == there
    assert ("or the record is not true" in found) != there


# Doctor


def test_what_is_installed_and_whether_a_report_checks(
    calib: Calib,
    run: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = calib("doctor", "--report", run, "--quick")
    assert told.code == 0, told.err
    assert f"  numpy {version('numpy')}\n" in told.out
    assert f"  {len(MODELS)} models: " in told.out
    assert f"shipped report\n  {run}: NOTHING DIFFERENT" in told.out
    assert "--quick" not in told.err
    machine = json.loads(calib("doctor", "--report", run, "--quick", "--json").out)
    assert machine["report"]["exit_code"] == 0
    assert machine["machine"]["kernels"]
    assert "bekker" in machine["registered"]["models"]

    # That a whole check follows is said first; what is installed is told before it is over.
    def stopped(*_: object, **__: object) -> None:
        raise CalibError("stopped in the middle")

    monkeypatch.setattr("calib.cli.check.run_check", stopped)
    told = calib("doctor", "--report", run)
    first, second = told.err.splitlines()
    assert first == (
        f"calib: computes {run} again below, some 20 s; --quick leaves the sampling out"
    )
    assert "stopped in the middle" in second
    assert told.out.endswith("shipped report\n")
