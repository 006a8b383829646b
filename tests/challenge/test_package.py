"""The bench is in the repository and its sdist, not in the wheel; without it, calib says so."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

import challenge
from challenge.measured.cases import SIMULATORS
from tests.commands import Calib

ROOT = Path(challenge.__path__[0]).parent


@pytest.fixture
def no_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let only calib be imported."""
    for name in ["challenge", *(m for m in sys.modules if m.startswith("challenge."))]:
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.parametrize(
    "words",
    [
        ("challenge", "make", "--out", "cases", "--key", "key", "--seed", "1"),
        ("challenge", "score", "cases", "--results", "results", "--key", "key"),
        ("challenge", "run", "cases", "--out", "results", "--program", "rival {case} {out}"),
    ],
)
@pytest.mark.usefixtures("no_bench")
def test_without_the_bench_it_is_named_and_nothing_is_written(
    words: tuple[str, ...], tmp_path: Path, run: Calib
) -> None:
    (tmp_path / "cases" / "one").mkdir(parents=True)
    (tmp_path / "cases" / "one" / "case.toml").touch()
    ran = run(*words)
    assert ran.code == 2
    assert "a test bench of the repository, not of the wheel" in ran.err
    assert "hint: run from a checkout" in ran.err
    assert f"calib {words[0]} {words[1]}" in ran.err
    assert [p.name for p in tmp_path.iterdir()] == ["cases"]


def test_the_wheel_is_calib_alone_and_the_sdist_has_the_bench() -> None:
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    targets = pyproject["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"]["packages"] == ["calib"]
    assert set(targets["wheel"]["force-include"]) == {"priors"}
    assert "challenge" in targets["sdist"]["include"]
    # Simulators that it hands to the program are read by that, as a user's are.
    files = set(Path(challenge.__path__[0]).rglob("*.py")) - set(SIMULATORS)
    assert sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files) <= 5500
