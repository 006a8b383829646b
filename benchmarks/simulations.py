"""Add to cases what their calibrated simulators predict, for programs that lack these models.

`python benchmarks/simulations.py CASE …` calibrates each simulator of a case on its laboratory's
rows and writes draws of the posterior, with noise-free predictions at every row of its tables.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import numpy as np

from calib.data import read_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.calibration import calibrate
from calib.inference.problem import build_problem

DRAWS = 40


def simulate(folder: Path, seed: int = 1, draws: int = DRAWS) -> None:
    """Write the predictions of a case's simulators, and name their files in its ``case.toml``.

    Parameters
    ----------
    folder : Path
        Of the case.
    seed : int
        Of the posteriors.
    draws : int
        Evenly spaced draws of each.

    Raises
    ------
    CalibError
        If the case has such files, or a calibration does not converge.
    """
    path = folder / "case.toml"
    said = tomllib.loads(path.read_text(encoding="utf-8"))
    if "simulations" in said:
        raise CalibError("the case has simulations already", where=str(path))
    missing_ok = tuple(OUTPUTS.values())
    tables = {key: read_table(folder / said[key], allow_missing=missing_ok)
              for key in ("calibration", "field", "predict") if key in said}  # fmt: skip
    named = []
    for output, model in said["models"].items():
        lab, own = tables["calibration"], said.get("priors", {}).get(output)
        lab = lab.take(np.isfinite(lab[OUTPUTS[output]]))
        problem = build_problem(model, lab, None if own is None else folder / own)
        found = calibrate(problem, seed, label=output)
        if not found.converged:
            raise CalibError(f"the calibration of {output} did not converge", where=str(folder))
        theta = problem.theta(found.subset(draws))
        names = [entry.name for entry in problem.priors.entries]
        columns = dict(zip(names, theta.T, strict=True))
        for key, table in tables.items():
            conditions = problem.bound.model.select(table.columns)
            mean = problem.bound.mean_response(problem.of_model(theta), conditions)
            predicted = problem.bound.from_response(mean).T
            columns |= {f"{key}_{row}": values for row, values in enumerate(predicted)}
        rows = (
            ",".join(f"{value:.5g}" for value in row) for row in zip(*columns.values(), strict=True)
        )
        name = f"simulated_{output}.csv"
        text = "\n".join([",".join(columns), *rows]) + "\n"
        (folder / name).write_text(text, encoding="utf-8")
        named.append(f'{output} = "{name}"\n')
    with path.open("a", encoding="utf-8") as file:
        file.write(f"\n[simulations]\n{''.join(named)}")


if __name__ == "__main__":
    try:
        for case in sys.argv[1:]:
            simulate(Path(case))
    except CalibError as error:
        print(f"calib: {error}", file=sys.stderr)
        raise SystemExit(2) from None
