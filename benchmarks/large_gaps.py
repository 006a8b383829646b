"""Whether a listed cause is found in a large gap that is not quite of its formula's shape.

    python benchmarks/large_gaps.py --cases cases --key answers     # of `calib challenge make`

Designs are those of challenge cases in which no listed effect acts. On each, a listed effect of 12
or 20 noise sds (rms) is drawn from its prior, and its trace multiplied by a smooth random factor
over all recorded conditions, whose rms departure from one is `DEPARTURE`. Printed is the
probability that the cause acts, whatever acts besides, and its share of the gap.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import Case, read_case
from calib.gap.diagnose import diagnose
from calib.gap.hypotheses import split_testable
from calib.gap.noise import noise_conditions
from calib.gap.ranking import Lab, calibrate_lab
from calib.gap.well_specified import Draw, draw_from_hypothesis
from challenge.seal import open_answers

DEPARTURE = 0.15
SIZES = (20.0, 12.0)


def departure(data: Campaigns, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a smooth random function of all conditions that vary, shape (n,), of a given rms."""
    total = np.zeros(len(data.case.field))
    for name, values in data.view.conditions.items():
        if name not in OUTPUTS.values() and np.ptp(values) > 0.0:
            u = (values - values.min()) / np.ptp(values)
            waves, phase = rng.integers(1, 4), rng.uniform(0.0, 2.0 * np.pi)
            total += rng.normal() * np.cos(np.pi * waves * u + phase)
    return DEPARTURE * total / np.sqrt(np.mean(total**2))


def large_effect(
    data: Campaigns, lab: Lab, rng: np.random.Generator, seed: int
) -> tuple[str, float, Draw] | None:
    """Draw a testable effect of a large size; None if none has such a size on this design."""
    able, _ = split_testable(data)
    for name in rng.permutation(sorted(able)):
        for size in SIZES:
            try:
                drawn = np.random.default_rng(seed)
                return str(name), size, draw_from_hypothesis(data, *lab, str(name), size, drawn)
            except CalibError:
                continue
    return None


def deformed(case: Case, data: Campaigns, lab: Lab, draw: Draw, rng: np.random.Generator) -> Case:
    """Return the case with new readings, an effect that departs from its formula in the field."""
    tables = {"lab": dict(case.lab.columns), "field": dict(case.field.columns)}
    forward, psi = draw.forward, draw.psi
    plain, full, at_lab = (
        forward.simulator(psi, data.view), forward.field(psi, data.view), forward.lab(psi)
    )  # fmt: skip
    factor = 1.0 + departure(data, rng)
    for o in data.outputs:
        column, back, noise = OUTPUTS[o.name], o.problem.bound.from_response, lab[1][o.name]
        location = plain[o.name][0] + (full[o.name] - plain[o.name])[0] * factor
        sd = noise.sd(noise_conditions(data.view))
        tables["field"][column] = back(location + sd * rng.standard_normal(location.size))
        measured = np.isfinite(case.lab[column])
        sd = noise.sd(data.lab_at[o.name])
        values = np.array(case.lab[column])
        values[measured] = back(at_lab[o.name][0] + sd * rng.standard_normal(measured.sum()))
        tables["lab"][column] = values
    new = {name: table_from_arrays(columns) for name, columns in tables.items()}
    return replace(case, lab=new["lab"], field=new["field"], new_conditions=None)


def main() -> None:
    """Print a line for each design, and how often the cause was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--key", type=Path, required=True)
    parser.add_argument("--designs", type=int, default=24)
    chosen = parser.parse_args()
    key = open_answers(chosen.cases, chosen.key)
    names = [n for n in sorted(key) if key[n].truth in ("none", "unknown")][: chosen.designs]
    found = []
    for i, name in enumerate(names):
        rng = np.random.default_rng([77, i])
        case = read_case(chosen.cases / name)
        data = campaigns(case)
        lab = calibrate_lab(data, 1)
        drawn = large_effect(data, lab, rng, i)
        if drawn is None:
            continue
        cause, size, draw = drawn
        diagnosis = diagnose(deformed(case, data, lab, draw, rng), 1)
        included = diagnosis.inclusion.causes.get(cause)
        if included is None:
            print(f"{name}  {cause}: it changes nothing there that this design could show")
            continue
        found.append(included.probability)
        low, high = included.share_interval
        print(
            f"{name}  {cause} of {size:g} sds: acts {included.probability:.3f}, share "
            f"{included.share:.2f} ({low:.2f} to {high:.2f}); {diagnosis.verdict}",
            flush=True,
        )
    print(f"found (0.5 or more): {sum(p >= 0.5 for p in found)} of {len(found)}")


if __name__ == "__main__":
    main()
