"""Whatever is tampered with in a report is found and named, with its hash forged or not."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from calib.batch.environment import sha256
from calib.check.check import check
from calib.check.outcome import Status
from calib.errors import CalibError
from calib.he2019.designs import he2019_tasks
from calib.inference.prior_files import default_priors
from calib.inference.sampler import SamplerSettings
from calib.report.sections import work_out
from calib.report.writer import write_report
from tests.check.conftest import different, edit_json, findings, seal
from tests.check.made import rut_study, write

pytestmark = pytest.mark.usefixtures("computed_once")

SUMMARY = "summary.json: models.rut_depth"
CONTRADICTION = "summary.json and rut_depth.nc"
BANDS, LEARNED = "figures/rut_depth_bands.png", "figures/rut_depth_learned.png"


def test_an_untouched_report_is_the_same_bit_for_bit(report_here: Path) -> None:
    report = report_here
    before = {p: p.read_bytes() for p in report.rglob("*") if p.is_file()}
    outcome = check(report)
    assert {item.status for item in outcome.items} == {Status.IDENTICAL}
    assert outcome.verdict.startswith("SAME, bit for bit")
    assert outcome.exit_code == 0
    assert not outcome.environment
    # Every number of the summary and every file was looked at.
    names = [item.name for item in outcome.items]
    numbers = json.loads((report / "summary.json").read_text())["models"]["rut_depth"]
    assert f"{SUMMARY}.posterior.n1.hdi_upper" in names
    assert f"{SUMMARY}.validation.pit.8" in names
    assert f"{SUMMARY}.fit.genetic.cost" in names
    entries = sum(map(len, numbers["posterior"].values()))
    assert sum(".posterior." in name for name in names) == entries
    for path in before:
        name = path.relative_to(report).as_posix()
        assert name in (*names, "manifest.json", "summary.json")
    assert {p: p.read_bytes() for p in report.rglob("*") if p.is_file()} == before


def test_the_same_report_of_a_posterior_that_did_not_converge(tmp_path: Path) -> None:
    tasks = [task for task in he2019_tasks() if task.output == "rut_depth"]
    short = SamplerSettings(steps=40, max_steps=40)
    write_report(
        work_out(tasks, 3, settings=short), tmp_path / "report",
        settings=short, command=["calib", "report"], title="A report",
    )  # fmt: skip
    outcome = check(tmp_path / "report")
    assert outcome.verdict.startswith("SAME, bit for bit")
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


def change_number(report: Path) -> None:
    edit_json(report / "summary.json", lambda s: scale(s, "posterior", "n1", "mean", by=1.1))


def change_estimate(report: Path) -> None:
    edit_json(report / "summary.json", lambda s: scale(s, "estimates", "least_squares", "n0"))


def change_score(report: Path) -> None:
    edit_json(report / "summary.json", lambda s: scale(s, "validation", "rmse", by=1.2))


def scale(summary, *place: str, by: float = 1.001) -> None:
    entry = summary["models"]["rut_depth"]
    for key in place[:-1]:
        entry = entry[key]
    entry[place[-1]] *= by


def change_data(report: Path) -> None:
    """One rut depth, by a tenth of a millimetre."""
    path = report / "data/rut_depth.csv"
    header, first, *rest = path.read_text().splitlines()
    cells = first.split(",")
    column = header.split(",").index("rut_depth_mm")
    cells[column] = repr(float(cells[column]) + 0.1)
    path.write_text("\n".join([header, ",".join(cells), *rest]) + "\n")


def replace_text(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(report: Path) -> None:
        text = (report / name).read_text()
        assert old in text
        (report / name).write_text(text.replace(old, new, 1))

    return change


def truncate_posterior(report: Path) -> None:
    content = (report / "rut_depth.nc").read_bytes()
    (report / "rut_depth.nc").write_bytes(content[: len(content) // 2])


def change_draws(report: Path) -> None:
    with h5py.File(report / "rut_depth.nc", "a") as file:
        file["posterior/n1"][:] = file["posterior/n1"][:] + 0.01


def change_attribute(report: Path) -> None:
    with h5py.File(report / "rut_depth.nc", "a") as file:
        file["observed_data/rut_depth_mm"][0] += 1.0


def swap_figures(report: Path) -> None:
    one, other = (report / BANDS).read_bytes(), (report / LEARNED).read_bytes()
    (report / BANDS).write_bytes(other)
    (report / LEARNED).write_bytes(one)


def swap_figures_on_the_page_too(report: Path) -> None:
    one, other = (base64.b64encode((report / n).read_bytes()).decode() for n in (BANDS, LEARNED))
    swap_figures(report)
    page = (report / "index.html").read_text()
    page = page.replace(one, "<one>").replace(other, one).replace("<one>", other)
    (report / "index.html").write_text(page)


def delete_figure(report: Path) -> None:
    (report / BANDS).unlink()


def add_file(report: Path) -> None:
    (report / "figures/better.png").write_bytes((report / BANDS).read_bytes())


TAMPERING: dict[str, tuple[Callable[[Path], None], list[str], list[str]]] = {
    # How; what is named when the hashes are left, and when they are forged.
    "a number in the summary": (
        change_number, ["summary.json"], [f"{SUMMARY}.posterior.n1.mean"]),
    "an estimate": (
        change_estimate, ["summary.json"], [f"{SUMMARY}.estimates.least_squares.n0"]),
    "a score": (change_score, ["summary.json"], [f"{SUMMARY}.validation.rmse"]),
    "a word in the summary": (
        replace_text("summary.json", '"reconstructed"', '"measured"'),
        ["summary.json"], [f"{SUMMARY}.data.label"]),
    "a data row": (
        change_data, ["data/rut_depth.csv"],
        ["data/rut_depth.csv", f"{SUMMARY}.fit.least_squares.cost", "rut_depth.nc"]),
    "a prior": (
        replace_text("priors/rut_depth.toml", "sd = 0.75", "sd = 0.7"),
        ["priors/rut_depth.toml"],
        ["priors/rut_depth.toml", f"{SUMMARY}.sampling.mode.n1", "rut_depth.nc"]),
    "the reason of a prior": (
        replace_text("priors/rut_depth.toml", "Slip sinkage raises", "Everybody knows that"),
        ["priors/rut_depth.toml"], ["priors/rut_depth.toml", f"{SUMMARY}.priors.n1.reason"]),
    "two figures swapped": (swap_figures, [BANDS, LEARNED], [BANDS, LEARNED]),
    "two figures swapped on the page too": (
        swap_figures_on_the_page_too, [BANDS, LEARNED, "index.html"], [BANDS, LEARNED]),
    "a truncated posterior": (truncate_posterior, ["rut_depth.nc"], ["rut_depth.nc"]),
    "changed draws": (change_draws, ["rut_depth.nc"], ["rut_depth.nc"]),
    "something else in the posterior": (change_attribute, ["rut_depth.nc"], ["rut_depth.nc"]),
    "a deleted figure": (delete_figure, [BANDS], [BANDS]),
    "another file": (add_file, ["figures/better.png"], ["figures/better.png"]),
    "the page": (
        replace_text("index.html", "Do not trust:", "Trust too:"), ["index.html"],
        ["index.html"]),
}  # fmt: skip


@pytest.mark.parametrize("what", TAMPERING)
def test_what_does_not_fit_its_hash_is_named(report: Path, what: str) -> None:
    tamper, names, _ = TAMPERING[what]
    tamper(report)
    found = findings(report, quick=True)
    assert set(names) <= set(found)


@pytest.mark.parametrize("what", TAMPERING)
def test_what_fits_a_forged_hash_is_found_by_computing_again(
    request: pytest.FixtureRequest, what: str
) -> None:
    tamper, _, names = TAMPERING[what]
    # Figures are judged where numbers are the same to the last bit.
    report = request.getfixturevalue("report_here" if "figure" in what else "report")
    tamper(report)
    seal(report)
    outcome = check(report)
    assert outcome.exit_code == 1
    assert set(names) <= set(different(outcome))
    first = outcome.verdict
    assert first.startswith("DIFFERENT: ")
    assert any(name in first for name in different(outcome))
    if not any("data" in n or "priors" in n for n in names):
        # Nothing else is called different, beside what contradicts it.
        assert set(different(outcome)) <= {*names, "index.html", CONTRADICTION}


def test_a_missing_file_is_named_and_the_rest_is_still_checked(report: Path) -> None:
    (report / "data/rut_depth.csv").unlink()
    change_number(report)
    found = findings(report)
    assert found["data/rut_depth.csv"] == "missing"
    assert found["summary.json"] == "changed"
    assert check(report).exit_code == 1


@pytest.mark.parametrize(
    "content", ["", "slip_ratio\n", "a,b\n1,2\n", "slip_ratio,rut_depth_mm\n0.1,deep\n"]
)
def test_data_that_cannot_be_read_are_named(report: Path, content: str) -> None:
    (report / "data/rut_depth.csv").write_text(content)
    seal(report)
    found = findings(report)
    assert any("data/rut_depth.csv" in name or SUMMARY in name for name in found)


def test_priors_that_cannot_be_read_are_named(report: Path) -> None:
    (report / "priors/rut_depth.toml").write_text("model =")
    seal(report)
    found = findings(report)
    assert "priors/rut_depth.toml" in found
    assert f"{SUMMARY}.error" in found


def test_a_summary_that_cannot_be_read_is_named(report: Path) -> None:
    (report / "summary.json").write_text("{")
    seal(report)
    assert any("summary.json" in name for name in findings(report))


def test_the_same_numbers_in_other_clothes_are_not_the_same_file(report: Path) -> None:
    path = report / "summary.json"
    # Of two equal keys a reader takes the last; a person may see the first.
    text = path.read_text().replace('"n": 18,', '"n": 180, "n": 18,', 1)
    path.write_text(text)
    seal(report)
    assert "summary.json" in findings(report)


def test_reconstructed_data_cannot_pass_for_measured(report: Path) -> None:
    """Consistently: label, hashes, summary and page say nothing of a reconstruction."""
    edit_json(report / "manifest.json", lambda m: m["tasks"]["rut_depth"].update(label=""))
    edit_json(report / "summary.json", lambda s: s["models"]["rut_depth"]["data"].update(label=""))
    seal(report)
    found = findings(report, quick=True)
    assert "not called so" in found["data/rut_depth.csv"]


def test_another_seed_is_not_the_one_that_was_used(report: Path) -> None:
    edit_json(report / "manifest.json", lambda m: m.update(seed=7))
    assert "summary.json: seed" in findings(report)


def test_a_posterior_may_be_left_out_on_purpose(original_here: Path, tmp_path: Path) -> None:
    whole = json.loads((original_here / "manifest.json").read_text())
    folder = write(rut_study(), tmp_path / "lean", posteriors=False)
    assert not (folder / "rut_depth.nc").exists()
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["left_out"] == {"rut_depth.nc": whole["files"]["rut_depth.nc"]}
    outcome = check(folder)
    assert outcome.exit_code == 0
    (item,) = (i for i in outcome.items if i.name == "rut_depth.nc")
    assert item.status is Status.IDENTICAL
    assert "left out on purpose" in item.note

    # The hash of a file that is not there says nothing: another processor makes another file.
    edit_json(folder / "manifest.json", lambda m: m["left_out"].update({"rut_depth.nc": "0" * 64}))
    outcome = check(folder)
    assert outcome.exit_code == 0
    assert [item.name for item in outcome.of(Status.UNJUDGED)] == ["rut_depth.nc"]


def test_nothing_else_may_be_left_out(report: Path) -> None:
    def change(manifest) -> None:
        manifest["left_out"][BANDS] = manifest["files"].pop(BANDS)

    delete_figure(report)
    edit_json(report / "manifest.json", change)
    assert findings(report, quick=True)[BANDS] == "missing: only posteriors may be left out"


# Where the draws are others: another processor, other versions


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report as another processor would have made it: by other draws, from other streams."""
    study = rut_study(seed=11)
    folder = write(study, tmp_path_factory.mktemp("elsewhere") / "report")
    edit_json(folder / "manifest.json", lambda m: m.update(seed=2019))
    edit_json(folder / "manifest.json", lambda m: m["machine"].update(processor="other"))
    edit_json(folder / "summary.json", lambda s: s.update(seed=2019))
    page = folder / "index.html"
    page.write_text(page.read_text().replace("<td>11</td>", "<td>2019</td>"))
    seal(folder)
    return folder


