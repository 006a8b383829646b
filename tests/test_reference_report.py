"""The committed reference report: computed again, it is what was committed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "reports" / "he2019"
PROGRAM = "from calib.cli import main; main()"


def checked(*arguments: str, **environment: str) -> dict:
    """As a process of its own, for NumPy is not yet imported there and can imitate a processor."""
    bare = {k: v for k, v in os.environ.items() if k != "NPY_DISABLE_CPU_FEATURES"}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM, "check", str(FOLDER), "--json", "-", *arguments],
        env=bare | environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.stdout, ran.stderr
    document = json.loads(ran.stdout)
    found = [f"{i['name']}: {i['note']}" for i in document["items"] if i["status"] == "different"]
    assert found == []
    assert ran.returncode == document["exit_code"] == 0
    return document


def test_the_reference_report_is_what_is_computed_again() -> None:
    document = checked()
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
    assert there <= names | {"manifest.json"}
    # Numbers of this processor, to the last bit: then page and figures are of this code too.
    if document["counts"]["within tolerance"] == 0:
        stale = [item["name"] for item in document["items"] if item["status"] == "not judged"]
        assert stale == [], "run `make reference`"


@pytest.mark.slow
def test_another_processor_finds_it_the_same() -> None:
    """With every vector instruction that there is, whatever the report was made with."""
    document = checked(NPY_DISABLE_CPU_FEATURES="")
    assert document["headline"].startswith("SAME")
