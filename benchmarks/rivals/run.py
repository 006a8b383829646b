"""Run calib and its rivals on cases whose answers are known; write rivals.json and rivals.md.

    cd benchmarks && python -m rivals.run --cases CASES --answers ANSWERS --out OUT

Both are folders as docs/formats/cases.md has them, of blind cases (`calib challenge make`) or of
measured ones (`python -m challenge.measured --cases-only --leave-out 4`). Seconds are those of one
core for a diagnosis. What OUT has is not done again.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr

from calib.data.quantities import OUTPUTS
from calib.errors import FAULTS, CalibError
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose_once
from calib.gap.files import write_diagnosis
from calib.models.simulators.files import load_files
from challenge.answers import ASKED_FOR, auc
from challenge.measured.cases import HERE
from rivals.__main__ import LACKING, METHODS
from rivals.common import SEED, prepare, write
from rivals.table import CALIB, markdown

type Known = Mapping[str, Any]  # the content of an answer.json


def answer(method: str, case: Path, out: Path) -> None:
    """Let a program answer; calib leaves no rows out to say how far a gap shrinks."""
    out.mkdir(parents=True, exist_ok=True)
    if method == CALIB:
        write_diagnosis(diagnose_once(read_case(case), SEED), out)
    else:
        p = prepare(case)
        write(p, METHODS[method](p), out)


def mark(method: str, case: Path, known: Known, out: Path) -> dict[str, Any]:
    """Let a method answer, and hold that against what is right; no answer is a wrong one."""
    group = known["laboratory"] if known["tier"] == "measured" else f"blind, {known['tier']}"
    said: dict[str, Any] = {"group": group, "case": case.name, "method": method}
    acting = [] if known["truth"] == "none" else known["truth"].split("+")
    sizes = known.get("contributions", {})
    asked = [c for c in acting if sizes.get(c, ASKED_FOR) >= ASKED_FOR] or acting
    began = time.process_time()
    try:
        answer(method, case, out)
    except (CalibError, ArithmeticError, *FAULTS) as error:
        said |= {"failed": f"{type(error).__name__}: {error}", "wrong": False}
        said |= {"named": False, "seen": False} if asked else {"silent": False}
        return said | {"seconds": time.process_time() - began}
    said["seconds"] = time.process_time() - began
    told = json.loads((out / "diagnosis.json").read_bytes())
    found = {name: float(c["probability"]) for name, c in told["inclusion"].items()}
    found["unknown"] = float(told["remainder"]["probability"])
    right, gap = {*acting, *known.get("defensible", ()), "unknown"}, told["verdict"] != "none"
    said |= {"verdict": told["verdict"], "causes": {n: q for n, q in found.items() if q >= 0.1}}
    said["wrong"] = any(q >= 0.9 for name, q in found.items() if name not in right)
    if asked:
        said |= {"named": all(found.get(c, 0.0) >= 0.5 for c in asked), "seen": gap}
    else:
        said["silent"] = not gap
    if acting and "field_truth" in known:
        said["auc"] = localisation(told["where"], known)
    return said | (correction(case, known, out) if known.get("fresh_truth") else {})


def localisation(where: list[dict[str, Any]], known: Known) -> float | None:
    """Area under the curve of stated probabilities against true gaps beyond the noise."""
    said = {(w["output"], w["row"]): w["probability"] for w in where}
    scores, beyond = [], []
    for name, sd in known["noise_sd"].items():
        true, without = (np.array(known[part][name]) for part in ("field_truth", "field_without"))
        beyond += (np.abs(true - without) > np.array(sd)).tolist()
        scores += [said.get((name, row), 0.0) for row in range(true.size)]
    return auc(np.array(scores), np.array(beyond))


def correction(case: Path, known: Known, out: Path) -> dict[str, float]:
    """Rms errors of predicting a reading, in noise sds, and the part of them in the 90 % band."""
    with (out / "fresh_prediction.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    squares: dict[str, list[float]] = {"before": [], "after": []}
    inside: list[float] = []
    for lab in prepare(case).labs:
        column, truth = OUTPUTS[lab.name], np.array(known["fresh_truth"][lab.name])
        plain, after, low, high = (
            np.array([float(row[f"{column}_{part}"] or "nan") for row in rows])
            for part in ("before", "after", "after_lower", "after_upper")
        )
        there = np.isfinite(truth + plain)
        after = np.where(np.isfinite(after), after, plain)
        log = lab.output.problem.bound.model.response == "log"
        sd, more = lab.sd * (np.abs(plain) if log else np.ones(truth.size)), 0.0
        within = ((low <= truth) & (truth <= high)).astype(np.float64)
        if "noise_sd" in known:  # the truth without noise: readings that it would have
            sd, more = np.full(truth.size, np.median(known["noise_sd"][lab.name])), 1.0
            within = ndtr((high - truth) / sd) - ndtr((low - truth) / sd)
        for name, values in (("before", plain), ("after", after)):
            squares[name] += (np.square((values - truth) / sd) + more)[there].tolist()
        inside += np.nan_to_num(within)[there].tolist()
    errors = {name: float(np.sqrt(np.mean(values))) for name, values in squares.items()}
    return errors | {"covered": float(np.mean(inside))}


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser("python -m rivals.run", description=__doc__.split("\n")[0])
    for name in ("--cases", "--answers"):
        parser.add_argument(name, type=Path, nargs="+", required=True, metavar="FOLDER")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--methods", nargs="*", default=(CALIB, *METHODS), metavar="METHOD")
    own = [p for p in sorted(HERE.glob("*.py")) if "\nregister(" in p.read_text(encoding="utf-8")]
    parser.add_argument("--models", type=Path, nargs="*", default=own, metavar="FILE")
    given = parser.parse_args()
    load_files(given.models)
    marks = []
    for cases, answers in zip(given.cases, given.answers, strict=True):
        for case in sorted(path.parent for path in cases.glob("*/case.toml")):
            known = json.loads((answers / case.name / "answer.json").read_bytes())
            for method in (m for m in given.methods if m not in LACKING):
                out = given.out / "answers" / method / case.name
                if not (out / "mark.json").exists():
                    made = json.dumps(mark(method, case, known, out), indent=1)
                    (out / "mark.json").write_text(made, encoding="utf-8")
                marks.append(json.loads((out / "mark.json").read_bytes()))
            print(marks[-1]["group"], case.name, flush=True)
    (given.out / "rivals.json").write_text(json.dumps(marks, indent=1) + "\n", encoding="utf-8")
    for method in {one["method"] for one in marks}:  # for the board of `calib challenge score`
        times = (f"{m['case']},{m['seconds']:.6f}\n" for m in marks if m["method"] == method)
        text = "".join(times)
        (given.out / "answers" / method / "seconds.csv").write_text(text, encoding="utf-8")
    page = markdown(marks, sorted(LACKING))
    (given.out / "rivals.md").write_text(page, encoding="utf-8")
    print(page)


if __name__ == "__main__":
    main()
