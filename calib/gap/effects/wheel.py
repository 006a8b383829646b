"""Effects of soil state and of wheel-soil mechanics that a simulator leaves out.

Stronger soil raises the whole traction curve, steepens it, lowers the motion resistance and makes
the rut shallower. Each of the three effects does this along its own covariate h, which is zero at
the laboratory's value:

    pull'(s) = exp(a_pull h) pull(s exp(a_slope h)) + a_resistance h W
    ln rut' = ln rut + (a_rut + a_rut_slip s) h
"""

from __future__ import annotations

import numpy as np

from calib.gap.effects.base import Conditions, Effect, Known, View, each, saturating, words
from calib.models.base import Array


class _SoilStrength(Effect):
    """Common form; subclasses give the covariate."""

    parameters = ("pull", "slope", "resistance", "rut", "rut_slip")
    form = ("slip", "pressure", "shape")
    outputs = ("pull", "sinkage")

    def covariate(self, view: View) -> Array:
        """Covariate h, zero at the laboratory's value, shape (n,)."""
        raise NotImplementedError

    def on_conditions(self, phi: Array, output: str, given: Conditions, view: View) -> Conditions:
        """Stretch the slip axis of the traction curve."""
        if output != "pull" or "slip" not in given:
            return given
        _, slope, *_ = each(phi)
        stretch = np.exp(np.clip(slope * self.covariate(view), -2.0, 2.0))
        return {**given, "slip": given["slip"] * stretch}

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Scale the pull and shift the resistance; shift the logarithm of the rut."""
        h = self.covariate(view)
        pull, _, resistance, rut, rut_slip = each(phi)
        if output == "pull":
            factor = np.exp(np.clip(pull * h, -2.0, 2.0))
            return np.asarray(mean_response * factor + resistance * h * view.load_kn)
        if output == "sinkage":
            slip = np.maximum(view.slip(), 0.0)
            return np.asarray(mean_response + (rut + rut_slip * slip) * h)
        return mean_response

    def shape(self, view: View) -> Array | None:
        """The covariate."""
        return self.covariate(view)


class MultipassCompaction(_SoilStrength):
    """Earlier passes in the same rut have compacted the soil: h = ln(pass number)."""

    name = "multipass_compaction"
    title, latex, check = words(name)
    covariates = ("passes",)
    known = tuple(Known(output, zero_at=("passes",)) for output in ("pull", "sinkage"))

    def covariate(self, view: View) -> Array:
        """Logarithm of the pass number over the laboratory's."""
        return np.log(view.of("passes") / view.lab_of("passes", 1.0))


class RateEffect(_SoilStrength):
    """Soil strength changes with speed: h = ln(speed/laboratory speed)."""

    name = "rate_effect"
    title, latex, check = words(name)
    covariates = ("speed",)
    known = tuple(Known(output, zero_at=("speed",)) for output in ("pull", "sinkage"))

    def covariate(self, view: View) -> Array:
        """Logarithm of the speed over the laboratory's."""
        speed = view.of("speed")
        lab = max(view.lab_of("speed"), 1e-3)
        return np.log(np.maximum(speed, 1e-3) / lab)


class MoistureSoftening(_SoilStrength):
    """Soil strength changes with water content: h = (w - laboratory w)/0.02."""

    name = "moisture_softening"
    title, latex, check = words(name)
    covariates = ("water",)
    known = tuple(Known(output, zero_at=("water",)) for output in ("pull", "sinkage"))

    def covariate(self, view: View) -> Array:
        """Water content above the laboratory's, in steps of 0.02 g/g."""
        return (view.of("water") - view.lab_of("water")) / 0.02


class BulldozingResistance(Effect):
    """The wheel pushes soil ahead of it: resistance W b (z/30 mm)^c (1 + g s)."""

    name = "bulldozing_resistance"
    title, latex, check = words(name)
    parameters = ("resistance", "sinkage_exponent", "slip_growth")
    form = ("slip", "pressure")
    known = (Known("pull", -1),)
    outputs = ("pull",)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Subtract the resistance from the pull."""
        if output != "pull":
            return mean_response
        resistance, exponent, growth = each(phi)
        slip = np.maximum(view.slip(), 0.0)
        sunk = np.minimum(view.sinkage(), 20.0) ** exponent
        return np.asarray(mean_response - view.load_kn * resistance * sunk * (1.0 + growth * slip))


class LugThrust(Effect):
    """Lugs shear soil beside and between them: thrust W t (1 - exp(-s/s0)); they also dig."""

    name = "lug_thrust"
    title, latex, check = words(name)
    parameters = ("thrust", "slip_scale", "digging")
    form = ("slip", "pressure")
    known = tuple(Known(output, 1, ("slip",), ("slip",)) for output in ("pull", "sinkage"))
    outputs = ("pull", "sinkage")
    needs = ("pull",)  # a rut alone does not tell lugs that dig from slip sinkage
    covariates = ("slip",)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Add the thrust to the pull, the digging to the logarithm of the rut."""
        thrust, slip_scale, digging = each(phi)
        slip = np.maximum(view.slip(), 0.0)
        if output == "pull":
            grown = 1.0 - np.exp(-slip / slip_scale)
            return np.asarray(mean_response + view.load_kn * thrust * grown)
        if output == "sinkage":
            return np.asarray(mean_response + digging * slip)
        return mean_response


