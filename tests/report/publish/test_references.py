"""References: as the packages themselves want to be cited, and only those that are cited."""

from __future__ import annotations

import re
from importlib import resources
from importlib.metadata import metadata, version

import pytest

from calib.he2019.published import DOI
from calib.report.publish.markup import bibliography, bibtex, entries, short_citation

DOIS = {
    "He_2019": DOI,
    "ForemanMackey_2013": "10.1086/670067",
    "ForemanMackey_2016": "10.21105/joss.00024",
    "Harris_2020": "10.1038/s41586-020-2649-2",
    "Virtanen_2020": "10.1038/s41592-019-0686-2",
    "Vehtari_2021": "10.1214/20-BA1221",
    "Vehtari_2017": "10.1007/s11222-016-9696-4",
    "Hunter_2007": "10.1109/MCSE.2007.55",
    "Martin_2026": "10.21105/joss.09889",
}


def test_every_entry_was_read():
    source = (resources.files("calib.report.publish") / "references.bib").read_text(
        encoding="utf-8"
    )
    assert len(re.findall(r"^@", source, re.MULTILINE)) == len(entries())
    for key, entry in entries().items():
        assert set(entry) >= {"author", "title", "journal", "year", "volume", "pages"}, key
        assert "doi" in entry or "url" in entry
        assert key.rpartition("_")[2] == entry["year"]
        for value in entry.values():
            assert value.count("{") == value.count("}")


@pytest.mark.parametrize("key", DOIS)
def test_dois(key):
    assert entries()[key]["doi"] == DOIS[key]


def test_emcee_is_cited_as_its_own_metadata_say():
    wanted = metadata("emcee").get_payload() or metadata("emcee")["Description"]
    entry = entries()["ForemanMackey_2013"]
    assert entry["doi"] in wanted
    for field in ("year", "volume"):
        assert re.search(rf"{field} = {entry[field]}\b", wanted)
    assert entry["pages"].replace("--", "-") in wanted


@pytest.mark.parametrize("key", ["Martin_2026", "Vehtari_2021", "Vehtari_2017", "Vehtari_2024"])
def test_arviz_and_its_methods_are_cited_as_arviz_does(key):
    shipped = (resources.files("arviz_base") / "references.bib").read_text(encoding="utf-8")
    theirs = re.search(rf"@article\{{{key},.*?\n\}}", shipped, re.DOTALL)
    assert theirs is not None
    found = dict(re.findall(r"(\w+)\s*=\s*\{(.*)\},?", theirs[0]))
    entry = entries()[key]
    for field in ("year", "volume", "number", "pages", "doi", "url"):
        if field in found and field in entry:
            assert entry[field] == found[field], field
    assert entry["author"].partition(",")[0].split()[-1] in found["author"].partition("and")[0]


def test_only_what_is_cited_is_listed_and_all_of_it(published):
    bib = published.files["references.bib"]
    tex = "".join(t for p, t in published.files.items() if p.endswith(".tex"))
    used = {k for group in re.findall(r"\\cite\{(.*?)\}", tex) for k in group.split(",")}
    assert set(re.findall(r"@\w+\{(\w+),", bib)) == used
    assert {*DOIS, "calib"} <= used
    assert f"Version {version('terracalib')}" in bib
    for line in published.references:
        assert re.search(r"doi:10\.|https://jmlr|Version", line)


def test_versions_are_passed_on():
    assert "Version 7.7" in bibtex(["calib"], "7.7")
    assert bibliography(["calib"], "7.7")[0].endswith("Version 7.7.")
    assert "calib" not in bibtex(["He_2019"], "7.7").partition("title")[0]


def test_names_are_letters():
    assert short_citation("Cappe_2008") == "Cappé et al. 2008"
    assert short_citation("terBraak_2006") == "ter Braak 2006"
    assert short_citation("Hunter_2007") == "Hunter 2007"
    lines = bibliography(entries(), "1")
    assert not any(c in line for line in lines for c in "{}\\$")
    assert any("Virtanen, Pauli; Gommers, Ralf; Oliphant, Travis E.; et al." in s for s in lines)
