"""Campaigns simulated with the rig, each with a known cause.

    python cases.py FOLDER [path of chrono_wheel]

The laboratory has a soil, a mesh of 20 mm and steps of 4 ms. Each field differs in one thing only;
the noise is new.
"""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np

SOIL = {"Kphi": 9.0e5, "Kc": 0.0, "n": 0.9, "cohesion": 1500.0, "friction": 30.0, "janosi": 0.012}
NOISE_N, NOISE_LOG = 15.0, 0.02
COLUMNS = {  # the file's columns, and what the rig calls them
    "slip_ratio": "slip", "normal_load_n": "load", "speed_m_s": "speed", "mesh_mm": "mesh_mm",
    "time_step_ms": "time_step_ms", "active_domain": "domain", "ray_casting": "bullet",
}  # fmt: skip
CASE = """calibration = "lab.csv"
field = "field.csv"

[models]
drawbar_pull = "chrono_scm_drawbar_pull"
rut_depth = "chrono_scm_rut_depth"

[covariates]
"""
KINDS = {
    "mesh_mm": "number",
    "time_step_ms": "number",
    "active_domain": "number",
    "ray_casting": "category",
}
RAYS = {"exact": 0, "bullet": 1}


def rig(rows, program, folder):
    """Return pull (N) and sinkage (m) at rows of the file's columns."""
    names = [*SOIL, *COLUMNS.values()]
    with (folder / "rows.csv").open("w", newline="") as file:
        csv.writer(file).writerows(
            [
                names,
                *([*SOIL.values(), *(RAYS.get(row[c], row[c]) for c in COLUMNS)] for row in rows),
            ]
        )
    command = [program, str(folder / "rows.csv"), "travel=0.3"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = np.array([line.split(",") for line in said.split()[1:]], dtype=float)
    (folder / "rows.csv").unlink()
    return found[:, 0], found[:, 2]


def at(slips, loads, **others):
    """Return rows at slips and loads, with the laboratory's speed and settings, or others."""
    usual = {"speed_m_s": 0.2, "mesh_mm": 20.0, "time_step_ms": 4.0, "active_domain": 1.0}
    columns = {
        "slip_ratio": slips,
        "normal_load_n": loads,
        **usual,
        "ray_casting": "exact",
        **others,
    }
    lists = [np.broadcast_to(v, np.shape(slips)).tolist() for v in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def main(folder, program, only=()):
    """Write a case for each cause, or for those in `only`."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(55)
    slip, load = np.meshgrid([0.05, 0.1, 0.15, 0.25, 0.4, 0.55], [500.0, 900.0, 1500.0])
    lab = at(slip.ravel(), load.ravel())
    lab_readings = noisy(rng.standard_normal((2, len(lab))), *rig(lab, program, folder))
    n = 24
    slips, loads = rng.uniform(0.04, 0.55, n).round(3), rng.uniform(500, 1500, n).round(0)
    meshes = rng.permutation(np.resize([20, 25, 100 / 3, 40, 50, 200 / 3], n)).round(4)
    steps = rng.permutation(np.resize([1.0, 2.0, 4.0, 8.0], n))
    domains = rng.permutation(np.resize([0.4, 0.5, 0.7, 1.0], n))
    rays = rng.permutation(np.resize(["exact", "bullet"], n))
    speeds = rng.permutation(np.geomspace(0.1, 1.0, n)).round(3)
    fields = {  # what is recorded, what is simulated, what is added to the pull
        "null": ({}, {}, 0.0),
        "offset": ({}, {}, 60.0),
        "radius": ({}, {"slip_ratio": 1 - (1 - slips) * 0.95}, 0.0),
        "speed": ({"speed_m_s": speeds}, {}, 0.0),
        "mesh": ({"mesh_mm": meshes}, {}, 0.0),
        "mesh_null": ({"mesh_mm": meshes}, {"mesh_mm": 20.0}, 0.0),
        "step": ({"time_step_ms": steps}, {}, 0.0),
        "domain": ({"active_domain": domains}, {}, 0.0),
        "rays": ({"ray_casting": rays}, {}, 0.0),
        "coarse": ({"mesh_mm": 50.0}, {}, 0.0),
        "mesh_both": ({"mesh_mm": np.resize([10, 12.5, 20, 25, 40, 50], n)}, {}, 0.0),
    }
    for name, (recorded, simulated, added) in fields.items():
        errors = rng.standard_normal((2, n))
        if only and name not in only:
            continue
        rows = at(slips, loads, **recorded)
        given = {"slip_ratio": slips, **recorded, **simulated}
        pull, sinkage = rig(at(given.pop("slip_ratio"), loads, **given), program, folder)
        case = folder / name
        case.mkdir(exist_ok=True)
        write(case / "lab.csv", lab, *lab_readings)
        write(case / "field.csv", rows, *noisy(errors, pull + added, sinkage))
        declared = [f'{c} = "{KINDS[c]}"\n' for c in recorded if c in KINDS]
        (case / "case.toml").write_text(CASE + "".join(declared))
        print(name, flush=True)


def noisy(errors, pull, sinkage):
    """Return readings."""
    return pull + NOISE_N * errors[0], sinkage * np.exp(NOISE_LOG * errors[1])


def write(path, rows, pull, sinkage):
    """Write a table."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow([*rows[0], "drawbar_pull_n", "rut_depth_mm"])
        for row, p, z in zip(rows, pull, sinkage, strict=True):
            out.writerow([*row.values(), f"{p:.2f}", f"{1000 * z:.3f}"])


if __name__ == "__main__":
    beside = Path(__file__).parent / "chrono_wheel"
    main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else str(beside))
