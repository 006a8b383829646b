"""The committed reference report: computed again, on whatever processor, it is what it was."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.check.kernels import ALL, FEW, Setting, skip_what_crashes

FOLDER = Path(__file__).resolve().parents[2] / "reports" / "he2019"
PROGRAM = "from calib.cli import main; main()"


def checked(setting: Setting) -> dict:
    """Check the report in a process that stands in for another processor."""
    skip_what_crashes(setting)
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM, "check", str(FOLDER), "--json",
         "--workers", str(setting.threads)],
        env=setting.environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.stdout, ran.stderr
    document = json.loads(ran.stdout)
    different = [i for i in document["items"] if i["status"] == "different"]
    assert [f"{i['name']}: {i['note']}" for i in different] == []
    assert ran.returncode == document["exit_code"] == 0
    assert document["headline"].startswith("SAME")
    return document


@pytest.mark.parametrize("setting", FEW[:1], ids=str)
def test_the_reference_report_is_what_is_computed_again(setting: Setting) -> None:
    document = checked(setting)
    names = {item["name"] for item in document["items"]}
    summary = json.loads((FOLDER / "summary.json").read_text())
    manifest = json.loads((FOLDER / "manifest.json").read_text())
    for key, entry in summary["models"].items():
        assert f"{key}.nc" in manifest["left_out"]
        assert f"{key}.nc" in names
        for parameter in entry["posterior"]:
            assert f"summary.json: models.{key}.posterior.{parameter}.mean" in names
    there = {p.relative_to(FOLDER).as_posix() for p in FOLDER.rglob("*") if p.is_file()}
    assert there == {*manifest["files"], "manifest.json"}
    assert sum((FOLDER / name).stat().st_size for name in there) < 300_000
    assert there <= names | {"manifest.json"} | {
        p for n in names if (p := n.split(":")[0]) in there
    }


@pytest.mark.slow
@pytest.mark.parametrize("setting", [s for s in ALL if s not in FEW[:1]], ids=str)
def test_the_reference_report_is_the_same_on_every_processor(setting: Setting) -> None:
    checked(setting)
