"""Whether the tests notice a small error: the code is changed at random, one place at a time.

    python benchmarks/mutation.py --of 40 --seed 22           # goes on where it was stopped
    python benchmarks/mutation.py --of 9 9 6 36 --seed 24     # so many of each area
    python benchmarks/mutation.py --seed 22 --again FILE:K --room  # one that survived, once more
    python benchmarks/mutation.py --seed 22 --table           # what was found so far

Of each area of `AREAS` so many places are drawn: a comparison, an operator, a number, a truth
value, a condition, a sign or what a function returns. Each change is made in a copy of the
project, and the tests of its module run there up to the first that fails: it was killed. So was
one that takes five times the tests' processor time: it hangs. With --room those of its room run
where none of these fails. Not drawn from are messages, annotations, decorators and the guards
`strict=`, `repr=` and `compare=`, of which no result depends. Each result is a line of
`out/mutation/SEED.jsonl`.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import cache_from_source
from itertools import zip_longest
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "out" / "mutation"
AREAS = {
    "models": ("models/*.py",),
    "likelihood": ("inference/likelihood.py",),
    "gate": ("inference/diagnostics.py",),
    "gap": ("gap/*.py", "gap/effects/*.py"),
}
# Tests of a module besides `test_MODULE.py`, by the start of its path.
ALSO = {
    "models/": "models/test_equations.py models/test_published.py models/test_properties.py "
    "models/test_examples.py extension/test_extension.py",
    "models/latex": "report/publish/test_latex.py",
    "models/magic_formula": "inference/estimators/test_genetic.py report/test_study.py",
    "models/wong_reece": "models/test_rigid_wheel.py",
    "inference/likelihood": "inference/test_problem.py inference/test_conjugate.py",
    "inference/diagnostics": "report/test_posterior_text.py validation/test_sensitivity.py",
    "gap/effects/": "gap/test_effect_equations.py gap/test_effects.py gap/test_forward.py "
    "gap/test_load_effects.py gap/test_declared.py gap/test_which.py",
    "gap/ascent": "gap/test_fit.py",
    "gap/case": "gap/test_declared.py",
    "gap/corrected": "gap/test_case.py",
    "gap/diagnose": "gap/test_case.py gap/test_hypotheses.py gap/test_files.py",
    "gap/discrepancy": "gap/test_forward.py",
    "gap/fit": "gap/test_evidence.py gap/test_which.py gap/test_shifts.py",
    "gap/forward": "gap/test_fit.py gap/test_shifts.py",
    "gap/guesses": "gap/test_sets.py gap/test_ascent.py gap/test_fit.py",
    "gap/hypotheses": "gap/test_odds.py",
    "gap/hypothesis": "gap/test_hypotheses.py gap/test_forward.py gap/test_fit.py",
    "gap/inclusion": "gap/test_diagnose.py gap/test_sets.py",
    "gap/mixture": "gap/test_where.py gap/test_shrink.py gap/test_shifts.py",
    "gap/noise": "gap/test_evidence.py",
    "gap/odds": "gap/test_sets.py gap/test_context.py gap/test_which.py",
    "gap/refine": "gap/test_evidence.py",
    "gap/residuals": "gap/test_ascent.py gap/test_fit.py",
    "gap/screening": "gap/test_diagnose.py",
    "gap/shifts": "gap/test_shift_prior.py",
    "gap/simulated": "gap/test_emulated.py gap/test_well_specified.py gap/test_hypotheses.py",
}

OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Div, ast.Mod: ast.Mult, ast.And: ast.Or, ast.Or: ast.And, ast.USub: ast.UAdd,
}  # fmt: skip
LEFT_OUT = (ast.Raise, ast.TypeAlias, ast.JoinedStr, ast.Import, ast.ImportFrom)
GUARDS = {"strict", "repr", "compare"}


@dataclass(frozen=True)
class Place:
    """One change that can be made: the k-th of a file."""

    area: str
    file: str
    k: int


def inside(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes below one that are drawn from, in the order of the file."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            guard = isinstance(child, ast.keyword) and child.arg in GUARDS
            if isinstance(child, ast.AST) and not guard and not isinstance(child, LEFT_OUT):
                yield child
                yield from inside(child)


def changes(tree: ast.Module) -> Iterator[tuple[str, ast.AST, Callable[[], None]]]:
    """Yield each change of a module: its kind, the node, and what changes it in the tree."""

    def put(node: ast.AST, name: str, value: object) -> Callable[[], None]:
        return lambda: setattr(node, name, value)

    def negated(node: ast.expr) -> ast.expr:
        return ast.UnaryOp(ast.Not(), node)

    for node in inside(tree):
        match node:
            case ast.Compare(ops=[op]):
                yield "comparison", node, put(node, "ops", [OTHER[type(op)]()])
            case ast.Compare(ops=[op, *rest]):
                yield "comparison", node, put(node, "ops", [OTHER[type(op)](), *rest])
            case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in OTHER:
                yield "arithmetic", node, put(node, "op", OTHER[type(op)]())
            case ast.BoolOp(op=op):
                yield "boolean", node, put(node, "op", OTHER[type(op)]())
            case ast.Constant(value=bool(value)):
                yield "boolean", node, put(node, "value", not value)
            case ast.Constant(value=int(value) | float(value)):
                yield "constant", node, put(node, "value", value + 1)
            case ast.UnaryOp(op=ast.USub()):
                yield "sign", node, put(node, "op", ast.UAdd())
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                yield "boolean", node, put(node, "operand", negated(operand))
            case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
                yield "condition", node, put(node, "test", negated(test))
            case ast.Return(value=ast.expr() as value) if ast.unparse(value) != "None":
                yield "return", node, put(node, "value", ast.Constant(None))


def changed(text: str, k: int) -> tuple[str, str, int, str]:
    """Return a module's text with its k-th change, and of that its kind, line and what it was."""
    tree = ast.parse(text)
    kind, node, make = list(changes(tree))[k]
    was = ast.unparse(node).splitlines()[0]
    make()
    ast.fix_missing_locations(tree)
    return ast.unparse(tree), kind, node.lineno, f"{was} -> {ast.unparse(node).splitlines()[0]}"


