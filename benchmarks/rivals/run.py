"""Run calib and its rivals on the same cases; write rivals.json and the table rivals.md.

    cd benchmarks
    python -m rivals.run --out OUT                             # measured cases that are open
    python -m rivals.run --out OUT --set-aside                 # the others, once
    python -m rivals.run --out OUT --challenge CASES --key KEY # and blind cases besides

Causes, silence and localisation are judged on all field rows; predictions on every fourth, left
out, or at the conditions that a case asks for, where the key has the truth. Seconds are those of
one core, for a diagnosis of all rows. What OUT has is not done again.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr

from calib.data.quantities import OUTPUTS
from calib.errors import FAULTS, CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose_once
from calib.gap.files import write_diagnosis
from calib.models.simulators.files import load_files
from challenge.answers import ASKED_FOR, read_answer
from challenge.measured.cases import HERE, read_cases
from challenge.seal import open_key
from rivals.__main__ import LACKING, METHODS
from rivals.common import SEED, prepare, write
from rivals.table import CALIB, markdown, summary

EVERY = 4  # one field row in four is left out


@dataclass(frozen=True)
class Item:
    """A case with all its rows, with conditions to predict (if it can be), and what is right."""

    group: str
    name: str
    whole: Path
    part: Path | None
    causes: tuple[str, ...]  # none of a null
    defensible: tuple[str, ...]
    truth: dict[str, list[float]]  # by output, at the conditions to predict
    entry: dict[str, Any] | None = None  # of the challenge's key: the truth has no noise


def blind(folder: Path, key: Path) -> list[Item]:
    """Return the cases of `calib challenge make`."""
    items = []
    for name, e in open_key(folder, key)["cases"].items():
        acting = () if e["truth"] == "none" else tuple(e["truth"].split("+"))
        large = tuple(c for c in acting if e["contributions"].get(c, ASKED_FOR) >= ASKED_FOR)
        at, group = folder / name, f"challenge, {e['tier']}"
        items.append(Item(group, name, at, at, large or acting, acting, e["fresh_truth"], e))
    return items


def measured(out: Path, halves: Sequence[bool], only: Sequence[str] = ()) -> list[Item]:
    """Write the measured cases of some halves (whether set aside), and return them."""
    items = []
    for c in read_cases():
        if c.set_aside in halves and (not only or c.name in only):
            whole, part = out / c.name / "whole", out / c.name / "part"
            shutil.rmtree(whole, ignore_errors=True)
            c.write(whole)
            truth = without_some_rows(whole, part)
            causes = {"none": (), "unlisted": ("unknown",)}.get(c.expected, (c.expected,))
            at = part if truth else None
            items.append(Item(c.laboratory, c.name, whole, at, causes, c.defensible, truth))
    return items


def without_some_rows(whole: Path, part: Path) -> dict[str, list[float]]:
    """Copy a case without every fourth field row, to be predicted; return the readings there.

    If too few rows would stay there is no copy, and nothing is returned.
    """
    case = read_case(whole)
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(whole, part)
    file = Path(case.field.source).name
    outputs = {case.field.header_of(column) for column in OUTPUTS.values()}
    with (whole / file).open(encoding="utf-8-sig", newline="") as text:
        rows = list(csv.DictReader(text))
    held = [i for i in range(len(rows)) if i % EVERY == EVERY - 1]
    kept = [row for i, row in enumerate(rows) if i not in held]
    asked = [{h: v for h, v in rows[i].items() if h.strip() not in outputs} for i in held]
    for name, some in ((file, kept), ("left_out.csv", asked)):
        with (part / name).open("w", encoding="utf-8", newline="") as text:
            writer = csv.DictWriter(text, list(some[0]) if some else [], lineterminator="\n")
            writer.writeheader()
            writer.writerows(some)
    toml = (whole / "case.toml").read_text(encoding="utf-8")
    (part / "case.toml").write_text(f'predict = "left_out.csv"\n{toml}', encoding="utf-8")
    try:
        campaigns(read_case(part))
    except CalibError:
        shutil.rmtree(part)
        return {}
    return {o: case.field[OUTPUTS[o]][held].tolist() for o in case.models}


def answer(method: str, folder: Path, out: Path) -> None:
    """Let a program answer; calib leaves no rows out to say how far a gap shrinks."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    if method == CALIB:
        write_diagnosis(diagnose_once(read_case(folder), SEED), out)
    else:
        p = prepare(folder)
        write(p, METHODS[method](p), out)


