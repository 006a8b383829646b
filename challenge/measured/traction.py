"""A simulator of three parameters, for series of five or six readings.

A model of one's own, as `calib --models FILE` takes it: the traction of a wheel at one load,

    P = W [mu (1 - exp(-s/k)) - r]

after Janosi & Hanamoto (1961), the shear displacement being proportional to the slip, less a
constant motion resistance.
"""

from __future__ import annotations

import numpy as np

from calib.data.registry import register
from calib.models.base import Array, Conditions, Model


def predict(theta: Array, conditions: Conditions) -> Array:
    """Return the pull (kN), shape (k, n)."""
    friction, scale, resistance = (theta[:, j, None] for j in range(3))
    gross = friction * -np.expm1(-np.maximum(conditions["slip_ratio"], 0.0) / scale)
    return np.asarray(conditions["normal_load_kn"] * (gross - resistance))


_PRIORS = """
model = "janosi_traction"

[parameters.friction]
dist = "lognormal"
median = 0.4
sd_log = 0.5
unit = "1"
reason = "Gross traction over load on sand and loam: 0.2 to 0.9"
source = "Wong (2008), Theory of Ground Vehicles; Brixius (1987)"

[parameters.scale]
dist = "lognormal"
median = 0.1
sd_log = 0.8
unit = "1"
reason = "Shear modulus over contact length: 10-30 mm over 50-500 mm"
source = "Wong (2008)"

[parameters.resistance]
dist = "lognormal"
median = 0.1
sd_log = 0.7
unit = "1"
reason = "Motion resistance over load: 0.04 on firm to 0.3 on loose soil"
source = "Wismer & Luth (1973)"

[parameters.sigma]
dist = "lognormal"
median = 0.02
sd_log = 1.0
relative_to = "normal_load_kn"
default_reference = 5.0
unit = "kN"
reason = "Scatter of a pull reading, a few hundredths of the load"
source = "Repeats of rigid wheels in sand (SOURCES.md, cmu-wheel)"
"""

MODEL = Model(
    name="janosi_traction",
    title="Janosi-Hanamoto traction at one load",
    output="drawbar_pull_kn",
    conditions=("slip_ratio", "normal_load_kn"),
    parameters=("friction", "scale", "resistance"),
    predict=predict,
    latex=(r"$P = W[\mu(1 - \exp(-s/k)) - r]$",),
    letters="[$P] the pull (kN), [$W] the load (kN), [$s] the slip",
    source="Janosi & Hanamoto (1961)",
    example=(
        "slip_ratio,normal_load_kn,drawbar_pull_kn\n0.0,5,-0.52\n0.05,5,0.27\n0.1,5,0.75\n"
        "0.2,5,1.24\n0.4,5,1.45\n0.6,5,1.51\n"
    ),
    priors=_PRIORS,
)

register(MODEL)
