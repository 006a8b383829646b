"""Write cases of the MuJoCo wheel against itself: a folder each, beside this file or at a path.

    python cases.py [FOLDER]

The laboratory is the rig at a time step of 2 ms. In the field it is the same (`null`), or has a
withheld effect: a step of 20 ms (`coarse`), four steps from 2 to 20 ms (`steps`), both 2 and 20 ms
(`two_steps`), a force gauge with a zero error (`offset`), another friction (`friction`). All have
0.03 kN of noise.
"""

import sys
from pathlib import Path

import numpy as np
from wheel import STEP_MS, pull

TRUE = (0.75, 0.02, 1.0)  # mu, soft (s), damped
NOISE_KN = 0.03
FIELDS = {
    "null": {},
    "coarse": {"steps": (20.0,)},
    "steps": {"steps": (2.0, 5.0, 10.0, 20.0)},
    "two_steps": {"steps": (2.0, 20.0)},
    "offset": {"offset_kn": 0.15},
    "friction": {"theta": (0.6, 0.02, 1.0)},
}
CASE = """calibration = "lab.csv"
field = "field.csv"

[models]
drawbar_pull = "mujoco_wheel"

[covariates]
time_step_ms = "number"
"""


def campaign(rng, rows, theta=TRUE, steps=(STEP_MS,), offset_kn=0.0):
    """Return so many readings of the rig, a row each."""
    slip, load = rng.uniform((0.003, 2.0), (0.045, 6.0), (rows, 2)).T
    step_ms = np.resize(steps, rows)
    kn = pull(theta, {"slip": slip, "load": load}, step_ms) / 1000.0 + offset_kn
    kn = kn + NOISE_KN * rng.standard_normal(rows)
    return np.stack([slip, load, step_ms, kn], axis=1)


def main(folder, seed=1):
    """Write all cases, with one laboratory."""
    rng = np.random.default_rng(seed)
    lab = campaign(rng, 24)
    head = "slip_ratio,normal_load_kn,time_step_ms,drawbar_pull_kn"
    for name, changed in FIELDS.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / name / "case.toml").write_text(CASE)
        for file, table in (("lab.csv", lab), ("field.csv", campaign(rng, 32, **changed))):
            np.savetxt(folder / name / file, table, "%.5f", ",", header=head, comments="")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
