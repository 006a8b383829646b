"""The paper for the journal: its length, what it cites and shows, where its numbers stand."""

from __future__ import annotations

import re

import pytest

from tests.docs.pages import DOCS, ROOT

PAPER = DOCS / "joss" / "paper.md"
_, TEXT = PAPER.read_text(encoding="utf-8").split("\n---\n", 1)
CITED = set(re.findall(r"@(\w+_\d{4})", TEXT))
BIB = (PAPER.parent / "paper.bib").read_text(encoding="utf-8")
# What is cited elsewhere, by whatever room cites it.
ELSEWHERE = "".join(
    path.read_text(encoding="utf-8")
    for folder in ("calib", "docs", "examples")
    for ends in ("bib", "html.j2", "md", "py", "toml")
    for path in (ROOT / folder).rglob(f"*.{ends}")
    if path.parent != PAPER.parent
)
# Evidence that is quoted, and the words that say it in the place that it is from.
QUOTED = {
    "46 of 47 easy cases": ("reports/challenge/blind.md", "46/47 (0.979)"),
    "36 of 47 hard": ("reports/challenge/blind.md", "36/47"),
    "All 101 first": ("reports/challenge/blind.md", "101 of 101"),
    "7 of 9 cases": ("reports/challenge/measured.md", "7 of 9"),
    "1,800 data sets": ("reports/sbc.md", "1,800 data sets"),
    "87 quantities": ("reports/sbc.md", "87 quantities"),
    "0.072": ("docs/statistics/diagnosis.md", "0.072"),
    "13.9 s": ("reports/benchmarks.md", "13.9"),
    "15.3 s": ("reports/benchmarks.md", "15.3"),
    "4 to 7 times": ("reports/benchmarks.md", "4 to 7 times"),
}


def test_it_is_as_long_as_the_journal_asks() -> None:
    words = re.sub(r"\$\$.*?\$\$", "", TEXT, flags=re.S).split()
    assert 900 <= len(words) <= 1200


def test_it_cites_what_it_lists() -> None:
    assert set(re.findall(r"^@\w+\{(\w+),$", BIB, re.M)) == CITED


@pytest.mark.parametrize("doi", re.findall(r"doi = \{(.*)\}", BIB))
def test_a_source_is_one_of_the_project(doi: str) -> None:
    assert doi.removeprefix("10.48550/arXiv.") in ELSEWHERE


def test_its_figures_are_there() -> None:
    shown = re.findall(r"^!\[.*?\\label\{(.*?)\}\]\((.*?)\)", TEXT, re.M | re.S)
    assert len(shown) == 2
    for label, picture in shown:
        assert (PAPER.parent / picture).is_file()
        assert f"\\autoref{{{label}}}" in TEXT


@pytest.mark.parametrize("quoted", QUOTED)
def test_its_numbers_stand_in_reports(quoted: str) -> None:
    place, there = QUOTED[quoted]
    assert quoted in " ".join(TEXT.split())
    assert there in (ROOT / place).read_text(encoding="utf-8")
