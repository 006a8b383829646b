"""The program run in this process as the shell would run it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from calib.cli import main
from calib.data.reader import SEEN


@dataclass(frozen=True)
class Ran:
    """What a command ended with and said."""

    code: int
    out: str
    err: str


type Calib = Callable[..., Ran]


@pytest.fixture
def calib(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Calib:
    """Run the program as the shell would, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    # Tables and help texts are laid out for the width of the terminal.
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: object) -> Ran:
        monkeypatch.setattr(sys, "argv", ["calib", *map(str, arguments)])
        SEEN.clear()  # a process runs one command
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return Ran(int(ended.value.code or 0), captured.out, captured.err)

    return run


def contents(folder: Path) -> set[str]:
    """Return the names of all files and folders below a folder."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*")}


def assert_refused(ran: Ran, words: list[str]) -> None:
    """Check that a command ended with a message for people, and nothing else."""
    assert ran.code == 2, ran
    assert ran.out == ""
    assert ran.err.startswith("calib: ")
    assert ran.err.count("calib: ") == 1
    assert "Traceback" not in ran.err
    assert "hint:" in ran.err
    for word in words:
        assert word in ran.err, (word, ran.err)
