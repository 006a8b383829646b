"""The report of the embedded data and a small simulation-based calibration, made once a process."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

PROGRAM = "from calib.cli import main; main()"


_SCRATCH = tempfile.TemporaryDirectory(prefix="main-report-")


@cache
def main_report() -> Path:
    """Return the folder of `calib report`, its figures blank, and of `calib sbc` in it."""
    folder = Path(_SCRATCH.name)
    blank = Path(__file__).with_name("undrawn.py")
    for words in (
        ["report", "--out", folder / "he2019", "--models", blank],
        ["sbc", "--model", "bekker", "--simulations", "10", "--out", folder / "sbc"],
    ):
        command = [sys.executable, "-c", PROGRAM, *map(str, words), "--workers", "1"]
        subprocess.run(command, check=True, capture_output=True)
    return folder
