"""Net traction over load, an exponential of slip: the form of Upadhyaya & Wulfsohn (1993).

    P/W = a [1 - b exp(-c s)]

Of the 1993 paper its summary and list of symbols could be seen, not the printed equation: three
parameters a', b', c' of the net traction and two, a and c, of the torque. The form is that of
three, its coefficients are free, and none published is used. What is sampled are the net traction
coefficient p20 at 20 % slip, at which traction is usually compared, and the motion resistance
coefficient r at no slip:

    P/W = -r + (p20 + r) [1 - exp(-c s)]/[1 - exp(-0.2 c)]
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.models.base import Array, Conditions, Model, References

_SLIP = 0.2


def _range(p20: Array, r: Array, c: Array) -> Array:
    """Return a b, from the net traction coefficient at no slip to that at any."""
    return np.asarray((p20 + r) / -np.expm1(-_SLIP * c))


def _predict(theta: Array, conditions: Conditions) -> Array:
    p20, r, c = (theta[:, j, None] for j in range(3))
    risen = -np.expm1(-c * conditions["slip_ratio"])
    return np.asarray(conditions["normal_load_kn"] * (_range(p20, r, c) * risen - r))


def _report(theta: Array, references: References) -> dict[str, Array]:
    p20, r, c = theta.T
    span = _range(p20, r, c)
    return {"a": span - r, "b": span / (span - r), "c": c}


def _theta(reported: Mapping[str, float], references: References) -> Array:
    a, b, c = (reported[name] for name in "abc")
    return np.array([a * (1.0 - b * np.exp(-_SLIP * c)), a * (b - 1.0), c])


UPADHYAYA = Model(
    name="upadhyaya",
    title="Upadhyaya's form of net traction",
    output="drawbar_pull_kn",
    conditions=("slip_ratio", "normal_load_kn"),
    parameters=("p20", "r", "c"),
    reported={"a": "1", "b": "1", "c": "1"},
    predict=_predict,
    report_theta=_report,
    theta_from_reported=_theta,
    latex=(r"$P/W = a[1 - b \exp(-c s)]$",),
    source="Upadhyaya & Wulfsohn (1993), J. Terramechanics 30(2), 85-100: the form, not its values",
    applies=(
        "One tyre on one soil at loads that change the pull in proportion: the coefficients are "
        "of this tyre, soil and inflation pressure. Pull rises with slip to its limit and does "
        "not fall again. Slips that stay low tell how steeply it rises, and not its limit; none "
        "below 5 % leaves the motion resistance to its prior."
    ),
    letters="[$P] the pull (kN), [$W] the load (kN), [$s] the slip (as a fraction)",
    parametrisation=(
        "The net traction over load p20 at 20 % slip and the motion resistance over load r at no "
        "slip are sampled: the limit a and the rate c are almost collinear where slips are low, "
        "and so are a and b. The published coefficients follow."
    ),
    example="""\
slip_ratio,normal_load_kn,drawbar_pull_kn
0.02,8,0.07299
0.06,8,1.503
0.12,8,2.785
0.2,8,3.641
0.35,8,4.547
0.02,14,0.09137
0.06,14,2.036
0.12,14,4.231
0.2,14,6.003
0.35,14,8.101
0.02,20,0.3038
0.06,20,3.326
0.12,20,6.148
0.2,20,8.54
0.35,20,10.72
""",
)
