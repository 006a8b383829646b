"""A covariate that the simulator ignores: the pull grows with the normal load, and less than it."""

import numpy as np

import calib


class LoadSensitivity(calib.Effect):
    """Pull times (W/W_lab)^c."""

    name = "load_sensitivity"
    title = "the pull depends on the normal load, which the simulator ignores"
    parameters = ("exponent",)
    outputs = ("pull",)
    covariates = ("load",)
    form = ("slip",)
    priors = """
model = "load_sensitivity"

[parameters.exponent]
dist = "normal"
mean = 0.0
sd = 1.0
unit = "1"
reason = "Friction makes the pull proportional to the load, cohesion leaves it as it is"
source = "Wong (2008), Theory of Ground Vehicles"
"""

    def on_output(self, phi, output, location, view):
        """Scale the pull."""
        load = view.of("load")
        lab = view.lab_of("load", float(np.median(load)))
        return location * np.exp(phi[:, :1] * np.log(load / lab))


calib.register(LoadSensitivity())
