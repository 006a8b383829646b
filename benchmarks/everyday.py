"""What the commands of every day take, beside the same commands of an earlier commit.

    python benchmarks/everyday.py --out everyday.json           # twenty minutes on two cores
    python benchmarks/everyday.py --against HEAD~3 --repeats 1  # beside another commit, quickly
    python benchmarks/everyday.py --against ""                  # this code alone
    python benchmarks/everyday.py --tests                       # `make test` too, once

The earlier commit is checked out into a worktree of its own, which goes when this ends; both run
in this environment, by turns. No peer is needed: the ordinary environment will do.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from shared.machine import describe

ROOT = Path(__file__).resolve().parent.parent
# The commit before this work on speed.
BEFORE = "ef0889b"
SEED = 77
CASES = 8

# What the process prints is measured in its inside: seconds on the clock, and of processors.
_IMPORT = """
import importlib, sys, time
for name in sys.argv[1:]:
    importlib.import_module(name)
wall, cpu = time.perf_counter(), time.process_time()
import calib.gap.diagnose
print(time.perf_counter() - wall, time.process_time() - cpu)
"""
_LIBRARIES = """
import sys
import calib.gap.diagnose
print(*(n for n in sys.modules if n.partition(".")[0] in ("numpy", "scipy") and "._" not in n))
"""
_DIAGNOSES = """
import statistics, sys, time
from calib.gap.diagnose import diagnose
diagnose(sys.argv[1], 1)
found = []
for folder in sys.argv[1:]:
    wall, cpu = time.perf_counter(), time.process_time()
    diagnose(folder, 1)
    found.append((time.perf_counter() - wall, time.process_time() - cpu))
print(*(statistics.median(column) for column in zip(*found)))
"""


@dataclass(frozen=True)
class Command:
    """What is typed, how often it is measured, and what is asked of it.

    `asked` is the most seconds, on the `clock` or of one `processor`; `ends` are the exit codes of
    a command that did its work; `inside` says that the process measures itself.
    """

    words: list[str]
    repeats: int = 5
    asked: float | None = None
    by: str = "clock"
    ends: tuple[int, ...] = (0,)
    inside: bool = False


class Tree:
    """One state of the code, and a folder for what its commands write."""

    def __init__(self, root: Path, scratch: Path) -> None:
        self.root, self.scratch = root, scratch
        # Modules are compiled beforehand, as they are for whoever runs a command again.
        drop = ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX")
        kept = {k: v for k, v in os.environ.items() if k not in drop}
        self.env = {**kept, "PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"}
        scratch.mkdir()
        there = [name for name in ("calib", "challenge", "tests") if (root / name).is_dir()]
        self.output(["-m", "compileall", "-q", *there])
        at = self.output(["-c", "import calib; print(calib.__file__)"])
        if not Path(at.strip()).is_relative_to(root):
            raise SystemExit(f"calib is imported from {at.strip()}, not from {root}")

    def output(self, words: list[str]) -> str:
        """Return what a command prints, not measured."""
        done = subprocess.run(
            [sys.executable, *words], cwd=self.root, env=self.env, check=True,
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        return done.stdout

    def measure(self, command: Command) -> tuple[float, float, int]:
        """Seconds on the clock and of processors, children's too, and the exit code."""
        with tempfile.TemporaryFile("w+") as said:
            began = time.perf_counter()
            process = subprocess.Popen(
                [sys.executable, *command.words], cwd=self.root, env=self.env,
                stdout=said, stderr=subprocess.STDOUT,
            )  # fmt: skip
            _, status, used = os.wait4(process.pid, 0)
            wall, cpu = time.perf_counter() - began, used.ru_utime + used.ru_stime
            process.returncode = code = os.waitstatus_to_exitcode(status)
            said.seek(0)
            text = said.read()
        if code not in command.ends:
            raise SystemExit(f"{command.words} ended with {code}:\n{text[-2000:]}")
        if command.inside:
            wall, cpu = map(float, text.split()[-2:])
        return wall, cpu, code

    def commands(self, cases: list[Path], tests: bool) -> dict[str, Command]:
        """What is measured, by the name it has in the tables."""
        run, data = str(self.scratch / "run"), str(self.scratch / "data")
        self.output([*_CALIB, "data", "he2019", "--out", data])
        pulls = f"{data}/drawbar_pull.csv"
        check = [*_CALIB, "check", "reports/he2019"]
        found = {
            "make report": Command(
                [*_CALIB, "report", "--out", f"{self.scratch}/report", "--overwrite"], asked=15.0
            ),
            "calib check reports/he2019": Command(check, asked=20.0, ends=(0, 1)),
            "calib check reports/he2019 --quick": Command([*check, "--quick"], ends=(0, 1)),
            "calib diagnose CASE": Command(
                [*_CALIB, "diagnose", str(cases[0]), "--overwrite",
                 "--out", f"{self.scratch}/diagnosis"], asked=3.0,
            ),
            f"one diagnosis, no page, after imports (median of {len(cases)} cases)": Command(
                ["-c", _DIAGNOSES, *map(str, cases)], asked=1.0, by="processor", inside=True
            ),
            "import calib.gap.diagnose, beyond NumPy and SciPy": Command(
                ["-c", _IMPORT, *self.output(["-c", _LIBRARIES]).split()],
                asked=0.6, inside=True,
            ),
            "python -c 'import calib'": Command(["-c", "import calib"]),
            "calib --help": Command([*_CALIB, "--help"]),
            # Where there is no such command yet, it ends with 2.
            "calib import, 100,000 rows of 8 columns": Command(
                [*_CALIB, "import", *_log(self.scratch), "--overwrite",
                 "--out", f"{self.scratch}/imported.csv"], asked=5.0,
                ends=self.ends("imports"),
            ),
            "calib joint, three outputs of a wheel: 60 readings, 11 parameters": Command(
                [*_CALIB, "joint", _wheel(self.scratch), *_models("pull", "torque", "sinkage"),
                 "--out", f"{self.scratch}/wheel", "--overwrite"], 3, asked=30.0,
                ends=self.ends("cli/joint.py"),
            ),
            "calib joint, 12 groups of 20 rows, two pooled parameters": Command(
                [*_CALIB, "joint", _groups(self.scratch), "--model", "bekker", "--group", "bin",
                 "--pool", "z_ref", "--pool", "n", "--out", f"{self.scratch}/groups",
                 "--overwrite"], 3, asked=60.0, ends=self.ends("cli/joint.py"),
            ),
            "calib fit": Command(
                [*_CALIB, "fit", pulls, "--model", "magic_formula_pressure", "--hold-out",
                 "inflation_pressure_psi=30", "--out", run, "--overwrite"],
            ),
            "calib predict": Command(
                [*_CALIB, "predict", run, "--at", pulls, "--overwrite",
                 "--out", f"{self.scratch}/predicted.csv"],
            ),
            "calib plan, 6 tests of 1,000 candidates": Command(
                [*_CALIB, "plan", run, "--grid", _grid(self.scratch), "--budget", "6"],
                asked=20.0, by="processor",
                ends=(0,) if (self.root / "calib" / "cli" / "plan.py").is_file() else (2,),
            ),
        }  # fmt: skip
        if tests:
            if find_spec("xdist") is None:
                raise SystemExit("the tests need `make test`'s environment")
            line = re.search(r"^\t\$\(BIN\)/python (-m pytest -n .*)$", self.makefile(), re.M)
            if line is None:
                raise SystemExit("no line of `make test` in the Makefile")
            found["make test"] = Command(line[1].split(), 1, 300.0, ends=(0, 1))
        return found

    def ends(self, part: str) -> tuple[int, ...]:
        """How a command ends that needs a part of the code, which this state may not have."""
        return (0,) if (self.root / "calib" / part).exists() else (2,)

    def makefile(self) -> str:
        """Return its Makefile."""
        return (self.root / "Makefile").read_text()


