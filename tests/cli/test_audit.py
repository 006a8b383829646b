"""`calib audit`, and the audit in `calib report`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.commands import Calib
from tests.docs.pages import told as keys_told


@pytest.fixture
def seeds(monkeypatch: pytest.MonkeyPatch, audit) -> list[int]:
    """The seeds that are asked for, of audits that were made beforehand."""
    asked: list[int] = []

    def made_before(seed, **_):
        asked.append(seed)
        return audit

    monkeypatch.setattr("calib.he2019.audit.run_audit", made_before)
    return asked


def test_a_table_with_the_gravest_verdict_first(calib: Calib, seeds: list[int], audit) -> None:
    ran = calib("audit", "--seed", "7")
    assert ran.code == 0
    assert seeds == [7]
    assert ran.out.index("contradicted") < ran.out.index("corrected") < ran.out.index("confirmed")
    reconstructed = sum(f.reconstructed for f in audit.findings)
    assert ran.out.count("[reconstructed data]") == 1 + reconstructed
    assert f"{len(audit.findings)} findings: " in ran.out
    told = calib("audit", "--json")
    assert len(json.loads(told.out)["findings"]) == len(audit.findings)


def test_a_folder_with_page_json_csv_and_figures(calib: Calib, seeds: list[int]) -> None:
    ran = calib("audit", "--out", "found")
    assert ran.code == 0
    assert ran.out.rstrip().endswith("index.html")
    written = {p.relative_to("found").as_posix() for p in Path("found").rglob("*")}
    assert {"index.html", "audit.json", "audit.csv", "figures/audit_rut.png"} <= written
    assert "calib audit --out found" in Path("found/index.html").read_text("utf-8")
    # It is replaced on request only, and what others wrote never.
    refused = calib("audit", "--out", "found")
    assert (refused.code, "--overwrite" in refused.err) == (2, True)
    assert calib("audit", "--out", "found", "--overwrite").code == 0
    Path("thesis").mkdir()
    Path("thesis/chapter.tex").write_text("mine")
    before = len(seeds)
    refused = calib("audit", "--out", "thesis", "--overwrite")
    assert (refused.code, "was not written by calib" in refused.err) == (2, True)
    assert len(seeds) == before


def test_table_4_in_one_command(calib: Calib, seeds: list[int]) -> None:
    ran = calib("audit", "--table", 4)
    assert ran.code == 0
    printed = [line.split("│") for line in ran.out.splitlines() if "Table 4, 42 psi: D" in line]
    (_, figure, published, again, posterior, judgement, _), *_ = printed
    assert (figure.strip(), published.strip(), again.strip()) == (
        "Table 4, 42 psi: D, kN", "0.5954", "0.5954",
    )  # fmt: skip
    assert posterior.strip().startswith("0.58")
    assert judgement.strip() == "same digits; inside the HDI; confirmed (table4_digits)"
    assert "table4_digits: confirmed: Rounding moves the pull" in ran.out
    assert "reconstructed data" in ran.err
    told = json.loads(calib("audit", "--table", 2, "--json").out)
    assert {*told, *told["rows"][0]} - {"schema", "exit_code"} <= keys_told()
    assert (told["schema"], told["table"], len(told["rows"])) == ("calib/published-table/1", 2, 7)
    assert calib("audit", "--table", 7).code == 2


@pytest.mark.slow
def test_the_command_on_its_own(calib: Calib) -> None:
    assert len(json.loads(calib("audit", "--out", "found", "--json").out)["findings"]) >= 35