class SlipSinkage(Effect):
    """Slip digs the wheel in beyond the model: ln z + a s^c; compacting more soil costs pull."""

    name = "slip_sinkage"
    title, latex, check = words(name)
    parameters = ("growth", "slip_exponent", "pull_loss")
    form = ("slip", "pressure")
    known = (Known("pull", -1, ("slip",)), Known("sinkage", 1, ("slip",), ("slip",)))
    outputs = ("pull", "sinkage")
    needs = ("sinkage",)  # a pull alone does not tell the sinkage that costs it
    covariates = ("slip",)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Deepen the rut; take the extra compaction resistance from the pull."""
        growth, exponent, pull_loss = each(phi)
        deeper = growth * np.maximum(view.slip(), 0.0) ** exponent
        if output == "sinkage":
            return np.asarray(mean_response + deeper)
        if output == "pull":
            extra = view.sinkage() * np.expm1(np.minimum(deeper, 3.0))
            return np.asarray(mean_response - view.load_kn * pull_loss * extra)
        return mean_response


class RutRebound(Effect):
    """Part of the sinkage springs back: ln z - a0 - a g(s), g growing as s^c and levelling off."""

    name = "rut_rebound"
    title, latex, check = words(name)
    parameters = ("towed", "growth", "slip_exponent", "half_way")
    form = ("slip", "pressure")
    known = (Known("sinkage", -1, grows_with=("slip",)),)
    outputs = ("sinkage",)
    covariates = ("slip",)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Make the rut shallower."""
        if output != "sinkage":
            return mean_response
        towed, growth, exponent, half_way = each(phi)
        grown = saturating(np.maximum(view.slip(), 1e-4), exponent, half_way)
        return np.asarray(mean_response - towed - growth * grown)


class PostPeakSoftening(Effect):
    """Shear strength falls past its peak: gross thrust H (1 - a (1 - exp(-(s - sp)/s1))).

    The strength drives the gross thrust, of which the motion resistance leaves the pull (Bekker
    1956; Wong 2008): a wheel that just moves itself has thrust to lose, and pulls less than
    nothing then.
    """

    name = "post_peak_softening"
    title, latex, check = words(name)
    parameters = ("loss", "peak_slip", "slip_scale", "resistance")
    form = ("slip", "pressure")
    known = (Known("pull", -1, ("slip",), at_most="the gross thrust"),)
    outputs = ("pull",)
    covariates = ("slip",)

    def most(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Return the gross thrust."""
        resistance = phi[:, 3:]
        return np.asarray(np.maximum(mean_response + resistance * view.load_kn, 0.0))

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Lower the thrust past the peak."""
        if output != "pull":
            return mean_response
        loss, peak_slip, slip_scale, _ = each(phi)
        beyond = np.maximum(view.slip() - peak_slip, 0.0) / slip_scale
        thrust = self.most(phi, output, mean_response, view)
        return np.asarray(mean_response - thrust * loss * -np.expm1(-beyond))


class LoadTransfer(Effect):
    """Pull times hitch height over wheelbase changes the load: N = W (1 + t pull/W)."""

    name = "load_transfer"
    title, latex, check = words(name)
    parameters = ("transfer", "pull_exponent", "pressure_exponent")
    form = ("slip",)
    outputs = ("pull", "sinkage")
    needs = ("pull",)

    def _ln_load(self, transfer: Array, view: View) -> Array:
        ratio = 1.0 + transfer * view.base["pull"] / view.load_kn
        return np.log(np.clip(ratio, 0.2, 5.0))

    def on_conditions(self, phi: Array, output: str, given: Conditions, view: View) -> Conditions:
        """Raise the ground pressure with the load."""
        if output != "sinkage" or "ground_pressure" not in given:
            return given
        transfer, _, exponent = each(phi)
        factor = np.exp(exponent * self._ln_load(transfer, view))
        pressure = given["ground_pressure"] * factor
        return {**given, "ground_pressure": pressure}

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Scale the pull with the load."""
        if output != "pull":
            return mean_response
        transfer, exponent, _ = each(phi)
        return np.asarray(mean_response * np.exp(exponent * self._ln_load(transfer, view)))
