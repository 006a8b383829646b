"""Killed at random moments, a command leaves its result whole or none, and ends when repeated.

In `make test` it is the writing of a folder that is killed (`batch/test_folders.py`).
"""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from calib.models import example_csv
from tests.gap.cases import make_case, write_case

COMMAND = [sys.executable, "-c", "from calib.cli import main; main()"]
# Words of a command, and the files that hold its numbers.
VERBS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "fit": (
        ("fit", "ruts.csv", "--model", "bekker", "--max-steps", "400", "--out", "out"),
        ("run.json", "data.csv", "priors.toml"),
    ),
    "report": (
        ("report", "ruts.csv", "--model", "bekker", "--max-steps", "400", "--workers", "1",
         "--no-posteriors", "--out", "out"),
        ("summary.json",),
    ),
    "diagnose": (
        ("diagnose", "case", "--workers", "1", "--out", "out"),
        ("diagnosis.json", "corrected.json"),
    ),
    "sbc": (
        ("sbc", "--model", "bekker", "--simulations", "10", "--workers", "1", "--out", "out"),
        ("sbc.json",),
    ),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ruts.csv").write_text(example_csv("bekker"), encoding="utf-8")
    write_case(make_case("force_offset", n_lab=15, n_field=12), tmp_path / "case")
    return tmp_path


def start(words: tuple[str, ...]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [*COMMAND, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )  # fmt: skip


def numbers(out: Path, files: tuple[str, ...]) -> dict[str, str]:
    """Return hashes of the files that hold a result's numbers; seconds are no such thing."""
    found = {}
    for name in files:
        lines = (out / name).read_text(encoding="utf-8").splitlines()
        kept = "\n".join(line for line in lines if "seconds" not in line)
        found[name] = hashlib.sha256(kept.encode()).hexdigest()
    return found


def kill_and_go_again(verb: str, times: int, rng: np.random.Generator) -> int:
    """Kill a command so often at random moments; return how often it had no result yet."""
    words, files = VERBS[verb]
    began = time.monotonic()
    assert start(words).wait(timeout=300) in (0, 3)
    took = time.monotonic() - began
    whole = numbers(Path("out"), files)
    cut_short = 0
    for _ in range(times):
        subprocess.run(["rm", "-rf", "out"], check=True)
        process = start(words)
        time.sleep(took * rng.uniform(0.05, 1.0))
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(timeout=60)
        if Path("out").exists() and all((Path("out") / name).exists() for name in files):
            assert numbers(Path("out"), files) == whole
            if verb != "sbc":
                continue
        else:
            # A folder that is resumed may be there, in part; any other is not.
            assert verb == "sbc" or not Path("out").exists()
            cut_short += 1
        assert start(words).wait(timeout=300) in (0, 3)
        assert numbers(Path("out"), files) == whole
    return cut_short


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_fifty_kills_lose_nothing(verb: str, folder: Path) -> None:
    # Any seed must do: another one each time.
    cut_short = kill_and_go_again(verb, 13, np.random.default_rng())
    print(f"{verb}: killed 13 times, {cut_short} of them before there was a result")
    assert cut_short > 0
