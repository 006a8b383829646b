"""The section on the source's own gaps: whole, and with the numbers of `summary.json`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from calib.he2019.gaps import Check, checks
from calib.he2019.sections import FoundGaps, _withheld, check_text
from calib.inference.sampling.sampler import SamplerSettings
from calib.report.gap_facts import short_name
from calib.report.labels import odds_text, short
from calib.report.study import Study
from calib.report.writer import file_hashes, write_report
from tests.browser import faults
from tests.report.page.test_page import Reader

NOTHING = Study({}, 2019, 0.0)


def written(folder: Path, gaps) -> Path:
    """Write a report of nothing but gaps."""
    write_report(
        NOTHING, folder, settings=SamplerSettings(), command=["calib", "report"],
        title="Report", sections=[FoundGaps(tuple(gaps))] if gaps else (),
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def report(found_gaps, tmp_path_factory) -> Path:
    return written(tmp_path_factory.mktemp("gaps") / "report", list(found_gaps.values()))


@pytest.fixture(scope="module")
def page(report) -> Reader:
    reader = Reader()
    reader.feed((report / "index.html").read_text(encoding="utf-8"))
    assert not reader.open
    return reader


def test_the_page_holds_in_a_browser(report, browser):
    assert faults(browser, report / "index.html") == []


@pytest.mark.slow  # as that of any diagnosis does
@pytest.mark.parametrize(
    "gap", ["plain_bekker", "nominal_slip", "held_out_pull", "post_peak_18_psi"]
)
def test_so_do_the_gaps(report, browser, gap):
    assert faults(browser, report / "gaps" / gap / "index.html") == []


def flat(text: str) -> str:
    return " ".join(text.split())


def test_the_page_says_what_the_summary_says(report, page):
    summary = json.loads((report / "summary.json").read_text())["paper_gaps"]
    text = flat(page.text)
    assert list(summary) == ["plain_bekker", "nominal_slip", "held_out_pull", "post_peak_18_psi"]
    for one in summary.values():
        best = one["best"]
        assert f"{short_name(best)} ({odds_text(one['probability'][best])})" in text
        for shrink in one["shrink"].values():
            low, high = (f"{100 * v:.0f}".replace("-", "−") for v in shrink["interval"])  # noqa: RUF001
            assert f"{short(100 * shrink['fraction'])} % ({low} to {high} %)" in text
        for name, values in one["checks"].items():
            heading, sentence = check_text(Check(name, values))
            assert heading in text
            assert f"{flat(sentence)}." in text


def test_every_gap_has_question_figure_limits_and_a_page(report, page, found_gaps):
    text = flat(page.text)
    ids = page.ids
    assert "paper-gaps" in ids
    assert len(ids) == len(set(ids))
    assert "#paper-gaps" in page.addresses
    assert "reconstructed data" in text
    for name, result in found_gaps.items():
        gap = result.gap
        for words in (gap.title, gap.question, gap.limits):
            assert flat(words) in text
        assert f"gap-{name}" in ids
        assert f"gaps/{name}/index.html" in page.addresses
        assert (report / "figures" / f"gap_{name}.png").stat().st_size > 10_000
        if gap.withheld is not None:
            assert f"withheld, {short_name(gap.withheld)}, is " in text
    assert all(image["alt"] and image["src"].startswith("data:") for image in page.images)


def test_each_diagnosis_is_whole_and_calls_its_data_reconstructed(report, found_gaps):
    for name, result in found_gaps.items():
        folder = report / "gaps" / name
        diagnosis = json.loads((folder / "diagnosis.json").read_text())
        assert diagnosis["verdict"] == result.found.verdict
        reader = Reader()
        reader.feed((folder / "index.html").read_text(encoding="utf-8"))
        assert "they are not measurements" in flat(reader.text)
        assert result.gap.case.field.sha256 in reader.text
        assert file_hashes(folder)["case/field.csv"] == result.gap.case.field.sha256
        assert all(a.startswith(("#", "data:")) for a in reader.addresses)


def test_hashes_of_all_files_are_in_the_manifest(report, found_gaps):
    manifest = json.loads((report / "manifest.json").read_text())
    assert manifest["files"] == file_hashes(report)
    assert manifest["paper_gaps"] == {
        name: {"seed": result.found.seed} for name, result in found_gaps.items()
    }


def test_without_gaps_there_is_no_section(tmp_path):
    folder = written(tmp_path / "report", ())
    assert "paper_gaps" not in json.loads((folder / "summary.json").read_text())
    assert "paper_gaps" not in json.loads((folder / "manifest.json").read_text())
    assert "paper-gaps" not in (folder / "index.html").read_text()
    assert not (folder / "gaps").exists()


def test_a_report_with_gaps_is_replaced_on_request(tmp_path, found_gaps):
    folder = written(tmp_path / "report", [found_gaps["plain_bekker"]])
    write_report(
        NOTHING, folder, settings=SamplerSettings(), command=["calib", "report"], title="Again",
        overwrite=True,
    )  # fmt: skip
    assert not (folder / "gaps").exists()


def test_an_effect_that_is_not_found_is_said_not_to_be(found_gaps):
    result = found_gaps["held_out_pull"]
    other = replace(result, gap=replace(result.gap, withheld="slip_zero_shift"))
    said = _withheld(other)
    assert "is not the one that is named" in said
    assert odds_text(result.found.ranking.probability["slip_zero_shift"]).split()[-1] in said
    assert _withheld(result) == ""


def test_every_check_has_a_sentence_with_all_its_main_numbers(found_gaps):
    for result in found_gaps.values():
        for check in checks(result):
            heading, sentence = check_text(check)
            assert heading[0].isupper() or heading[0].isdigit()
            assert any(character.isdigit() for character in sentence)
            assert "nan" not in sentence
