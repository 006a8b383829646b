"""Campaigns simulated with sand.py, each with a known cause.

    python cases.py FOLDER [case]...

The laboratory has 40 cells per metre and steps of 0.1 ms. Each field repeats its settings and
differs in one thing only; noise and places of particles are new.
"""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np

TRUTH = {"friction": 38.0, "E": 1.0e6}
NOISE_LOG = 0.02
COLUMNS = {  # the file's columns, and what sand.py calls them
    "speed_m_s": "speed", "normal_load_n (checked)": "load", "cells_per_m": "cells",
    "time_step_ms": "time_step_ms",
}  # fmt: skip
CASE = """calibration = "lab.csv"
field = "field.csv"

[models]
rut_depth = "mpm_sand"

[covariates]
"""


def sand(rows, folder):
    """Return sinkage (mm) at rows of the file's columns."""
    path = folder / "rows.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(
            [[*TRUTH, *COLUMNS.values()], *([*TRUTH.values(), *row] for row in rows)]
        )
    out = folder / "sinkage.csv"
    command = [sys.executable, str(Path(__file__).parent / "sand.py"), str(path), str(out)]
    subprocess.run(command, check=True, capture_output=True)
    found = np.array(out.read_text().split()[1:], dtype=float)
    path.unlink()
    out.unlink()
    return found


def main(folder, only=()):
    """Write a case for each cause, or for those in `only`."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(55)

    def readings(speeds, loads, cells=40.0, steps=0.1, factor=1.0, simulated=None):
        n = len(speeds)
        rows = np.stack([speeds, loads, np.resize(cells, n), np.resize(steps, n)], axis=1)
        asked = rows if simulated is None else np.c_[rows[:, :2], np.tile(simulated, (n, 1))]
        found = factor * sand(asked, folder) * np.exp(NOISE_LOG * rng.standard_normal(n))
        return rows, found

    speed, load = np.meshgrid([1.0, 1.5, 2.0, 2.5, 3.0], [100.0, 130.0, 160.0, 200.0])
    lab = readings(speed.ravel(), load.ravel())
    n = speed.size
    cells = rng.permutation(np.resize([32.0, 40.0, 48.0, 56.0, 64.0], n))
    steps = rng.permutation(np.resize([0.05, 0.1], n))
    fields = {
        "null": {},
        "gain": {"factor": 1.2},
        "cells": {"cells": cells},
        "cells_null": {"cells": cells, "simulated": (40.0, 0.1)},
        "step": {"steps": steps},
    }
    for name, given in fields.items():
        if only and name not in only:
            continue
        case = folder / name
        case.mkdir(exist_ok=True)
        write(case / "lab.csv", *lab)
        write(case / "field.csv", *readings(speed.ravel(), load.ravel(), **given))
        declared = {"cells": 'cells_per_m = "number"\n', "steps": 'time_step_ms = "number"\n'}
        (case / "case.toml").write_text(CASE + "".join(declared.get(key, "") for key in given))
        print(name, flush=True)


def write(path, rows, sinkage):
    """Write a table."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow([*COLUMNS, "rut_depth_mm"])
        out.writerows([*row, f"{z:.3f}"] for row, z in zip(rows, sinkage, strict=True))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