def mark(method: str, item: Item, out: Path) -> dict[str, Any]:
    """Hold an answer against what is right."""
    said: dict[str, Any] = {"group": item.group, "case": item.name, "method": method}
    began = time.process_time()
    try:
        answer(method, item.whole, out / "whole")
        said["seconds"] = time.process_time() - began
        if item.part is not None and item.part != item.whole:
            answer(method, item.part, out / "part")
    except (CalibError, ArithmeticError, *FAULTS) as error:  # no answer is a wrong one
        said |= {"failed": f"{type(error).__name__}: {error}", "wrong": False}
        said["seconds"] = time.process_time() - began
        return said | ({"named": False, "seen": False} if item.causes else {"silent": False})
    told = json.loads((out / "whole" / "diagnosis.json").read_bytes())
    acting = {n: float(c["probability"]) for n, c in told["inclusion"].items()}
    acting["unknown"] = float(told["remainder"]["probability"])
    right, gap = {*item.causes, *item.defensible, "unknown"}, told["verdict"] != "none"
    said |= {"verdict": told["verdict"], "causes": {n: q for n, q in acting.items() if q >= 0.1}}
    said["wrong"] = any(q >= 0.9 for n, q in acting.items() if n not in right)
    if item.causes:
        named = all(acting.get(c, 0.0) >= 0.5 for c in item.causes)
        said |= {"named": named, "seen": gap}
    else:
        said["silent"] = not gap
    if item.entry is not None:
        said["auc"] = read_answer(item.name, item.entry, out / "whole").auc
    if item.part is not None:
        said |= correction(item, out / ("whole" if item.part == item.whole else "part"))
    return said


def correction(item: Item, out: Path) -> dict[str, float]:
    """Rms errors of predicting a reading, in noise sds, and the part of them in the 90 % band."""
    assert item.part is not None
    with (out / "fresh_prediction.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    squares: dict[str, list[float]] = {"before": [], "after": []}
    inside: list[float] = []
    for lab in prepare(item.part).labs:
        column, truth = OUTPUTS[lab.name], np.array(item.truth[lab.name])
        plain, after, low, high = (
            np.array([float(row[f"{column}_{part}"] or "nan") for row in rows])
            for part in ("before", "after", "after_lower", "after_upper")
        )
        known = np.isfinite(truth + plain)
        after = np.where(np.isfinite(after), after, plain)
        log = lab.output.problem.bound.model.response == "log"
        sd, more = lab.sd * (np.abs(plain) if log else np.ones(truth.size)), 0.0
        within = ((low <= truth) & (truth <= high)).astype(np.float64)
        if item.entry is not None:  # readings that the truth would have
            sd, more = np.full(truth.size, np.median(item.entry["noise_sd"][lab.name])), 1.0
            within = ndtr((high - truth) / sd) - ndtr((low - truth) / sd)
        for name, values in (("before", plain), ("after", after)):
            squares[name] += (np.square((values - truth) / sd) + more)[known].tolist()
        inside += np.nan_to_num(within)[known].tolist()
    errors = {name: float(np.sqrt(np.mean(values))) for name, values in squares.items()}
    return errors | {"covered": float(np.mean(inside))}


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser("python -m rivals.run", description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set-aside", action="store_true", help="the measured cases set aside")
    parser.add_argument("--both", action="store_true", help="all measured cases")
    parser.add_argument("--no-measured", action="store_true")
    parser.add_argument("--challenge", type=Path, metavar="CASES")
    parser.add_argument("--key", type=Path)
    parser.add_argument("--only", nargs="*", default=(), metavar="CASE")
    parser.add_argument("--methods", nargs="*", default=(CALIB, *METHODS), metavar="METHOD")
    own = [p for p in sorted(HERE.glob("*.py")) if "\nregister(" in p.read_text(encoding="utf-8")]
    parser.add_argument("--models", type=Path, nargs="*", default=own, metavar="FILE")
    given = parser.parse_args()
    load_files(given.models)
    items = blind(given.challenge, given.key) if given.challenge else []
    if not given.no_measured:
        halves = (True, False) if given.both else (given.set_aside,)
        items += measured(given.out / "cases", halves, given.only)
    marks = []
    for item in items:
        for method in (m for m in given.methods if m not in LACKING):
            out = given.out / "answers" / method / item.name
            if not (out / "mark.json").exists():
                made = mark(method, item, out)
                (out / "mark.json").write_text(json.dumps(made, indent=1), encoding="utf-8")
            marks.append(json.loads((out / "mark.json").read_bytes()))
        print(item.group, item.name, flush=True)
    content = {"marks": marks, "groups": summary(marks), "lacking": sorted(LACKING)}
    (given.out / "rivals.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (given.out / "rivals.md").write_text(markdown(marks, sorted(LACKING)), encoding="utf-8")
    print((given.out / "rivals.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