def places(area: str) -> list[Place]:
    """Return every change that can be made in an area."""
    files = sorted(f for pattern in AREAS[area] for f in (ROOT / "calib").glob(pattern))
    return [
        Place(area, file.relative_to(ROOT).as_posix(), k)
        for file in files
        for k in range(len(list(changes(ast.parse(file.read_text(encoding="utf-8"))))))
    ]


def area_of(file: str) -> str:
    """Return the area of a file."""
    return next(area for area in AREAS if any(place.file == file for place in places(area)))


def drawn(of: list[int], seed: int) -> list[Place]:
    """Draw so many changes of each area, or as many of all, the areas by turns."""
    rng = np.random.default_rng(seed)
    each = []
    for area, n in zip(AREAS, of if len(of) > 1 else of * len(AREAS), strict=True):
        every = places(area)
        each.append([every[i] for i in rng.permutation(len(every))[:n]])
    return [place for turn in zip_longest(*each) for place in turn if place]


def tests_of(file: str) -> tuple[str, ...]:
    """Return the tests of a module, the most direct first."""
    module = Path(file).relative_to("calib").with_suffix("")
    own = module.with_name(f"test_{module.name}.py").as_posix()
    also = " ".join(ALSO[start] for start in reversed(ALSO) if module.as_posix().startswith(start))
    mine = (own,) if (ROOT / "tests" / own).exists() else ()
    return tuple(dict.fromkeys((*mine, *also.split())))


