"""The report folder: whole, consistent, and the same bytes when it is made again."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from PIL import Image

from calib.inference.sampler import SamplerSettings
from calib.report.figures.collect import plates
from calib.report.sections import Report
from calib.report.study import Study
from calib.report.writer import file_hashes, write_report
from tests.browser import faults
from tests.pages import Reader


def write(result, out: Path, **kwargs) -> Path:
    return write_report(
        Report(Study({"rut_depth": result}, 2019, 1.0)), out, settings=SamplerSettings(),
        command=["calib", "report"], title="Report", **kwargs,
    ).parent  # fmt: skip


@pytest.fixture(scope="module")
def report(rut, tmp_path_factory) -> Path:
    return write(rut, tmp_path_factory.mktemp("report") / "rep", pdf=True)


def test_every_file_is_in_the_manifest(report):
    manifest = json.loads((report / "manifest.json").read_text())
    assert manifest["files"] == file_hashes(report)
    assert {"methods.txt", "methods.tex", "references.bib", "tables/posterior.csv",
            "tables/posterior_rut_depth.tex"} <= set(manifest["files"])  # fmt: skip


def test_every_link_of_the_page_leads_somewhere(report):
    page = Reader((report / "index.html").read_text(encoding="utf-8"))
    local = [link for link in page.addresses if not link.startswith(("#", "data:"))]
    assert {"tables/posterior.csv", "methods.txt", "references.bib", "summary.json"} <= set(local)
    for link in local:
        assert (report / link).is_file(), link
    assert {link[1:] for link in page.addresses if link.startswith("#")} <= set(page.ids)
    tables = {p.relative_to(report).as_posix() for p in (report / "tables").iterdir()}
    assert tables <= set(local)


def test_it_holds_in_a_browser(report, browser):
    assert faults(browser, report / "index.html") == []


def test_the_page_quotes_the_methods(report):
    page = (report / "index.html").read_text(encoding="utf-8").replace("\u00a0", " ")
    text = (report / "methods.txt").read_text(encoding="utf-8")
    sentence = re.search(r"Sampling\s+by .*?\s+autocorrelation\s+times\.", text, re.DOTALL)
    assert sentence is not None
    assert " ".join(sentence[0].split()) in page
    assert 'class="copy"' in page
    assert "user-select: all" in page


def test_every_figure_has_its_pdf_and_its_size_in_print(report):
    images = sorted((report / "figures").glob("*.png"))
    assert images
    for image in images:
        if "narrow" not in image.name:  # those are for screens alone
            assert image.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
        with Image.open(image) as opened:
            assert opened.info["dpi"] == pytest.approx((150, 150), abs=0.1)
            width = opened.size[0] / 150 * 25.4
            assert min(abs(width - w) for w in (90, 140, 190)) < 0.3


def test_pdfs_come_on_request_only(plate, tmp_path, monkeypatch):
    monkeypatch.setattr("calib.report.figures.collect.plates", lambda *a, **k: plates(*a, **k)[:1])
    report = write(plate, tmp_path / "rep")
    assert list(report.rglob("*.png"))
    assert not list(report.rglob("*.pdf"))
    assert json.loads((report / "manifest.json").read_text())["pdf"] is False


@pytest.mark.slow
def test_made_again_it_is_the_same_to_the_last_byte(rut, report, tmp_path):
    """PDFs are made again in `figures/test_print.py`."""
    again = file_hashes(write(rut, tmp_path / "rep"))
    assert again == {n: v for n, v in file_hashes(report).items() if not n.endswith(".pdf")}


def test_it_may_be_replaced(rut, tmp_path, monkeypatch):
    monkeypatch.setattr("calib.report.figures.collect.plates", lambda result, published: [])
    out = write(rut, tmp_path / "rep", pdf=True)
    (out / "methods.txt").write_text("old")
    assert write(rut, out, overwrite=True) == out
    assert (out / "methods.txt").read_text(encoding="utf-8").startswith("Methods")