@pytest.fixture
def other(elsewhere: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(elsewhere, tmp_path / "other"))


def test_other_draws_are_the_same_within_their_error(other: Path) -> None:
    outcome = check(other)
    assert different(outcome) == {}
    assert outcome.exit_code == 0
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


@pytest.mark.parametrize(
    ("what", "place"),
    [
        (("posterior", "n1", "mean"), "posterior.n1.mean"),
        (("posterior", "n0", "sd"), "posterior.n0.sd"),
        (("posterior", "z_ref", "median"), "posterior.z_ref.median"),
        (("posterior", "z_ref", "hdi_upper"), "posterior.z_ref.hdi_upper"),
        (("validation", "rmse"), "validation.rmse"),
        (("validation", "coverage", "90"), "validation.coverage.90"),
        (("sampling", "log_evidence"), "sampling.log_evidence"),
        (("estimates", "least_squares", "n0"), "estimates.least_squares.n0"),
        (("fit", "genetic", "cost"), "fit.genetic.cost"),
    ],
)
def test_among_other_draws_a_wrong_number_is_still_found(
    other: Path, what: tuple[str, ...], place: str
) -> None:
    edit_json(other / "summary.json", lambda s: scale(s, *what, by=0.8))
    seal(other)
    assert set(findings(other)) - {CONTRADICTION} == {f"{SUMMARY}.{place}"}


