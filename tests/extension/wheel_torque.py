"""A new output, a model of it, and an effect on it: the torque of a driven wheel.

The torque follows from the thrust of Janosi & Hanamoto (1961), T = r W tan(phi) (1 - exp(-s/s0));
an overloaded gearbox takes a part of it that grows with the load.
"""

import numpy as np

import calib

RADIUS_M = 0.4

calib.register(
    calib.Quantity(
        stem="wheel_torque",
        canonical="wheel_torque_knm",
        kind="torque",
        unit="kN*m",
        role="output",
        description="torque at the hub of a driven wheel",
        suffixes={"knm": "kN*m", "nm": "N*m"},
        shown=("kN m", 1.0),
        physical="torque",
    )
)


def predict(theta, conditions):
    """Return the torque (kN m), shape (k, n)."""
    friction, slip_scale = theta[:, :1], theta[:, 1:2]
    mobilised = 1.0 - np.exp(-conditions["slip_ratio"] / slip_scale)
    return RADIUS_M * conditions["normal_load_kn"] * friction * mobilised


def _example() -> str:
    rng = np.random.default_rng(2)
    slip, load = (
        a.ravel()
        for a in np.meshgrid([0.02, 0.05, 0.1, 0.2, 0.4, 0.6], [3.0, 4.0, 5.0], indexing="ij")
    )
    columns = {"slip_ratio": slip, "normal_load_kn": load}
    torque = predict(np.array([[0.6, 0.08]]), columns)[0]
    torque = torque + 0.02 * rng.standard_normal(torque.size)
    rows = zip(100.0 * slip, load, 1000.0 * torque, strict=True)
    head = "slip_percent,normal_load_kn,wheel_torque_nm\n"
    return head + "".join(f"{s:g},{w:g},{t:.1f}\n" for s, w, t in rows)


calib.register(
    calib.Model(
        name="janosi_torque",
        title="Wheel torque by Janosi and Hanamoto's shear",
        output="wheel_torque_knm",
        conditions=("slip_ratio", "normal_load_kn"),
        parameters=("mu", "s0"),
        predict=predict,
        latex=(r"$T = r W \mu (1 - \exp(-s/s_0))$",),
        letters="[$T] the torque (kN m), [$W] the load (kN), [$s] the slip",
        source="after Janosi & Hanamoto (1961)",
        example=_example(),
        priors="""
model = "janosi_torque"

[parameters.mu]
dist = "lognormal"
median = 0.5
sd_log = 0.4
unit = "1"
reason = "Friction of mineral soils, 20 to 40 degrees"
source = "Wong (2008), Theory of Ground Vehicles"

[parameters.s0]
dist = "lognormal"
median = 0.1
sd_log = 0.8
unit = "1"
reason = "Full thrust is reached within 5 to 30 % slip"
source = "Wong (2008), Theory of Ground Vehicles"

[parameters.sigma]
dist = "lognormal"
median = 0.02
sd_log = 1.0
unit = "kN*m"
reason = "Torque meters scatter by some percent"
source = "Assumed"
""",
    )
)


class GearboxLoss(calib.Effect):
    """An overloaded gearbox takes torque beyond the load of the laboratory: T - c (W/W_lab - 1)."""

    name = "gearbox_loss"
    title = "the gearbox takes more torque, the more load there is"
    parameters = ("loss",)
    outputs = ("torque",)
    covariates = ("load",)
    priors = """
model = "gearbox_loss"

[parameters.loss]
dist = "normal"
mean = 0.0
sd = 0.3
unit = "kN*m"
reason = "Up to a third of the torque of a loaded wheel"
source = "Assumed"
"""

    def on_output(self, phi, output, location, view):
        """Take the loss from the torque."""
        load = view.of("load") / view.lab_of("load", 4.0)
        return location - phi[:, :1] * (load - 1.0)


calib.register(GearboxLoss())
