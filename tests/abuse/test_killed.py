"""Killed at random moments, a command leaves its result whole or none, and ends when repeated.

In `make test` it is the writing of a folder that is killed (`batch/test_folders.py`).
"""

from __future__ import annotations

import hashlib
import json
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
from tests.models.simulators.examples import lab, write_program

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
    "simulator": (
        ("fit", "lab.csv", "--model", "wheel", "--simulator", "wheel.toml", "--max-steps", "400",
         "--workers", "1", "--out", "out"),
        ("run.json", "data.csv", "priors.toml"),
    ),
}  # fmt: skip
RUNS = Path("wheel.runs")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ruts.csv").write_text(example_csv("bekker"), encoding="utf-8")
    write_case(make_case("force_offset", n_lab=15, n_field=12), tmp_path / "case")
    columns = lab(np.random.default_rng(1))
    np.savetxt("lab.csv", np.stack(list(columns.values()), axis=1), delimiter=",",
               header=",".join(columns), comments="")  # fmt: skip
    # Of each run that is begun a line, with its parameters.
    begun = f"open({str(tmp_path / 'begun')!r}, 'a').write(json.dumps(p, sort_keys=True) + chr(10))"
    simulator = write_program(tmp_path, extra=f"{begun}; time.sleep(0.05)")
    budget = "\n[emulator]\nruns = 30\nfirst = 12\nchecks = 4\n"
    simulator.write_text(simulator.read_text(encoding="utf-8") + budget, encoding="utf-8")
    (tmp_path / "scratch").mkdir()
    return tmp_path


def start(words: tuple[str, ...], out: int = subprocess.DEVNULL) -> subprocess.Popen[bytes]:
    path = os.pathsep.join(p for p in sys.path if p)
    return subprocess.Popen(
        [*COMMAND, *words], stdout=out, stderr=subprocess.DEVNULL, start_new_session=True,
        env={**os.environ, "PYTHONPATH": path, "TMPDIR": str(Path("scratch").resolve())},
    )  # fmt: skip


def numbers(out: Path, files: tuple[str, ...]) -> dict[str, str]:
    """Return hashes of the files that hold a result's numbers; seconds are no such thing."""
    found = {}
    for name in files:
        lines = (out / name).read_text(encoding="utf-8").splitlines()
        kept = "\n".join(line for line in lines if "seconds" not in line)
        found[name] = hashlib.sha256(kept.encode()).hexdigest()
    return found


def kill(process: subprocess.Popen[bytes], seconds: float) -> None:
    """Kill a command, and all that it has started in its group, after so many seconds."""
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait(timeout=60)


def kept_runs() -> dict[Path, tuple[int, int]]:
    """The simulator's runs that are kept, each whole, and when they were put there."""
    kept = {path: path.stat() for path in RUNS.glob("*/*-[0-9].json")}
    for path in kept:
        assert "outputs" in json.loads(path.read_text(encoding="utf-8"))
    return {path: (stat.st_ino, stat.st_mtime_ns) for path, stat in kept.items()}


def begun_runs() -> int:
    path = Path("begun")
    return len(path.read_text(encoding="utf-8").splitlines()) if path.exists() else 0


def kill_and_go_again(verb: str, times: int, rng: np.random.Generator) -> int:
    """Kill a command so often at random moments; return how often it had no result yet."""
    words, files = VERBS[verb]
    began = time.monotonic()
    assert start(words).wait(timeout=300) in (0, 3)
    took = time.monotonic() - began
    whole = numbers(Path("out"), files)
    cut_short = 0
    for _ in range(times):
        subprocess.run(["rm", "-rf", "out", str(RUNS)], check=True)
        kill(start(words), took * rng.uniform(0.05, 1.0))
        kept, before = kept_runs(), begun_runs()
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
        # None was made again; one that was being made may write its line when its caller is gone.
        now = kept_runs()
        assert {path: now[path] for path in kept} == kept
        assert begun_runs() - before - (len(now) - len(kept)) in (0, 1)
    return cut_short


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "times"), [
    ("fit", 12), ("report", 12), ("diagnose", 12), ("sbc", 10), ("simulator", 8),
])  # fmt: skip
def test_fifty_kills_lose_nothing(verb: str, times: int, folder: Path) -> None:
    # Any seed must do: another one each time.
    cut_short = kill_and_go_again(verb, times, np.random.default_rng())
    print(f"{verb}: killed {times} times, {cut_short} of them before there was a result")
    assert cut_short > 0
    if verb == "simulator":
        assert begun_runs() > 30