@pytest.mark.parametrize("what", ["a data row", "a prior"])
def test_among_other_draws_changed_inputs_are_still_found(other: Path, what: str) -> None:
    tamper, _, names = TAMPERING[what]
    tamper(other)
    seal(other)
    assert set(names) <= set(findings(other))


def test_a_changed_input_is_named_without_the_posterior(elsewhere: Path, tmp_path: Path) -> None:
    """Data of a user, no netCDF, other draws: the numbers alone show what was changed."""
    change_prior = TAMPERING["a prior"][0]
    for tamper, name in (
        (change_data, "data/rut_depth.csv"),
        (change_prior, "priors/rut_depth.toml"),
    ):
        folder = tmp_path / name.partition("/")[0]
        shutil.copytree(elsewhere, folder)
        (folder / "rut_depth.nc").unlink()
        edit_json(folder / "manifest.json", as_of_a_user)
        tamper(folder)
        seal(folder)
        notes = [i.note for i in check(folder).of(Status.DIFFERENT) if i.name == name]
        assert any("follow from" in note for note in notes), notes


def as_of_a_user(manifest) -> None:
    manifest["tasks"]["rut_depth"]["label"] = ""
    manifest["tasks"]["rut_depth"]["priors"]["shipped"] = False


def swap_pictures_on_the_page(report: Path) -> None:
    """Each caption under the other picture; the figure files are what they were."""
    one, other = (base64.b64encode((report / n).read_bytes()).decode() for n in (BANDS, LEARNED))
    page = (report / "index.html").read_text()
    page = page.replace(one, "<one>").replace(other, one).replace("<one>", other)
    (report / "index.html").write_text(page)


