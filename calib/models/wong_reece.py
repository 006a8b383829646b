"""Drawbar pull, torque and sinkage of a driven rigid wheel: Wong & Reece (1967), part I.

The stresses and their integration are in `calib.models.rigid_wheel`. The three models share their
soil: eight parameters, of which pull, torque or sinkage alone determine but a few. What is known
of the soil is best fixed in a prior file. A braked wheel (slip below zero) has no value.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from calib.models.base import Array, Columns, Model, References, Rows
from calib.models.rigid_wheel import contact, wheels

__all__ = ["WONG_REECE_PULL", "WONG_REECE_SINKAGE", "WONG_REECE_TORQUE"]

_MM_PER_M = 1000.0


def _pull(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    return contact(wheels(columns, rows)).pull


def _torque(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    return contact(wheels(columns, rows)).torque


def _ln_sinkage(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    return np.log(_MM_PER_M * contact(wheels(columns, rows)).sinkage)


_LETTERS = (
    "[$W] the load (kN), [$s] the slip, [$b] and [$r] width and radius of the wheel (m), [$theta] "
    "the angle from the vertical, [$theta_1] where the wheel enters and [$theta_m] where the "
    "normal stress [$sigma_n] (kPa) is largest (below, it falls in proportion to zero), [$tau] "
    "the shear stress (kPa), [$j] the slip displacement (mm)"
)
_STRESS = (
    r"$\sigma_\mathrm{n} = (k_1 + k_2 b)(r/b)^n (\cos\theta - \cos\theta_1)^n$",
    r"$\tau = (c + \sigma_\mathrm{n} \tan\phi)[1 - \exp(-j/K)]$",
    r"$\theta_\mathrm{m} = (c_1 + c_2 s)\theta_1$",
    r"$W = r b \int (\sigma_\mathrm{n} \cos\theta + \tau \sin\theta) d\theta$",
)

_model = partial(
    Model,
    conditions=("slip_ratio", "normal_load_kn", "tyre_width_m", "tyre_diameter_m"),
    parameters=("k1", "k2", "n", "c", "phi", "K", "c1", "c2"),
    reported={
        "k1": "kPa", "k2": "kPa/m", "n": "1", "c": "kPa", "phi": "degree", "K": "mm", "c1": "1",
        "c2": "1",
    },
    source="Wong & Reece (1967), J. Terramechanics 4(1), 81-98, doi:10.1016/0022-4898(67)90105-X",
    joined=("k1", "k2", "tyre_width_m"),
    slow=True,
    applies=(
        "Driven rigid wheels, or tyres so hard that they do not flatten, on one homogeneous soil, "
        "at slips of zero or more and loads that the soil can carry. Eight parameters of which "
        "one output determines but a few: the others are the prior's. A minute for a dozen rows."
    ),
)  # fmt: skip

WONG_REECE_PULL = _model(
    name="wong_reece_pull",
    title="Wong-Reece rigid wheel: drawbar pull",
    output="drawbar_pull_kn",
    location=_pull,
    response="identity",
    latex=(r"$P = r b \int (\tau \cos\theta - \sigma_\mathrm{n} \sin\theta) d\theta$", *_STRESS),
    letters="[$P] the pull (kN), " + _LETTERS,
    example="""\
slip_ratio,normal_load_kn,tyre_width_m,tyre_diameter_m,drawbar_pull_kn
0.05,2,0.2,0.8,0.07713
0.12,2,0.2,0.8,0.2987
0.2,2,0.2,0.8,0.3535
0.35,2,0.2,0.8,0.4524
0.5,2,0.2,0.8,0.4773
0.05,4,0.3,1,0.3569
0.12,4,0.3,1,0.7811
0.2,4,0.3,1,0.9191
0.35,4,0.3,1,1.011
0.5,4,0.3,1,1.116
0.05,6,0.3,1.2,0.9344
0.12,6,0.3,1.2,1.062
0.2,6,0.3,1.2,1.446
0.35,6,0.3,1.2,1.487
0.5,6,0.3,1.2,1.585
""",
)

WONG_REECE_TORQUE = _model(
    name="wong_reece_torque",
    title="Wong-Reece rigid wheel: torque",
    output="driving_torque_knm",
    location=_torque,
    response="identity",
    latex=(r"$T = r^2 b \int \tau d\theta$", *_STRESS),
    letters="[$T] the torque (kN m), " + _LETTERS,
    example="""\
slip_ratio,normal_load_kn,tyre_width_m,tyre_diameter_m,driving_torque_knm
0.05,2,0.2,0.8,0.2416
0.12,2,0.2,0.8,0.3144
0.2,2,0.2,0.8,0.3552
0.35,2,0.2,0.8,0.3896
0.5,2,0.2,0.8,0.3966
0.05,4,0.3,1,0.6503
0.12,4,0.3,1,0.795
0.2,4,0.3,1,0.8841
0.35,4,0.3,1,1.01
0.5,4,0.3,1,1.002
0.05,6,0.3,1.2,1.379
0.12,6,0.3,1.2,1.625
0.2,6,0.3,1.2,1.632
0.35,6,0.3,1.2,1.855
0.5,6,0.3,1.2,1.818
""",
)

WONG_REECE_SINKAGE = _model(
    name="wong_reece_sinkage",
    title="Wong-Reece rigid wheel: sinkage",
    output="rut_depth_mm",
    location=_ln_sinkage,
    response="log",
    latex=(r"$z = r(1 - \cos\theta_1)$", *_STRESS),
    letters="[$z] the sinkage (m), " + _LETTERS,
    example="""\
slip_ratio,normal_load_kn,tyre_width_m,tyre_diameter_m,rut_depth_mm
0.05,2,0.2,0.8,50.75
0.12,2,0.2,0.8,50.94
0.2,2,0.2,0.8,43.72
0.35,2,0.2,0.8,51.84
0.5,2,0.2,0.8,53.88
0.05,4,0.3,1,60.41
0.12,4,0.3,1,51.03
0.2,4,0.3,1,60.12
0.35,4,0.3,1,53.54
0.5,4,0.3,1,59.33
0.05,6,0.3,1.2,66.07
0.12,6,0.3,1.2,79.62
0.2,6,0.3,1.2,75.05
0.35,6,0.3,1.2,90.03
0.5,6,0.3,1.2,81.4
""",
)
