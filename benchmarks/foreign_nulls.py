"""Nulls whose wheel is not the simulator's, and how often no gap is called one.

    python benchmarks/foreign_nulls.py --seed 1 --cases 100 --out nulls.jsonl
    python benchmarks/foreign_nulls.py --table nulls.jsonl

Laboratory and field follow one curve of pull over slip, drawn from mechanics that the calibrated
model does not hold (`CURVES`), or the model's own bent by a smooth random function. Readings are
few, 14 to 26 in all, at levels of slip or spread over it; their noise is independent, shared by the
readings of a sweep, or correlated along the runs (`NOISES`). Field and laboratory are random halves
of one series, or two campaigns of the same ground. Runs may be added to a file of an earlier one.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.gap.case import Case
from calib.gap.diagnose import screened_ranking, verdict
from calib.gap.effects import EFFECTS
from calib.gap.mixture import UNLISTED, inclusion_probability
from calib.models import get_model
from challenge.score import Proportion

type Array = NDArray[np.float64]

CURVES = ("janosi", "brixius", "wong_reece", "late_rise", "hump", "bent")
NOISES = ("independent", "sweeps", "autocorrelated")
_TRACTION = Path(__file__).parents[1] / "challenge" / "measured" / "traction.py"


def _janosi(rng: np.random.Generator, slip: Array) -> Array:
    """Janosi and Hanamoto's gross traction less a constant resistance."""
    scale, resistance = rng.uniform(0.04, 0.35), rng.uniform(0.03, 0.2)
    return np.asarray(rng.uniform(0.3, 0.7) * (1.0 - np.exp(-slip / scale)) - resistance)


def _brixius(rng: np.random.Generator, slip: Array) -> Array:
    """Brixius (1987): gross traction less a resistance that grows with slip."""
    number = rng.uniform(10.0, 50.0)
    gross = 0.88 * (1.0 - np.exp(-0.1 * number)) * (1.0 - np.exp(-7.5 * slip)) + 0.04
    return np.asarray(gross - (1.0 / number + 0.04 + 0.5 * slip / np.sqrt(number)))


def _wong_reece(rng: np.random.Generator, slip: Array) -> Array:
    """Wong and Reece (1967), a wheel of 0.15 m by 0.5 m under 0.6 kN on soils of many kinds."""
    model = get_model("wong_reece_pull")
    n = slip.size
    conditions = {
        "slip_ratio": np.maximum(slip, 0.0), "normal_load_kn": np.full(n, 0.6),
        "tyre_width_m": np.full(n, 0.15), "tyre_diameter_m": np.full(n, 0.5),
    }  # fmt: skip
    while True:
        theta = np.array([[
            rng.uniform(0.0, 20.0), np.exp(rng.normal(7.3, 0.5)), rng.uniform(0.6, 1.2),
            rng.uniform(0.2, 3.0), rng.uniform(24.0, 38.0), rng.uniform(6.0, 30.0),
            rng.uniform(0.2, 0.45), rng.uniform(0.2, 0.4),
        ]])  # fmt: skip
        pull = model.bind(conditions).predict(theta, conditions)[0] / 0.6
        if np.isfinite(pull).all() and np.ptp(pull) > 0.1:
            return np.asarray(pull)


def _late_rise(rng: np.random.Generator, slip: Array) -> Array:
    """Traction that goes on rising, faster at large slip, as grousers dig in."""
    return _janosi(rng, slip) + rng.uniform(0.1, 0.4) * slip ** rng.uniform(1.0, 3.0)


def _hump(rng: np.random.Generator, slip: Array) -> Array:
    """Traction that softens beyond a peak, and digging that costs pull at large slip."""
    peak, width = rng.uniform(0.1, 0.35), rng.uniform(0.03, 0.2)
    lost = rng.uniform(0.1, 0.4) / (1.0 + np.exp(-(slip - peak) / width))
    return _janosi(rng, slip) - lost * (0.5 + slip)


def _bent(rng: np.random.Generator, slip: Array) -> Array:
    """The Magic Formula; what it is bent by is of some noise sds, and added with the noise."""
    theta = np.array([[
        np.exp(rng.normal(np.log(0.03), 0.5)), np.clip(rng.normal(1.5, 0.15), 1.05, 1.95),
        rng.uniform(0.15, 0.5), np.exp(rng.normal(np.log(4.0), 0.6)), rng.normal(0.0, 1.5),
        rng.normal(-0.05, 0.03),
    ]])  # fmt: skip
    conditions = {"slip_ratio": slip}
    return get_model("magic_formula").bind(conditions).predict(theta, conditions)[0]


_OF = dict(zip(CURVES, (_janosi, _brixius, _wong_reece, _late_rise, _hump, _bent), strict=True))


def smooth(rng: np.random.Generator, u: Array, length: float) -> Array:
    """Draw a Gaussian process with a squared-exponential kernel, sd 1, shape (n,)."""
    kernel = np.exp(-0.5 * ((u[:, None] - u) / length) ** 2) + 1e-8 * np.eye(u.size)
    return np.asarray(np.linalg.cholesky(kernel) @ rng.standard_normal(u.size))


