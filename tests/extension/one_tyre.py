"""A traction model of one's own: Wismer & Luth (1973), net pull from mobility number and slip.

With the wheel numeric Cn = CI b d / W, pull/W = 0.75 (1 - exp(-0.3 Cn s)) - (1.2/Cn + 0.04). The
coefficients are free here; b and d are those of one tyre.
"""

import numpy as np

import calib

WIDTH_M, DIAMETER_M = 0.30, 1.0


def predict(theta, conditions):
    """Return the pull (kN), shape (k, n)."""
    gross, rate, rolling = (theta[:, i : i + 1] for i in range(3))
    load = conditions["normal_load_kn"]
    numeric = conditions["cone_index_kpa"] * WIDTH_M * DIAMETER_M / load
    thrust = gross * (1.0 - np.exp(-rate * numeric * conditions["slip_ratio"]))
    return load * (thrust - rolling / numeric - 0.04)


def _example() -> str:
    rng = np.random.default_rng(1)
    slip, cone, load = (a.ravel() for a in np.meshgrid([0.05, 0.1, 0.2, 0.4], [400.0, 900.0],
                                                       [4.0, 6.0], indexing="ij"))  # fmt: skip
    columns = {"slip_ratio": slip, "cone_index_kpa": cone, "normal_load_kn": load}
    pull = predict(np.array([[0.75, 0.3, 1.2]]), columns)[0]
    pull = pull + 0.05 * rng.standard_normal(pull.size)
    rows = zip(slip, cone, load, pull, strict=True)
    head = "slip_ratio,cone_index_kpa,normal_load_kn,drawbar_pull_kn\n"
    return head + "".join(f"{s:g},{c:g},{w:g},{p:.3f}\n" for s, c, w, p in rows)


calib.register(
    calib.Model(
        name="one_tyre",
        title="Wismer-Luth traction of one tyre",
        output="drawbar_pull_kn",
        conditions=("slip_ratio", "cone_index_kpa", "normal_load_kn"),
        parameters=("gross", "rate", "rolling"),
        predict=predict,
        latex=(
            r"$P/W = g(1 - \exp(-r C_\mathrm{n} s)) - (m/C_\mathrm{n} + 0.04)$",
            r"$C_\mathrm{n} = \mathrm{CI}\, b\, d/W$",
        ),
        letters="[$P] the pull (kN), [$W] the load (kN), [$s] the slip",
        source="Wismer & Luth (1973), J. Terramechanics 10(2), 49-61",
        example=_example(),
        priors="""
model = "one_tyre"

[parameters.gross]
dist = "lognormal"
median = 0.75
sd_log = 0.3
unit = "1"
reason = "The published coefficient is for tyres on cohesive soils; others differ by a third"
source = "Wismer & Luth (1973)"

[parameters.rate]
dist = "lognormal"
median = 0.3
sd_log = 0.5
unit = "1"
reason = "The published coefficient, within a factor of about 2.7"
source = "Wismer & Luth (1973)"

[parameters.rolling]
dist = "lognormal"
median = 1.2
sd_log = 0.5
unit = "1"
reason = "The published coefficient, within a factor of about 2.7"
source = "Wismer & Luth (1973)"

[parameters.sigma]
dist = "lognormal"
median = 0.01
sd_log = 1.0
relative_to = "normal_load_kn"
default_reference = 5.0
unit = "kN"
reason = "Load cells and uneven ground scatter pulls by some percent of the load"
source = "Assumed"
""",
    )
)
