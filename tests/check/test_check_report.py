"""Whatever is tampered with in a report is found and named, with its hash forged or not."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from calib.batch.environment import sha256
from calib.checking.check import check
from calib.checking.compare import Status
from calib.errors import CalibError
from calib.inference import prior_files
from calib.inference.prior_files import default_priors
from calib.report.sections import work_out
from tests.check.conftest import (
    different,
    edit_json,
    findings,
    in_manifest,
    in_text,
    scaled,
    seal,
    swap_figures,
)
from tests.check.made import SETTINGS, rut_study, rut_tasks, write

pytestmark = pytest.mark.usefixtures("computed_once")

SUMMARY = "summary.json: models.rut_depth"
CONTRADICTION = "summary.json and rut_depth.nc"
BANDS, LEARNED = "figures/rut_depth_bands.png", "figures/rut_depth_learned.png"


def test_an_untouched_report_is_the_same_bit_for_bit(report_here: Path) -> None:
    before = {p: p.read_bytes() for p in report_here.rglob("*") if p.is_file()}
    outcome = check(report_here)
    assert {item.status for item in outcome.items} == {Status.IDENTICAL}
    assert outcome.verdict.startswith("SAME, bit for bit")
    assert outcome.exit_code == 0
    assert not outcome.environment
    # Every number of the summary and every file was looked at, and none was changed.
    names = [item.name for item in outcome.items]
    for number in ("posterior.n1.hdi_upper", "validation.pit.8", "fit.genetic.cost"):
        assert f"{SUMMARY}.{number}" in names
    files = {path.relative_to(report_here).as_posix() for path in before}
    assert files <= {*names, "manifest.json", "summary.json"}
    assert {p: p.read_bytes() for p in report_here.rglob("*") if p.is_file()} == before


def test_a_report_repeats_that_a_posterior_did_not_converge(report: Path) -> None:
    sampling = {"converged": False}
    edit_json(
        report / "summary.json", lambda s: s["models"]["rut_depth"]["sampling"].update(sampling)
    )
    seal(report)
    outcome = check(report, quick=True)
    assert outcome.verdict.endswith("; NOT CONVERGED, not to be used: modified_bekker")
    assert outcome.document()["not_converged"] == ["modified_bekker"]


def test_quick_says_that_it_skips_the_sampling(report: Path) -> None:
    outcome = check(report, quick=True)
    assert outcome.exit_code == 0
    assert "ONLY ESTIMATES WERE COMPUTED AGAIN" in outcome.verdict
    names = [item.name for item in outcome.items]
    assert f"{SUMMARY}.estimates.genetic.n1" in names
    assert not any(".posterior." in name for name in names)


# Tampering


def change_data(report: Path) -> None:
    """One rut depth, by a tenth of a millimetre."""
    path = report / "data/rut_depth.csv"
    header, first, *rest = path.read_text().splitlines()
    cells = first.split(",")
    column = header.split(",").index("rut_depth_mm")
    cells[column] = repr(float(cells[column]) + 0.1)
    path.write_text("\n".join([header, ",".join(cells), *rest]) + "\n")


def change_draws(report: Path) -> None:
    with h5py.File(report / "rut_depth.nc", "a") as file:
        file["posterior/n1"][:] = file["posterior/n1"][:] + 0.01


def change_observed(report: Path) -> None:
    with h5py.File(report / "rut_depth.nc", "a") as file:
        file["observed_data/rut_depth_mm"][0] += 1.0


def truncate(report: Path) -> None:
    content = (report / "rut_depth.nc").read_bytes()
    (report / "rut_depth.nc").write_bytes(content[: len(content) // 2])


def delete_and_add(report: Path) -> None:
    content = (report / BANDS).read_bytes()
    (report / "figures/better.png").write_bytes(content)
    (report / BANDS).unlink()


CHANGE_PRIOR = in_text("priors/rut_depth.toml", "sd = 0.75", "sd = 0.7")
NUMBERS = {
    "posterior.n1.mean": 1.1, "estimates.least_squares.n0": 1.001, "validation.rmse": 1.2,
}  # fmt: skip


def change_numbers(report: Path) -> None:
    for place, by in NUMBERS.items():
        scaled(place, by)(report)
    in_text("summary.json", '"reconstructed"', '"measured"')(report)


# How; what is named when the hashes are left, and when they are forged.
TAMPERING: dict[str, tuple[Callable[[Path], None], list[str], list[str]]] = {
    "numbers and a word": (change_numbers, ["summary.json"],
        [*(f"{SUMMARY}.{place}" for place in NUMBERS), f"{SUMMARY}.data.label"]),
    "a data row": (change_data, ["data/rut_depth.csv"],
        ["data/rut_depth.csv", f"{SUMMARY}.fit.least_squares.cost", "rut_depth.nc"]),
    "a prior": (CHANGE_PRIOR, ["priors/rut_depth.toml"],
        ["priors/rut_depth.toml", f"{SUMMARY}.sampling.mode.n1", "rut_depth.nc"]),
    "the reason of a prior": (
        in_text("priors/rut_depth.toml", "Slip sinkage raises", "Everybody knows that"),
        ["priors/rut_depth.toml"], ["priors/rut_depth.toml", f"{SUMMARY}.priors.n1.reason"]),
    "figures, on the page too": (swap_figures(BANDS, LEARNED, page=True),
        [BANDS, LEARNED, "index.html"], [BANDS, LEARNED]),
    "figures deleted and added": (delete_and_add, [BANDS, "figures/better.png"],
        [BANDS, "figures/better.png"]),
    "a truncated posterior": (truncate, ["rut_depth.nc"], ["rut_depth.nc"]),
    "changed draws": (change_draws, ["rut_depth.nc"], ["rut_depth.nc"]),
    "something else in the posterior": (change_observed, ["rut_depth.nc"], ["rut_depth.nc"]),
    "the page": (in_text("index.html", "Do not trust:", "Trust too:"), ["index.html"],
        ["index.html"]),
}  # fmt: skip


@pytest.mark.parametrize("what", TAMPERING)
def test_tampering_is_named_with_its_hash_forged_or_not(
    request: pytest.FixtureRequest, what: str
) -> None:
    tamper, unsealed, names = TAMPERING[what]
    # Figures are judged where numbers are the same to the last bit.
    report = request.getfixturevalue("report_here" if "figures" in what else "report")
    tamper(report)
    if what in ("numbers and a word", "figures deleted and added"):
        assert set(unsealed) <= set(findings(report, quick=True))
    seal(report)
    outcome = check(report)
    found = different(outcome)
    assert outcome.exit_code == 1
    assert set(names) <= set(found)
    assert outcome.verdict.startswith("DIFFERENT: ")
    assert any(name in outcome.verdict for name in found)
    if not any("data/" in n or "priors/" in n for n in names):
        # Nothing else is called different, but for what contradicts it.
        assert set(found) <= {*names, "index.html", CONTRADICTION}


def test_a_missing_file_is_named_and_the_rest_is_still_checked(report: Path) -> None:
    (report / "data/rut_depth.csv").unlink()
    scaled("posterior.n1.mean", 1.1)(report)
    found = findings(report)
    assert found["data/rut_depth.csv"] == "missing"
    assert found["summary.json"] == "changed"


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("data/rut_depth.csv", "", SUMMARY),
        ("data/rut_depth.csv", "slip_ratio,rut_depth_mm\n0.1,deep\n", "data/rut_depth.csv"),
        ("priors/rut_depth.toml", "model =", f"{SUMMARY}.error"),
        ("summary.json", "{", "summary.json"),
    ],
)
def test_files_that_cannot_be_read_are_named(
    report: Path, name: str, content: str, named: str
) -> None:
    (report / name).write_text(content)
    seal(report)
    assert any(found in (name, named) or named in found for found in findings(report))


def test_the_same_numbers_in_other_clothes_are_not_the_same_file(report: Path) -> None:
    """Of two equal keys a reader takes the last; a person may see the first."""
    in_text("summary.json", '"n": 18,', '"n": 180, "n": 18,')(report)
    seal(report)
    assert "summary.json" in findings(report, quick=True)


def test_reconstructed_data_cannot_pass_for_measured(report: Path) -> None:
    """Consistently: label, hashes, summary and page say nothing of a reconstruction."""
    in_manifest(lambda m: m["tasks"]["rut_depth"].update(label=""))(report)
    edit_json(report / "summary.json", lambda s: s["models"]["rut_depth"]["data"].update(label=""))
    seal(report)
    assert "not called so" in findings(report, quick=True)["data/rut_depth.csv"]


def test_another_seed_is_not_the_one_that_was_used(report: Path) -> None:
    in_manifest(lambda m: m.update(seed=7))(report)
    assert "summary.json: seed" in findings(report)


def test_posteriors_alone_may_be_left_out(report_here: Path, tmp_path: Path) -> None:
    whole = json.loads((report_here / "manifest.json").read_text())
    folder = write(rut_study(), tmp_path / "lean", posteriors=False)
    assert not (folder / "rut_depth.nc").exists()
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["left_out"] == {"rut_depth.nc": whole["files"]["rut_depth.nc"]}
    outcome = check(folder)
    assert outcome.exit_code == 0
    (item,) = (i for i in outcome.items if i.name == "rut_depth.nc")
    assert item.status is Status.IDENTICAL

    # The hash of a file that is not there says nothing: another processor makes another file.
    in_manifest(lambda m: m["left_out"].update({"rut_depth.nc": "0" * 64}))(folder)
    outcome = check(folder)
    assert outcome.exit_code == 0
    assert [item.name for item in outcome.of(Status.UNJUDGED)] == ["rut_depth.nc"]

    (folder / BANDS).unlink()
    in_manifest(lambda m: m["left_out"].update({BANDS: m["files"].pop(BANDS)}))(folder)
    assert findings(folder, quick=True)[BANDS] == "missing: only posteriors may be left out"


# Where the draws are others: another processor, other versions


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report as another processor would have made it: by other draws, from other streams."""
    folder = write(rut_study(seed=11), tmp_path_factory.mktemp("elsewhere") / "report")
    in_manifest(lambda m: m.update(seed=2019))(folder)
    in_manifest(lambda m: m["machine"].update(processor="other"))(folder)
    edit_json(folder / "summary.json", lambda s: s.update(seed=2019))
    in_text("index.html", "<td>11</td>", "<td>2019</td>")(folder)
    seal(folder)
    return folder


