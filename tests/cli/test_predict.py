"""What a prediction prints."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from calib.cli.prediction import _give


def test_what_is_printed_is_the_file_that_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {"Rut depth [mm], mean": [1.5, 20.0], "note": ["wet, soft", 'a "dry" one']}
    _give(columns, None)
    printed = capsys.readouterr().out
    assert list(csv.reader(printed.splitlines())) == [
        [*columns], ["1.5", "wet, soft"], ["20", 'a "dry" one'],
    ]  # fmt: skip
    _give(columns, tmp_path / "written.csv")
    assert (tmp_path / "written.csv").read_text() == printed