@pytest.mark.parametrize("which", ["report", "other"])
def test_a_picture_under_another_caption_is_found(
    which: str, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(which)
    swap_pictures_on_the_page(folder)
    seal(folder)
    assert list(findings(folder)) == ["index.html"]


# Where another processor rounds differently, and the draws are the same ones


def round_otherwise(summary) -> None:
    def shaken(value):
        if isinstance(value, dict):
            return {k: shaken(v) for k, v in value.items()}
        if isinstance(value, list):
            return [shaken(v) for v in value]
        return value * (1.0 + 1e-11) if isinstance(value, float) else value

    models = summary["models"]
    models["rut_depth"] = shaken(models["rut_depth"])


def test_rounding_is_no_difference(report: Path) -> None:
    edit_json(report / "summary.json", round_otherwise)
    seal(report)
    outcome = check(report)
    assert different(outcome) == {}
    assert outcome.verdict.startswith("SAME up to rounding, not bit for bit")
    assert not outcome.draws_differ


def test_among_rounded_numbers_one_that_moved_is_found(report: Path) -> None:
    edit_json(report / "summary.json", round_otherwise)
    edit_json(report / "summary.json", lambda s: scale(s, "posterior", "n1", "mean", by=1.1))
    seal(report)
    assert set(findings(report)) == {f"{SUMMARY}.posterior.n1.mean", CONTRADICTION}


def test_less_than_the_monte_carlo_error_is_found_by_the_draws_alone(report: Path) -> None:
    """Other draws might have moved it as far, but not the ones in the folder."""
    edit_json(report / "summary.json", lambda s: scale(s, "posterior", "n1", "mean", by=1.001))
    seal(report)
    assert list(findings(report)) == [CONTRADICTION]
    (report / "rut_depth.nc").unlink()
    edit_json(report / "manifest.json", lambda m: m["files"].pop("rut_depth.nc"))
    edit_json(report / "manifest.json", lambda m: m["left_out"].update({"rut_depth.nc": "0" * 64}))
    assert findings(report) == {}


def test_one_wrong_estimate_does_not_make_the_data_wrong(report: Path) -> None:
    edit_json(report / "summary.json", round_otherwise)
    place = ("estimates", "least_squares", "n0")
    edit_json(report / "summary.json", lambda s: scale(s, *place, by=1.1))
    seal(report)
    assert list(findings(report)) == [f"{SUMMARY}.estimates.least_squares.n0"]


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
    edit_json(report / "manifest.json", change)
    with pytest.raises(CalibError) as caught:
        check(report)
    assert words in str(caught.value)
    assert "hint:" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000])