def _log(folder: Path) -> list[str]:
    """Write a noisy sweep of slip as a rig does; return what `calib import` takes."""
    import numpy as np

    n, rng = 100_000, np.random.default_rng(SEED)
    slip = 25.0 - 25.0 * np.cos(np.arange(n) / 1000.0)
    noise = np.convolve(rng.standard_normal(n + 9), np.ones(10), "valid")
    columns = {"slip_percent": slip, "drawbar_pull_n": 3e3 * np.tanh(slip / 10.0) + 10.0 * noise}
    columns |= {"normal_load_n": rng.normal(4e3, 10.0, n), "speed_m_s": rng.normal(1.0, 0.01, n)}
    columns |= {"inflation_pressure_kpa": rng.normal(180.0, 1.0, n)}
    mapping = "".join(f'{name} = {{from = "{name}"}}\n' for name in columns)
    columns |= {name: rng.normal(0.0, 10.0, n) for name in ("FY", "MX", "MZ")}
    path, table = folder / "run.csv", np.column_stack([*columns.values()])
    np.savetxt(path, table, "%.4f", ",", header=",".join(columns))
    path.with_suffix(".toml").write_text(f'[columns]\n{mapping}[thin]\nevery = "auto"\n')
    return [str(path), "--mapping", str(path.with_suffix(".toml"))]


def _models(*parts: str) -> list[str]:
    return [word for part in parts for word in ("--model", f"wong_reece_{part}")]


