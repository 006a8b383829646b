"""The audit as a section and as a page."""

from __future__ import annotations

import json
import re

import pytest

from calib.he2019.audit import Verdict
from calib.he2019.sections import AUDIT_MARKS, audit_section, write_audit_page
from calib.report.figures.plate import Plate
from calib.report.sections import Written
from tests.browser import faults
from tests.report.page.test_page import PNG, Reader, page


@pytest.fixture(scope="module")
def section(audit):
    plates = [Plate(None, "audit_rut", "Not drawn (no luck).", "Ruts"),
              Plate(None, "audit_costs", "Cost of 0.1 kN^2 at -3 %.", "Costs")]  # fmt: skip
    return audit_section(audit, plates, {"audit_costs": PNG})


@pytest.fixture(scope="module")
def written(audit, tmp_path_factory):
    folder = tmp_path_factory.mktemp("audit")
    write_audit_page(audit, folder, ["calib", "audit", "--out", "a folder"])
    return folder


def test_it_holds_in_a_browser(written, browser):
    assert faults(browser, written / "index.html") == []


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    return reader


def test_every_finding_is_shown_with_verdict_evidence_and_what_stays_open(audit, section):
    reader = read(section)
    assert reader.open == []
    for f in audit.findings:
        assert f"audit-{f.key}" in reader.ids
    text = reader.text
    for verdict in audit.counts:
        assert verdict.value.capitalize() in text
        assert verdict.meaning in text
    assert "ln evidence" not in text
    assert "Regressing the set pressure on the measured rut" in text
    assert "The parameters of the measured ruts" in text


def test_the_gravest_group_comes_first(section):
    headings = re.findall(r'<h3 id="audit-(\w+)">', section)
    assert headings == ["contradicted", "corrected", "confirmed", "consistent", "untestable",
                        "figures"]  # fmt: skip


def test_reconstructed_findings_carry_a_badge_and_a_caveat(audit, section):
    n = sum(f.reconstructed for f in audit.findings)
    assert section.count('<br><span class="badge">reconstructed</span>') == n
    assert section.count("proves nothing about the measured ones.") == n


def test_signs_and_powers_are_written_for_a_reader(section):
    text = read(section).text
    assert "kN²" in text
    assert "kN^2" not in text
    assert not re.search(r"(?<![\w.])-\d", text)


def test_a_missing_figure_says_why(section):
    reader = read(section)
    assert "Ruts: no figure." in reader.text
    assert len(reader.images) == 1


def test_marks_differ_in_shape():
    assert set(AUDIT_MARKS) == set(Verdict)
    assert len(set(AUDIT_MARKS.values())) == len(Verdict)


def test_the_page_stands_alone(audit, written):
    html = (written / "index.html").read_text(encoding="utf-8")
    reader = read(html)
    assert reader.open == []
    assert not re.search(r"https?://|@import|url\(", html)
    assert len(reader.ids) == len(set(reader.ids))
    assert len(reader.images) == 5
    assert "calib audit --out 'a folder'" in reader.text
    content = json.loads((written / "audit.json").read_text(encoding="utf-8"))
    assert len(content["findings"]) == len(audit.findings)
    assert (written / "audit.csv").exists()
    assert len(list((written / "figures").glob("audit_*.png"))) == 5


def test_the_section_fits_into_the_report(rut, section):
    html, reader = page(
        {"rut_depth": rut}, more=[Written("audit", "Audit of the published tables", "", section)]
    )
    assert reader.open == []
    assert len(reader.ids) == len(set(reader.ids))
    assert "#audit" in reader.addresses
    assert "Audit of the published tables" in html


def test_without_an_audit_there_is_no_section(plate):
    _, reader = page({"rut_depth": plate}, reconstructed=False)
    assert "audit" not in reader.ids