def _slips(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Slips of a series in the order of its runs, and the sweep that each is of."""
    top = rng.uniform(0.5, 0.9)
    if rng.random() < 0.5:
        slip = np.sort(rng.uniform(0.0, top, n))
        sweep = np.arange(n) * 3 // n
        return rng.permutation(slip), sweep
    levels = int(rng.integers(5, 9))
    at = top * np.linspace(0.0, 1.0, levels) ** rng.uniform(1.0, 1.6)
    slip = np.resize(at, n) + rng.normal(0.0, 0.002, n)
    return np.maximum(slip, 0.0), np.arange(n) // levels


def _noise(rng: np.random.Generator, kind: str, sweep: Array) -> Array:
    """Noise of sd 1 of successive readings."""
    z = rng.standard_normal(sweep.size)
    if kind == "sweeps":
        part = rng.uniform(0.3, 0.6)
        return np.asarray(
            np.sqrt(part) * rng.standard_normal(int(sweep.max()) + 1)[sweep] + np.sqrt(1 - part) * z
        )
    if kind == "autocorrelated":
        rho = rng.uniform(0.4, 0.8)
        for i in range(1, z.size):
            z[i] = rho * z[i - 1] + np.sqrt(1.0 - rho**2) * z[i]
    return z


def null_case(rng: np.random.Generator, name: str) -> tuple[Case, dict[str, Any]]:
    """Draw a pair of campaigns between which nothing differs, and what they are made of."""
    curve, noise = str(rng.choice(CURVES)), str(rng.choice(NOISES))
    split = bool(rng.random() < 0.7)
    n_lab, n_field = int(rng.integers(7, 14)), int(rng.integers(7, 14))
    if split:
        n_field = n_lab - int(rng.random() < 0.5)
    if split:
        slip, sweep = _slips(rng, n_lab + n_field)
    else:
        parts = [_slips(rng, n) for n in (n_lab, n_field)]
        slip = np.concatenate([p[0] for p in parts])
        sweep = np.concatenate([parts[0][1], parts[1][1] + 1 + parts[0][1].max()])
    pull = _OF[curve](rng, slip)
    sd = rng.uniform(0.02, 0.08) * np.ptp(pull)
    misfit = rng.uniform(0.5, 3.0) if curve == "bent" else 0.0
    if misfit:
        pull = pull + misfit * sd * smooth(rng, slip, rng.uniform(0.08, 0.35))
    grown = 1.0 + rng.choice([0.0, 1.0]) * slip
    pull = pull + sd * grown * _noise(rng, noise, sweep)
    load = np.exp(rng.normal(-0.5, 1.0))
    columns = {"slip_ratio": slip, "normal_load_kn": np.full(slip.size, load)}
    if rng.random() < 0.5:
        columns["normal_load_kn"] = load * np.exp(rng.normal(0.0, 0.03, slip.size))
    columns["drawbar_pull_kn"] = pull * load
    if rng.random() < 0.3:
        columns["run_order"] = np.arange(slip.size, dtype=np.float64)
    order = rng.permutation(slip.size) if split else np.arange(slip.size)
    tables = [
        table_from_arrays({c: v[rows] for c, v in columns.items()})
        for rows in (order[:n_lab], order[n_lab:])
    ]
    model = "magic_formula" if rng.random() < 0.75 else "janosi_traction"
    said = {
        "name": name, "curve": curve, "noise": noise, "split": split, "model": model,
        "rows": [n_lab, n_field], "misfit": misfit,
    }  # fmt: skip
    return Case(name, *tables, {"drawbar_pull": model}), said


def run(seed: int, first: int, cases: int, out: Path) -> None:
    """Diagnose nulls and append what was said of each to a file."""
    spec = importlib.util.spec_from_file_location("traction", _TRACTION)
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    known = (
        {json.loads(line)["name"] for line in out.read_text().splitlines()}
        if out.exists()
        else set()
    )
    for i in range(first, first + cases):
        if f"{seed}-{i}" in known:
            continue
        case, said = null_case(np.random.default_rng([seed, i]), f"{seed}-{i}")
        begun = time.process_time()
        try:
            _, ranking, _ = screened_ranking(case, 1, EFFECTS)
        except CalibError:  # too few readings are left of the laboratory
            continue
        p = ranking.probability
        said |= {
            "verdict": verdict(p), "first": ranking.order[0], "none": p["none"],
            "probability": {k: round(v, 4) for k, v in p.items() if v > 0.01},
            "inclusion": {k: round(v, 4) for k, v in inclusion_probability(p).items() if v > 0.01},
            "seconds": round(time.process_time() - begun, 2),
        }  # fmt: skip
        with out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(said) + "\n")


def table(paths: list[Path]) -> str:
    """Say how often nulls are called gaps, by what they are made of, Markdown."""
    found = [json.loads(line) for path in paths for line in path.read_text().splitlines()]
    lines = ["| nulls | cases | verdict not none | 95 % | gap at 0.9 | listed cause at 0.5 | s |",
             "|---|---|---|---|---|---|---|"]  # fmt: skip
    groups = [("all", found)]
    for key in ("curve", "noise", "split", "model"):
        for value in sorted({str(f[key]) for f in found}):
            groups.append((f"{key} {value}", [f for f in found if str(f[key]) == value]))
    for label, group in groups:
        called = Proportion(sum(f["verdict"] != "none" for f in group), len(group))
        sure = sum(f["none"] < 0.1 for f in group)
        listed = sum(
            any(p >= 0.5 for k, p in f["inclusion"].items() if k != UNLISTED) for f in group
        )
        low, high = called.interval
        seconds = np.mean([f["seconds"] for f in group])
        lines.append(
            f"| {label} | {len(group)} | {called.successes} | {low:.3f} to {high:.3f} "
            f"| {sure} | {listed} | {seconds:.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", type=Path, nargs="+")
    given = parser.parse_args()
    if given.table:
        print(table(given.table))
    else:
        run(given.seed, given.first, given.cases, given.out)


if __name__ == "__main__":
    main()