@pytest.fixture
def other(elsewhere: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(elsewhere, tmp_path / "other"))


def test_other_draws_are_the_same_within_their_error(other: Path) -> None:
    outcome = check(other)
    assert different(outcome) == {}
    assert outcome.verdict.startswith("SAME within Monte Carlo error, not bit for bit")
    assert outcome.environment == {"processor": ("other", outcome.environment["processor"][1])}
    by_name = {item.name: item for item in outcome.items}
    mean = by_name[f"{SUMMARY}.posterior.n1.mean"]
    assert mean.status is Status.WITHIN
    assert mean.recorded != mean.found
    assert mean.allowed is not None
    # Half a posterior sd at the most, and more than a hundredth.
    assert 0.01 < mean.allowed / by_name[f"{SUMMARY}.posterior.n1.sd"].found < 0.5
    assert by_name["index.html"].status in (Status.WITHIN, Status.UNJUDGED)
    assert by_name[BANDS].status is Status.UNJUDGED


def test_among_other_draws_wrong_numbers_are_still_found(other: Path) -> None:
    places = (
        "posterior.n1.mean", "posterior.n0.sd", "posterior.z_ref.median",
        "posterior.z_ref.hdi_upper", "validation.rmse", "validation.coverage.90",
        "sampling.log_evidence", "estimates.least_squares.n0", "fit.genetic.cost",
    )  # fmt: skip
    for place in places:
        scaled(place, 0.8)(other)
    seal(other)
    assert set(findings(other)) - {CONTRADICTION} == {f"{SUMMARY}.{place}" for place in places}


