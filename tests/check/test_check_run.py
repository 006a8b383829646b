"""Run folders: whatever is tampered with is found and named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from calib.checking import folders
from calib.checking.check import check
from calib.checking.compare import Status
from calib.errors import CalibError
from calib.inference.calibration import calibrate
from calib.inference.io import load_calibration, save_calibration
from calib.inference.problem import build_problem
from calib.inference.sampler import SamplerSettings
from tests.check.conftest import different, edit_json, findings, seal_run
from tests.check.made import fitted_run

from . import made

pytestmark = pytest.mark.usefixtures("computed_once")


def test_an_untouched_run_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    run = made.run(tmp_path / "run")
    outcome = check(run)
    assert {item.status for item in outcome.items} == {Status.IDENTICAL}
    assert outcome.verdict.startswith("SAME, bit for bit")
    names = [item.name for item in outcome.items]
    for name in (
        "posterior.nc", "data.csv", "priors.toml", "run.json: posterior.n1.mean",
        "run.json: mode.3", "run.json: gate.rhat.0", "run.json: estimates.0.cost",
    ):  # fmt: skip
        assert name in names


def test_quick_does_without_the_sampling(run: Path) -> None:
    outcome = check(run, quick=True)
    assert outcome.exit_code == 0
    assert "ONLY ESTIMATES WERE COMPUTED AGAIN" in outcome.verdict
    assert any(item.name == "run.json: estimates.0.cost" for item in outcome.items)
    assert not any(".posterior." in item.name for item in outcome.items)


def change_data(run: Path) -> None:
    text = (run / "data.csv").read_text()
    line = text.splitlines()[4]
    cells = line.split(",")
    cells[-1] = repr(float(cells[-1]) * 1.01)
    (run / "data.csv").write_text(text.replace(line, ",".join(cells)))


def change_priors(run: Path) -> None:
    """In both places that hold them."""
    old, new = "sd = 0.75", "sd = 0.7"
    text = (run / "priors.toml").read_text()
    assert old in text
    (run / "priors.toml").write_text(text.replace(old, new))
    edit_json(run / "run.json", lambda m: m.update(prior_text=m["prior_text"].replace(old, new)))


def change_one_copy_of_the_priors(run: Path) -> None:
    path = run / "priors.toml"
    path.write_text(path.read_text().replace("sd = 0.75", "sd = 0.7"))


def truncate(run: Path) -> None:
    content = (run / "posterior.nc").read_bytes()
    (run / "posterior.nc").write_bytes(content[: len(content) // 2])


def change_draws(run: Path) -> None:
    with h5py.File(run / "posterior.nc", "a") as file:
        file["posterior/n1"][:] = file["posterior/n1"][:] * 1.001


def change_derived_draws(run: Path) -> None:
    """The density of the draws does not depend on what is derived of them."""
    with h5py.File(run / "posterior.nc", "a") as file:
        file["posterior/k"][:] = file["posterior/k"][:] * 1.5


def change_evidence(run: Path) -> None:
    edit_json(run / "run.json", lambda m: m.update(log_evidence=m["log_evidence"] + 0.5))


def change_gate(run: Path) -> None:
    edit_json(run / "run.json", lambda m: m["gate"]["rhat"].__setitem__(0, 1.02))


def add_a_file(run: Path) -> None:
    (run / "notes.txt").write_text("mine")


TAMPERING: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "a data row": (change_data, "data.csv", "posterior.nc"),
    "a prior": (change_priors, "priors.toml", "data.csv or priors.toml"),
    "a prior in one place": (change_one_copy_of_the_priors, "priors.toml", "priors.toml"),
    "a truncated posterior": (truncate, "posterior.nc", "posterior.nc"),
    "changed draws": (change_draws, "posterior.nc", "posterior.nc"),
    "changed derived draws": (change_derived_draws, "posterior.nc", "posterior.nc"),
    "the evidence": (change_evidence, "", "run.json: log_evidence"),
    "the gate": (change_gate, "", "run.json: gate.rhat.0"),
    "another file": (add_a_file, "notes.txt", "notes.txt"),
}


@pytest.mark.parametrize("what", TAMPERING)
def test_tampering_is_named_with_its_hash_forged_or_not(run: Path, what: str) -> None:
    tamper, name, forged = TAMPERING[what]
    tamper(run)
    if name:
        assert name in findings(run, quick=True)
    seal_run(run)
    outcome = check(run)
    assert outcome.exit_code == 1
    assert forged in different(outcome)


def test_a_missing_file_is_named(run: Path) -> None:
    (run / "posterior.nc").unlink()
    assert findings(run, quick=True) == {"posterior.nc": "missing"}
    edit_json(run / "run.json", lambda m: m["sha256"].pop("posterior.nc"))
    assert findings(run, quick=True) == {"posterior.nc": "run.json has no hash of it"}
    (run / "data.csv").unlink()
    assert "data.csv" in findings(run)


def test_whatever_file_a_run_lists_is_compared(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of a later version is found by its name in the record alone."""
    again, name = folders.recompute_run, "widths.csv"

    def write(folder: Path, width: str, seconds: str) -> None:
        (folder / name).write_text(f"parameter,width,seconds\nn1,{width},{seconds}\n")

    def recompute(record, problem, out, progress):
        calibration = again(record, problem, out, progress)
        write(out, "0.25", "4.1")
        return calibration

    write(run, "0.25", "3.2")
    edit_json(run / "run.json", lambda m: m["sha256"].update({name: ""}))
    seal_run(run)
    assert findings(run) == {name: "not computed by this version"}
    monkeypatch.setattr(folders, "recompute_run", recompute)
    assert findings(run) == {}
    write(run, "0.52", "3.2")
    seal_run(run)
    assert set(findings(run)) == {f"{name}: 0.width"}