def test_a_damaged_manifest_cannot_be_checked(report: Path, content: bytes) -> None:
    (report / "manifest.json").write_bytes(content)
    with pytest.raises(CalibError, match=r"manifest\.json"):
        check(report)


def test_another_folder_cannot_be_checked(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match="no folder that can be checked"):
        check(tmp_path)
    with pytest.raises(CalibError, match="no folder that can be checked"):
        check(tmp_path / "absent")


# Versions


def test_a_number_on_the_page_is_held_against_those_it_follows_from(report_here: Path) -> None:
    """Made on this processor, where none of them moved."""
    report = report_here
    page = (report / "index.html").read_text(encoding="utf-8")
    shown = re.search(r'<td class="num">(\d\.\d+)</td>', page)
    assert shown
    forged = f'<td class="num">9{shown[1][1:]}</td>'
    (report / "index.html").write_text(page.replace(shown[0], forged, 1), encoding="utf-8")
    seal(report)
    (item,) = check(report).of(Status.DIFFERENT)
    assert item.name == "index.html"
    assert forged in item.note


def test_another_version_explains_another_page_and_does_not_hide_it(report_here: Path) -> None:
    report = report_here
    replace_text("index.html", "Do not trust:", "Trust too:")(report)
    edit_json(report / "manifest.json", lambda m: m.update(code="0" * 64))
    seal(report)
    outcome = check(report)
    assert outcome.exit_code == 0
    (item,) = outcome.of(Status.UNJUDGED)
    assert item.name == "index.html"
    assert "Trust too" in item.note
    assert outcome.verdict.endswith("; 1 not judged, THE PAGE index.html AMONG THEM")
    assert set(outcome.environment) == {"code"}


def test_another_commit_of_the_same_code_is_no_excuse(report_here: Path) -> None:
    report = report_here
    replace_text("index.html", "Do not trust:", "Trust too:")(report)
    other = {"terracalib": "0.1.dev1"}
    edit_json(report / "manifest.json", lambda m: m["versions"].update(other))
    seal(report)
    outcome = check(report)
    assert outcome.exit_code == 1
    assert "index.html" in {item.name for item in outcome.of(Status.DIFFERENT)}


def test_priors_of_another_version_are_not_called_wrong(report: Path) -> None:
    shipped = default_priors("modified_bekker").read_bytes()
    assert (report / "priors/rut_depth.toml").read_bytes() == shipped
    (report / "priors/rut_depth.toml").write_bytes(shipped + b"# of an earlier version\n")
    edit_json(report / "manifest.json", lambda m: m.update(code=sha256(b"")))
    seal(report)
    outcome = check(report, quick=True)
    assert outcome.exit_code == 0
    (item,) = outcome.of(Status.UNJUDGED)
    assert item.name == "priors/rut_depth.toml"


@pytest.mark.parametrize("what", ["posterior.n1.mean", "fit.least_squares.cost"])
def test_the_last_bit_of_one_number_is_no_difference(report_here: Path, what: str) -> None:
    """However many others are the same to the last bit."""
    report = report_here

    def change(summary) -> None:
        *place, last = what.split(".")
        entry = summary["models"]["rut_depth"]
        for key in place:
            entry = entry[key]
        entry[last] = float(np.nextafter(entry[last], 1e9))

    edit_json(report / "summary.json", change)
    seal(report)
    outcome = check(report)
    assert different(outcome) == {}
    assert [item.name for item in outcome.of(Status.WITHIN)] == [f"{SUMMARY}.{what}"]
