"""`calib validate`: readings of another campaign beside a reference."""

from __future__ import annotations

import json
from pathlib import Path

from calib.data import read_table
from tests.commands import Calib, assert_refused
from tests.docs.pages import told


def readings(factor: float) -> None:
    """Write other.csv: the readings of my.csv, each times a factor."""
    own = read_table(Path("my.csv"))
    columns = {name: own[name].tolist() for name in own}
    columns["rut_depth_mm"] = [factor * v for v in columns["rut_depth_mm"]]
    rows = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    Path("other.csv").write_text("\n".join([",".join(columns), *rows]), encoding="utf-8")


def test_near_readings_are_consistent_and_others_not(calib: Calib, run: Path) -> None:
    readings(1.002)
    near = calib("validate", run, "other.csv")
    assert near.code == 0, near
    assert "verdict: consistent with the reference; an offset of" in near.out
    readings(1.5)
    far = calib("validate", run, "other.csv", "--json")
    found = json.loads(far.out)
    assert (far.code, found["exit_code"]) == (1, 1)
    assert found.keys() - {"schema", "exit_code"} <= told()
    assert found["schema"] == "calib/consistency/1"
    assert found["differs"][0] == "offset"
    assert found["offset"][0] > found["detectable"]
    assert "above it on average" in found["verdict"]


def test_the_reference_s_own_rows_are_no_other_campaign(calib: Calib, run: Path) -> None:
    assert_refused(calib("validate", run, "my.csv"), ["rows that are fitted"])