@pytest.mark.parametrize("what", ["a data row", "a prior"])
def test_among_other_draws_changed_inputs_are_found_without_the_posterior_too(
    other: Path, what: str
) -> None:
    """Of data and priors of a user, the numbers alone show what was changed."""
    tamper, [name], names = TAMPERING[what]
    tamper(other)
    (other / "rut_depth.nc").unlink()
    in_manifest(lambda m: m["tasks"]["rut_depth"].update(label=""))(other)
    in_manifest(lambda m: m["tasks"]["rut_depth"]["priors"].update(shipped=False))(other)
    seal(other)
    outcome = check(other)
    assert {n for n in names if n != "rut_depth.nc"} <= set(different(outcome))
    notes = [i.note for i in outcome.of(Status.DIFFERENT) if i.name == name]
    assert any("follow from" in note for note in notes), notes


@pytest.mark.parametrize("which", ["report", "other"])
def test_a_picture_under_another_caption_is_found(
    which: str, request: pytest.FixtureRequest
) -> None:
    """On the page alone: the figure files are what they were."""
    folder = request.getfixturevalue(which)
    one, other = (base64.b64encode((folder / n).read_bytes()).decode() for n in (BANDS, LEARNED))
    page = (folder / "index.html").read_text().replace(one, "<one>").replace(other, one)
    (folder / "index.html").write_text(page.replace("<one>", other))
    seal(folder)
    assert list(findings(folder)) == ["index.html"]


