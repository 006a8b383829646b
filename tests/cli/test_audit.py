"""`calib audit`, and the audit in `calib report`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import calib.he2019.audit
from calib.cli import main


@pytest.fixture
def run(monkeypatch, capsys, tmp_path, audit):
    """Run the program as the shell would, with an audit made beforehand."""
    monkeypatch.chdir(tmp_path)
    seeds = []

    def made_before(seed, **_):
        seeds.append(seed)
        return audit

    monkeypatch.setattr(calib.he2019.audit, "run_audit", made_before)

    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["calib", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err, seeds

    return command


def test_a_table_with_the_gravest_verdict_first(run, audit):
    code, out, _, seeds = run("audit", "--seed", "7")
    assert code == 0
    assert seeds == [7]
    assert out.index("contradicted") < out.index("corrected") < out.index("confirmed")
    assert out.count("[reconstructed data]") == 1 + sum(f.reconstructed for f in audit.findings)
    assert f"{len(audit.findings)} findings: " in out


def test_json_goes_to_the_output_alone(run, audit):
    code, out, _, _ = run("audit", "--json")
    assert code == 0
    assert len(json.loads(out)["findings"]) == len(audit.findings)


def test_a_folder_with_page_json_csv_and_figures(run, tmp_path):
    code, out, _, _ = run("audit", "--out", "found")
    assert code == 0
    assert out.rstrip().endswith("index.html")
    written = {
        p.relative_to(tmp_path / "found").as_posix() for p in (tmp_path / "found").rglob("*")
    }
    assert {"index.html", "audit.json", "audit.csv", "figures/audit_rut.png"} <= written
    assert "calib audit --out found" in (tmp_path / "found" / "index.html").read_text("utf-8")
    # It is replaced on request only.
    code, _, err, _ = run("audit", "--out", "found")
    assert code == 2
    assert "--overwrite" in err
    assert run("audit", "--out", "found", "--overwrite")[0] == 0


def test_a_foreign_folder_is_left_alone(run, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("mine")
    code, _, err, seeds = run("audit", "--out", "thesis", "--overwrite")
    assert code == 2
    assert "was not written by calib" in err
    assert seeds == []


@pytest.mark.slow
def test_the_command_on_its_own(tmp_path: Path):
    done = subprocess.run(
        [Path(sys.executable).with_name("calib"), "audit", "--out", tmp_path / "found", "--json"],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    assert len(json.loads(done.stdout)["findings"]) >= 35
