"""A campaign of diagnoses whose workers and client are killed, against one that ran undisturbed.

    python benchmarks/campaign_survival.py --cases 200 --out survival.json

Challenge cases are made, and diagnosed by `calib campaign` on two workers. A worker is killed at a
quarter of the results and another at three quarters; the client, with everything it started, is
killed (SIGKILL) at a half, and the same command is given again. The files are then compared, byte
by byte, with those of a campaign done in one process.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

SEED = 77
PLAN = '[[diagnose]]\nname = "case"\ncases = ["cases/*"]\n'
CALIB = [sys.executable, "-c", "from calib.cli import main; main()"]


def calib(folder: Path, *words: str) -> subprocess.Popen[bytes]:
    """Start the program."""
    return subprocess.Popen([*CALIB, *words], cwd=folder, stderr=subprocess.DEVNULL)


def finished(folder: Path, out: str) -> set[str]:
    """Return the tasks that have a result."""
    return {p.parent.name for p in (folder / out / "results").glob("*/task.json")}


def wait(process: subprocess.Popen[bytes], until: Callable[[], bool]) -> None:
    """Wait for a condition while a process runs."""
    while not until():
        if process.poll() is not None:
            raise SystemExit("the campaign ended too early to be killed")
        time.sleep(0.02)


def workers(client: int) -> list[psutil.Process]:
    """Return the worker processes of a client."""
    children = psutil.Process(client).children()
    return [c for c in children if "spawn_main" in " ".join(c.cmdline())]


def content(folder: Path) -> dict[str, bytes]:
    """Return the files of a campaign but the one that holds times."""
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != "seconds.csv"
    }


def survive(folder: Path, count: int) -> dict[str, object]:
    """Run a campaign through two killed workers and a killed client."""
    words = ("campaign", "plan.toml", "--out", "killed", "--workers", "2")
    client = calib(folder, *words)
    wait(client, lambda: len(finished(folder, "killed")) >= count // 4)
    workers(client.pid)[0].kill()
    wait(client, lambda: len(finished(folder, "killed")) >= count // 2)
    orphans = workers(client.pid)
    client.kill()
    client.wait()
    _, alive = psutil.wait_procs(orphans, timeout=30)
    there = finished(folder, "killed")
    before = {n: (folder / "killed/results" / n).stat().st_mtime_ns for n in there}
    client = calib(folder, *words)
    wait(client, lambda: len(finished(folder, "killed")) >= 3 * count // 4)
    workers(client.pid)[-1].kill()
    code = client.wait()
    after = {n: (folder / "killed/results" / n).stat().st_mtime_ns for n in there}
    return {
        "results_when_the_client_was_killed": len(there),
        "workers_left_by_the_killed_client": len(alive),
        "done_again": sum(before[n] != after[n] for n in there),
        "exit_code": code,
        "results": len(finished(folder, "killed")),
    }


def main() -> None:
    """Make cases, run both campaigns and compare them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, help="JSON file to write; printed if none")
    parser.add_argument("--cases", type=int, default=200)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        make = ("challenge", "make", "--out", "cases", "--key", "key", "--seed", str(SEED))
        if calib(folder, *make, "--cases", str(options.cases)).wait():
            raise SystemExit("the cases could not be made")
        (folder / "plan.toml").write_text(PLAN)
        result = {"cases": options.cases, **survive(folder, options.cases)}
        began = time.perf_counter()
        code = calib(folder, "campaign", "plan.toml", "--out", "whole", "--workers", "1").wait()
        result["undisturbed_serial_exit_code"] = code
        result["undisturbed_serial_seconds"] = time.perf_counter() - began
        killed, whole = content(folder / "killed"), content(folder / "whole")
        result["files_compared"] = len(whole)
        result["files_that_differ"] = sum(
            killed.get(n) != whole.get(n) for n in killed.keys() | whole.keys()
        )
    text = json.dumps(result, indent=1) + "\n"
    if options.out is None:
        print(text)
    else:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