# Where another processor rounds differently, and the draws are the same ones


@pytest.fixture
def rounded(report: Path) -> Path:
    def shaken(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: shaken(v) for k, v in value.items()}
        if isinstance(value, list):
            return [shaken(v) for v in value]
        return value * (1.0 + 1e-11) if isinstance(value, float) else value

    edit_json(report / "summary.json", lambda s: s["models"].update(shaken(s["models"])))
    seal(report)
    return report


def test_rounding_is_no_difference_and_hides_none(rounded: Path) -> None:
    outcome = check(rounded)
    assert different(outcome) == {}
    assert outcome.verdict.startswith("SAME up to rounding, not bit for bit")
    assert not outcome.draws_differ
    scaled("posterior.n1.mean", 1.1)(rounded)
    # One wrong estimate does not make the data wrong.
    scaled("estimates.least_squares.n0", 1.1)(rounded)
    seal(rounded)
    places = ("posterior.n1.mean", "estimates.least_squares.n0")
    assert set(findings(rounded)) == {*(f"{SUMMARY}.{p}" for p in places), CONTRADICTION}


def test_less_than_the_monte_carlo_error_is_found_by_the_draws_alone(report: Path) -> None:
    """Other draws might have moved it as far, but not the ones in the folder."""
    scaled("posterior.n1.mean", 1.001)(report)
    seal(report)
    assert list(findings(report)) == [CONTRADICTION]
    (report / "rut_depth.nc").unlink()
    in_manifest(lambda m: m["files"].pop("rut_depth.nc"))(report)
    in_manifest(lambda m: m["left_out"].update({"rut_depth.nc": "0" * 64}))(report)
    assert findings(report) == {}


@pytest.mark.parametrize("what", ["posterior.n1.mean", "fit.least_squares.cost"])
def test_the_last_bit_of_one_number_is_no_difference(report_here: Path, what: str) -> None:
    """However many others are the same to the last bit."""
    scaled(what, float(np.nextafter(1.0, 2.0)))(report_here)
    seal(report_here)
    outcome = check(report_here)
    assert different(outcome) == {}
    assert [item.name for item in outcome.of(Status.WITHIN)] == [f"{SUMMARY}.{what}"]


