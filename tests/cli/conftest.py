"""A run that many tests read, made once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from calib.models import example_csv
from calib.report.figures.collect import plates
from tests.commands import Calib, calib  # noqa: F401


@pytest.fixture(scope="session")
def _kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the run is kept, once it is made."""
    return tmp_path_factory.mktemp("kept") / "run"


@pytest.fixture
def run(calib: Calib, _kept: Path) -> Path:  # noqa: F811
    """The folder of a run that converged, beside its file my.csv in the current folder."""
    Path("my.csv").write_text(example_csv("modified_bekker"))
    if not _kept.exists():
        made = calib("fit", "my.csv", "--model", "modified_bekker", "--out", _kept, "--seed", 3)
        assert made.code == 0, made.err
    return Path(shutil.copytree(_kept, "run"))


@pytest.fixture
def _one_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw one figure of each output: drawing takes most of the time of a report."""
    monkeypatch.setattr("calib.report.figures.collect.plates", lambda *args: plates(*args)[:1])
