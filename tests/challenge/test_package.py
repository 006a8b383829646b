"""The bench is in the repository and its sdist, not in the wheel; without it, calib says so."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import calib
import challenge
from calib.batch.campaign.kinds import ChallengeSection
from calib.batch.environment import from_the_bench, source_sha256
from challenge.make import NULL_FRACTION
from tests.cli.test_cli import Calib

ROOT = Path(challenge.__path__[0]).parent
PLAN = '[[challenge]]\nname = "blind"\ncases = 1\ndraw_seed = 5\n'


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
        ("challenge", "well-specified", "cases", "--key", "key", "--out", "o", "--out-key", "k"),
        ("campaign", "plan.toml"),
    ],
)
@pytest.mark.usefixtures("no_bench")
def test_without_the_bench_it_is_named_and_nothing_is_written(
    words: tuple[str, ...], tmp_path: Path, run: Calib
) -> None:
    """Exit code 2, what it is, where it is, and how to get it."""
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    ran = run(*words)
    assert ran.code == 2
    assert "a test bench of the repository, not of the wheel" in ran.err
    assert "hint: run from a checkout" in ran.err
    assert ("[[challenge]]" if words[0] == "campaign" else f"calib {words[0]} {words[1]}") in (
        ran.err
    )
    assert [p.name for p in tmp_path.iterdir()] == ["plan.toml"]


def test_campaigns_of_other_kinds_need_no_bench(tmp_path: Path) -> None:
    """Neither does a list of a plan's tasks."""
    plan = tmp_path / "plan.toml"
    plan.write_text('[[sbc]]\nname = "ranks"\nsimulations = 1\ndraw_seed = 3\n')
    code = "import sys; sys.modules['challenge'] = None; from calib.cli import main; main()"
    ran = subprocess.run(
        [sys.executable, "-c", code, "campaign", str(plan), "--list"], capture_output=True,
        text=True, timeout=120,
        env={**os.environ, "PYTHONPATH": str(Path(calib.__path__[0]).parent)},
    )  # fmt: skip
    assert ran.returncode == 0
    assert ran.stdout.startswith("ranks.")


def test_another_missing_package_is_not_taken_for_the_bench() -> None:
    """Only the bench is explained; anything else missing is a defect, and shown as one."""
    with pytest.raises(ModuleNotFoundError, match="no_such_package"), from_the_bench("a table"):
        import no_such_package  # noqa: F401


def test_the_wheel_is_calib_alone_and_the_sdist_has_the_bench() -> None:
    """As pyproject.toml says; the bench is no larger than it may be."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    targets = pyproject["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"]["packages"] == ["calib"]
    assert set(targets["wheel"]["force-include"]) == {"priors"}
    assert "challenge" in targets["sdist"]["include"]
    files = Path(challenge.__path__[0]).rglob("*.py")
    assert sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files) <= 5000


def test_a_campaign_draws_as_many_nulls_as_the_verb() -> None:
    """The plan's default is the bench's, which a plan without challenge cases does not import."""
    assert ChallengeSection.model_fields["null_fraction"].default == NULL_FRACTION


def test_other_code_has_another_hash(tmp_path: Path) -> None:
    """Cases of a campaign are kept apart by the code that makes them."""
    (tmp_path / "make.py").write_text("x = 1\n")
    one = source_sha256(tmp_path)
    source_sha256.cache_clear()
    (tmp_path / "make.py").write_text("x = 2\n")
    assert source_sha256(tmp_path) != one