# What cannot be checked


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(schema="calib/manifest/1"), "calib/manifest/1"),
        (lambda m: m.pop("seed"), "seed"),
        (lambda m: m.update(seed=-1), "seed"),
        (lambda m: m.update(tasks={}), "tasks"),
        (lambda m: m["tasks"]["rut_depth"].update(model="pacejka"), "model"),
        (lambda m: m["files"].update({"../x": "0" * 64}), "not a path inside the folder"),
        (lambda m: m["tasks"]["rut_depth"]["data"].update(file="/etc/passwd"), "inside"),
        (lambda m: m["tasks"]["rut_depth"]["priors"].update(source="../a.toml"), "name of a file"),
        (lambda m: m["settings"].update(ensembles="many"), "ensembles"),
        (lambda m: m["files"].update({"index.html": "abc"}), "index.html"),
    ],
)
def test_a_manifest_that_makes_no_sense_cannot_be_checked(report: Path, change, words) -> None:
    in_manifest(change)(report)
    with pytest.raises(CalibError) as caught:
        check(report)
    assert words in str(caught.value)
    assert "hint:" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000])
def test_a_damaged_manifest_cannot_be_checked(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "manifest.json").write_bytes(content)
    with pytest.raises(CalibError, match=r"manifest\.json"):
        check(tmp_path)


# Versions


def test_a_number_on_the_page_is_held_against_those_it_follows_from(report_here: Path) -> None:
    """Made on this processor, where none of them moved."""
    page = (report_here / "index.html").read_text(encoding="utf-8")
    shown = re.search(r'<td class="num">(\d\.\d+)</td>', page)
    assert shown
    forged = f'<td class="num">9{shown[1][1:]}</td>'
    in_text("index.html", shown[0], forged)(report_here)
    seal(report_here)
    (item,) = check(report_here).of(Status.DIFFERENT)
    assert item.name == "index.html"
    assert forged in item.note


@pytest.mark.parametrize("other_code", [True, False])
def test_another_version_explains_another_page_and_another_commit_does_not(
    report_here: Path, other_code: bool
) -> None:
    in_text("index.html", "Do not trust:", "Trust too:")(report_here)
    if other_code:
        in_manifest(lambda m: m.update(code="0" * 64))(report_here)
    else:
        in_manifest(lambda m: m["versions"].update(terracalib="0.1.dev1"))(report_here)
    seal(report_here)
    outcome = check(report_here)
    assert outcome.exit_code == (0 if other_code else 1)
    (item,) = outcome.of(Status.UNJUDGED if other_code else Status.DIFFERENT)
    assert item.name == "index.html"
    assert "Trust too" in item.note
    if other_code:
        assert outcome.verdict.endswith("; 1 not judged, THE PAGE index.html AMONG THEM")
        assert set(outcome.environment) == {"code"}


def test_priors_of_another_version_are_not_called_wrong(report: Path) -> None:
    shipped = default_priors("modified_bekker").read_bytes()
    assert (report / "priors/rut_depth.toml").read_bytes() == shipped
    (report / "priors/rut_depth.toml").write_bytes(shipped + b"# of an earlier version\n")
    in_manifest(lambda m: m.update(code=sha256(b"")))(report)
    seal(report)
    outcome = check(report, quick=True)
    assert outcome.exit_code == 0
    (item,) = outcome.of(Status.UNJUDGED)
    assert item.name == "priors/rut_depth.toml"


def test_priors_that_a_file_left_out_are_kept_and_held_against_the_shipped_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, later = tmp_path / "mine.toml", tmp_path / "later"
    shipped = default_priors("modified_bekker").read_text(encoding="utf-8")
    mine.write_text(
        'model = "modified_bekker"\n[parameters.n1]\ndist = "normal"\nmean = 0.4\nsd = 0.5\n'
        'unit = "1"\nreason = "a test"\nsource = "nobody"\n'
    )
    tasks = [replace(task, prior_path=mine) for task in rut_tasks()]
    folder = write(work_out(tasks, 2019, settings=SETTINGS), tmp_path / "report")
    assert "mine.toml sets the prior of" in (folder / "index.html").read_text(encoding="utf-8")
    mine.unlink()
    assert different(check(folder)) == {}
    # With other priors shipped, nothing moves but what is said of those in the file.
    later.mkdir()
    (later / "modified_bekker.toml").write_text(shipped.replace("median = 25.0", "median = 2.5"))
    monkeypatch.setattr(prior_files, "_shipped", lambda: later)
    assert different(check(folder, quick=True)) == {
        "priors/rut_depth.toml": "z_ref: not as in the modified_bekker.toml of this version"
    }