class Copy:
    """A copy of the project in which changes are made and tests run."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "project"
        out = shutil.ignore_patterns(".*", "out", "__pycache__")
        shutil.copytree(ROOT, self.root, ignore=out)

    def run(self, tests: tuple[str, ...], limit: float) -> tuple[int, float, str]:
        """Run tests up to the first failure; return exit code, processor time and last lines."""

        def bounded() -> None:
            resource.setrlimit(resource.RLIMIT_CPU, (int(limit) + 1, int(limit) + 5))

        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header",
             "--hypothesis-seed=0", *(f"tests/{t}" for t in tests)],
            cwd=self.root, capture_output=True, text=True, check=False, preexec_fn=bounded,
            env={**os.environ, "PYTHONPATH": str(self.root), "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return done.returncode, took, done.stdout[-300:]

    @cache  # noqa: B019
    def usual(self, tests: tuple[str, ...]) -> float:
        """Return the processor time of tests, which must pass on the code as it is."""
        code, took, said = self.run(tests, 3600.0)
        if code:
            raise SystemExit(f"the tests fail without a change: {said}")
        return took

    def judge(self, place: Place, *, room: bool) -> dict[str, object]:
        """Make a change, run the tests of its module, perhaps of its room, and take it back."""
        path = self.root / place.file
        text = path.read_text(encoding="utf-8")
        new, kind, line, what = changed(text, place.k)
        code, total, said = 0, 0.0, ""
        rooms = [(Path(place.file).parts[1],)] if room else []
        for tests in (tests_of(place.file), *rooms):
            limit = 5.0 * self.usual(tests) + 20.0
            try:
                write(path, new)
                code, took, said = self.run(tests, limit)
            finally:
                write(path, text)
            total += took
            if code:
                break
        fate = "survived" if code == 0 else "hung" if code < 0 else "killed"
        return {**vars(place), "kind": kind, "line": line, "what": what, "fate": fate,
                "seconds": round(total, 1), "said": "" if code == 0 else said}  # fmt: skip


def write(path: Path, text: str) -> None:
    """Write a module, and forget what it was compiled to, perhaps in the same second."""
    path.write_text(text, encoding="utf-8")
    Path(cache_from_source(str(path))).unlink(missing_ok=True)


def table(rows: list[dict[str, object]]) -> None:
    """Print kills by area, blind and now, with 95 % intervals; then what was not killed at once."""
    judged: dict[tuple[str, int], list[dict[str, object]]] = {}
    for row in rows:
        judged.setdefault((str(row["file"]), int(str(row["k"]))), []).append(row)
    for area in AREAS:
        mine = [rows for rows in judged.values() if rows[0]["area"] == area]
        if not mine:
            continue
        cells = [area, str(len(places(area))), str(len(mine))]
        for when in (0, -1):
            killed = sum(rows[when]["fate"] != "survived" for rows in mine)
            low, high = wilson(killed, len(mine))
            cells += [str(killed), f"{killed / len(mine):.0%} ({low:.0%} to {high:.0%})"]
        print("| " + " | ".join(cells) + " |")
    for (file, k), (first, *later) in judged.items():
        if first["fate"] != "killed":
            said = [str(r["said"]).partition("FAILED ")[2].split(" ")[0] for r in later]
            print(f"{file}:{k} line {first['line']}: {first['what']}: {first['fate']}", *said)


def wilson(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    z2 = 1.96**2
    middle, half = k + z2 / 2, 1.96 * np.sqrt(k * (n - k) / n + z2 / 4)
    return (middle - half) / (n + z2), (middle + half) / (n + z2)


def main() -> None:
    """Judge what was drawn and not judged yet, or some once more; or show what was found."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    ask.add_argument("--of", type=int, nargs="+", default=[40], help="places of each area")
    ask.add_argument("--seed", type=int, default=22)
    ask.add_argument("--room", action="store_true", help="where none fails, all of the room's")
    ask.add_argument("--again", nargs="+", default=(), help="FILE:K to judge once more")
    ask.add_argument("--table", action="store_true")
    asked = ask.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    file = OUT / f"{asked.seed}.jsonl"
    file.touch()
    found = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    if asked.table:
        table(found)
        return
    again = [
        Place(area_of(name), name, int(k))
        for name, _, k in (each.rpartition(":") for each in asked.again)
    ]
    done = {(row["file"], row["k"]) for row in found}
    first = [p for p in drawn(asked.of, asked.seed) if (p.file, p.k) not in done]
    with tempfile.TemporaryDirectory(prefix="calib-mutation-") as folder:
        copy = Copy(Path(folder))
        for place in again or first:
            result = copy.judge(place, room=asked.room)
            with file.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