def test_a_run_of_other_draws_is_the_same_within_their_error(run: Path, tmp_path: Path) -> None:
    """Another seed stands for another processor: the run says a seed that it was not made with."""
    problem = load_calibration(run).problem
    folder = tmp_path / "other"
    folder.mkdir()
    save_calibration(fitted_run(problem, 5), folder)
    edit_json(folder / "run.json", lambda m: m.update(seed=2019))
    outcome = check(folder)
    assert different(outcome) == {}
    assert outcome.verdict.startswith("SAME within Monte Carlo error")
    assert outcome.draws_differ

    # Yet the mean of these draws may not move by a third of a posterior sd.
    with h5py.File(folder / "posterior.nc", "a") as file:
        n1 = file["posterior/n1"]
        n1[:] = n1[:] + 0.33 * float(np.std(n1[:]))
    seal_run(folder)
    found = different(check(folder))
    assert {"run.json: posterior.n1.mean", "posterior.nc"} <= set(found)


def test_a_run_with_fixed_parameters_that_did_not_converge(pull_tables, tmp_path: Path) -> None:
    """Not as `calib fit` makes one: parameters held, starts and settings of one's own, a label."""
    table = pull_tables[0].take(pull_tables[0]["inflation_pressure_psi"] == 18.0)
    problem = build_problem("magic_formula", table, fixed={"Sh": 0.0, "Sv": 0.0})
    short = SamplerSettings(steps=40, max_steps=40)
    save_calibration(calibrate(problem, 3, label="mine", settings=short), tmp_path)
    outcome = check(tmp_path)
    assert {item.status for item in outcome.items} == {Status.IDENTICAL}
    assert outcome.verdict.startswith("SAME, bit for bit")
    assert outcome.verdict.endswith("; NOT CONVERGED, not to be used: magic_formula")
    assert outcome.document()["not_converged"] == ["magic_formula"]
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["settings"]["steps"] == short.steps
    assert record["estimates"] == []


def test_a_run_says_nothing_of_the_computer_it_was_made_on(run: Path) -> None:
    text = (run / "run.json").read_text()
    assert str(Path.home()) not in text
    assert json.loads(text)["prior_file"] == "modified_bekker.toml"
    with h5py.File(run / "posterior.nc") as file:
        assert "/priors/" not in file.attrs["run"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.pop("settings"), "settings"),
        (lambda m: m["settings"].update(ensembles=0), "ensembles = 0"),
        (lambda m: m.pop("code"), "code"),
        (lambda m: m.update(schema="calib/run/0"), "calib/run/0"),
        (lambda m: m.update(model="pacejka"), "hint: name the file that declares it"),
        (lambda m: m.update(references={"p": "high"}), "references"),
    ],
)
def test_a_record_that_makes_no_sense_cannot_be_checked(run: Path, change, words: str) -> None:
    edit_json(run / "run.json", change)
    with pytest.raises(CalibError) as caught:
        check(run)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.update(references={}),
        lambda m: m.update(fixed={"nothing": 1.0}),
        lambda m: m.update(prior_text="model ="),
        lambda m: m["estimates"][0].update(method="guess", theta=[1.0]),
    ],
)
def test_a_record_that_cannot_be_computed_from_is_different(run: Path, change) -> None:
    edit_json(run / "run.json", change)
    assert check(run).exit_code == 1


def test_a_checked_run_still_predicts(run: Path) -> None:
    check(run, quick=True)
    assert load_calibration(run).converged