def _wheel(folder: Path) -> str:
    """Write pull, torque and sinkage of a rigid wheel at two loads, 20 rows."""
    import numpy as np

    from calib.models.wong_reece import contact

    n, rng = 20, np.random.default_rng(SEED)
    x = {
        "slip_ratio": np.tile(np.linspace(0.05, 0.6, n // 2), 2),
        "normal_load_kn": np.repeat([0.08, 0.16], n // 2),
        "tyre_width_m": np.full(n, 0.15), "tyre_diameter_m": np.full(n, 0.3),
    }  # fmt: skip
    soil = {"k1": 5.0, "k2": 1200.0, "n": 1.0, "c": 0.8, "phi": 30.0, "K": 12.0}
    found = contact(x, **{k: np.array([[v]]) for k, v in {**soil, "c1": 0.35, "c2": 0.3}.items()})
    x["drawbar_pull_kn"] = found.pull[0] + 0.003 * rng.standard_normal(n)
    x["driving_torque_knm"] = found.torque[0] + 0.0004 * rng.standard_normal(n)
    x["rut_depth_mm"] = 1000.0 * found.sinkage[0] * np.exp(0.05 * rng.standard_normal(n))
    path = folder / "wheel.csv"
    np.savetxt(path, np.column_stack([*x.values()]), "%.6g", ",", header=",".join(x), comments="")
    return str(path)


def _groups(folder: Path) -> str:
    """Write sinkages in twelve bins, 20 rows each."""
    import numpy as np

    rng, lines = np.random.default_rng(SEED), ["average_ground_pressure_kpa,rut_depth_mm,bin"]
    for i in range(12):
        z, n = 20.0 * np.exp(0.3 * rng.standard_normal()), np.exp(0.2 * rng.standard_normal())
        for p in np.linspace(40.0, 200.0, 20):
            depth = z * (p / 100.0) ** (1.0 / n) * np.exp(0.06 * rng.standard_normal())
            lines.append(f"{p:.6g},{depth:.6g},bin {i + 1}")
    path = folder / "groups.csv"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def _grid(folder: Path) -> str:
    """Write the conditions of a thousand possible tests."""
    rows = [f"{0.6 * i},{18 + 24 * j / 9}" for i in range(1, 101) for j in range(10)]
    path = folder / "possible.csv"
    path.write_text("\n".join(["slip_percent,inflation_pressure_psi", *rows]) + "\n")
    return str(path)


_MEASURED = ("clock", "processor", "exit_codes")
_CALIB = ["-c", "from calib.cli import main; main()"]


def measured(trees: dict[str, Tree], cases: list[Path], options: argparse.Namespace) -> dict:
    """Seconds of every command, the trees by turns."""
    commands = {side: tree.commands(cases, options.tests) for side, tree in trees.items()}
    found = {}
    for name, command in commands["now"].items():
        if not re.search(options.only, name):
            continue
        sides: dict[str, list[tuple[float, float, int]]] = {side: [] for side in trees}
        for _ in range(min(command.repeats, options.repeats)):
            for side, tree in trees.items():
                sides[side].append(tree.measure(commands[side][name]))
        found[name] = {"asked": command.asked, "by": command.by} | {
            side: dict(zip(_MEASURED, zip(*runs, strict=True), strict=True))
            for side, runs in sides.items()
        }  # fmt: skip
        print(name, {side: [f"{run[0]:.2f}" for run in runs] for side, runs in sides.items()})
    return found


def made_or_shared(scratch: Path) -> list[Path]:
    """Case folders: the shared ones, or some of the blind test's where there are none."""
    shared = ROOT.parent / "shared" / "cases"
    if not shared.is_dir():
        from challenge.make import make

        shared = scratch / "cases"
        make(shared, scratch / "answers", seed=SEED, n_cases=CASES)
    return sorted(p.parent for p in shared.glob("*/case.toml"))[:CASES]


def git(*words: str) -> str:
    """Return what git says of this repository."""
    done = subprocess.run(
        ["git", "-C", str(ROOT), *words], check=True, stdout=subprocess.PIPE, text=True
    )
    return done.stdout.strip()


@contextmanager
def checked_out(ref: str, folder: Path) -> Iterator[None]:
    """Have a commit in a worktree, for a while."""
    git("worktree", "add", "--quiet", "--detach", str(folder), ref)
    try:
        yield
    finally:
        git("worktree", "remove", "--force", str(folder))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, help="JSON file to write; printed if none")
    parser.add_argument("--against", default=BEFORE, help="commit to run beside; '' for none")
    parser.add_argument("--repeats", type=int, default=5, help="at most; of the tests one")
    parser.add_argument("--only", default="", help="commands whose name has this pattern")
    parser.add_argument("--tests", action="store_true", help="`make test` too, once")
    options = parser.parse_args()
    # A polite kill takes the worktree away as an interrupt does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    result = {
        "machine": describe(),
        "load_before": os.getloadavg(),
        "now": git("rev-parse", "HEAD"),
    }
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        cases = made_or_shared(scratch)
        now = Tree(ROOT, scratch / "of-now")
        if options.against:
            result["before"] = git("rev-parse", options.against)
            with checked_out(options.against, scratch / "before"):
                before = Tree(scratch / "before", scratch / "of-before")
                result["commands"] = measured({"before": before, "now": now}, cases, options)
        else:
            result["commands"] = measured({"now": now}, cases, options)
    result["load_after"] = os.getloadavg()
    text = json.dumps(result, indent=1) + "\n"
    if options.out is None:
        print(text)
    else:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
