"""Effects of soil state and of wheel-soil mechanics that a simulator leaves out.

Stronger soil raises the whole traction curve, steepens it, lowers the motion resistance and makes
the rut shallower. Each of the three effects does this along its own covariate h, which is zero at
the laboratory's value:

    pull'(s) = exp(a_pull h) pull(s exp(a_slope h)) + a_resistance h W
    ln rut' = ln rut + (a_rut + a_rut_slip s) h
"""

from __future__ import annotations

import numpy as np

from calib.gap.effects.base import Effect, Known, View, each, saturating
from calib.models.base import Array

_STRENGTH = (
    r"$P_\mathrm{f}(s) = e^{\text{pull} \cdot h}\, P(s\, e^{\text{slope} \cdot h}) + "
    r"\text{resistance} \cdot h\, W$ for the pull $P$ at the slip $s$, $W$ being the normal load",
    (
        r"$\ln z_\mathrm{f} = \ln z + (\text{rut} + \text{rut slip} \cdot s)\, h$ for the rut "
        r"depth $z$"
    ),
)


class _SoilStrength(Effect):
    """Common form; subclasses give the covariate."""

    parameters = ("pull", "slope", "resistance", "rut", "rut_slip")
    form = ("slip", "pressure", "shape")
    outputs = ("pull", "sinkage")

    def covariate(self, view: View) -> Array:
        """Covariate h, zero at the laboratory's value, shape (n,)."""
        raise NotImplementedError

    def on_conditions(
        self, phi: Array, output: str, conditions: dict[str, Array], view: View
    ) -> dict[str, Array]:
        """Stretch the slip axis of the traction curve."""
        if output != "pull" or "slip" not in conditions:
            return conditions
        _, slope, *_ = each(phi)
        stretch = np.exp(np.clip(slope * self.covariate(view), -2.0, 2.0))
        return {**conditions, "slip": conditions["slip"] * stretch}

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
    title = "earlier passes in the same rut have compacted the soil"
    latex = (
        *_STRENGTH,
        r"$h = \ln(N/N_\mathrm{lab})$, $N$ being the pass number",
    )
    covariates = ("passes",)
    known = tuple(Known(output, zero_at=("passes",)) for output in ("pull", "sinkage"))

    def covariate(self, view: View) -> Array:
        """Logarithm of the pass number over the laboratory's."""
        return np.log(view.of("passes") / view.lab_of("passes", 1.0))


class RateEffect(_SoilStrength):
    """Soil strength changes with speed: h = ln(speed/laboratory speed)."""

    name = "rate_effect"
    title = "soil strength changes with speed"
    latex = (
        *_STRENGTH,
        r"$h = \ln(v/v_\mathrm{lab})$, $v$ being the speed",
    )
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
    title = "soil strength changes with water content"
    latex = (
        *_STRENGTH,
        r"$h = (w - w_\mathrm{lab})/0.02$, $w$ being the gravimetric water content",
    )
    covariates = ("water",)
    known = tuple(Known(output, zero_at=("water",)) for output in ("pull", "sinkage"))

    def covariate(self, view: View) -> Array:
        """Water content above the laboratory's, in steps of 0.02 g/g."""
        return (view.of("water") - view.lab_of("water")) / 0.02


class BulldozingResistance(Effect):
    """The wheel pushes soil ahead of it: resistance W b (z/30 mm)^c (1 + g s)."""

    name = "bulldozing_resistance"
    title = "the wheel pushes soil ahead of it, more as it sinks and slips"
    latex = (
        (
            r"$P_\mathrm{f} = P - W \cdot \text{resistance} \cdot Z^{\text{sinkage exponent}}\, "
            r"(1 + \text{slip growth} \cdot s)$ for the pull $P$"
        ),
        (
            r"$Z$ is the simulator's sinkage over 30 mm where the case models it, else $1 + s$; "
            r"$W$ the normal load, $s$ the slip"
        ),
    )
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
    title = "tread lugs or grousers add thrust as slip grows"
    latex = (
        (
            r"$P_\mathrm{f} = P + W \cdot \text{thrust} \cdot (1 - e^{-s/\text{slip scale}})$ for "
            r"the pull $P$"
        ),
        (
            r"$\ln z_\mathrm{f} = \ln z + \text{digging} \cdot s$ for the rut depth $z$; $W$ is "
            r"the normal load, $s$ the slip"
        ),
    )
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
    title = "sinkage grows with slip beyond what the model has"
    latex = (
        (
            r"$\ln z_\mathrm{f} = \ln z + d$, $d = \text{growth} \cdot s^{\text{slip exponent}}$ "
            r"for the rut depth $z$"
        ),
        (
            r"$P_\mathrm{f} = P - W \cdot \text{pull loss} \cdot Z (e^d - 1)$ for the pull $P$; "
            r"$Z$ is the simulator's sinkage over 30 mm, $W$ the normal load, $s$ the slip"
        ),
    )
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
    title = "part of the sinkage springs back, more at high slip"
    latex = (
        (
            r"$\ln z_\mathrm{f} = \ln z - \text{towed} - \text{growth} \cdot g(s)$ for the rut "
            r"depth $z$"
        ),
        (
            r"$g(s) = (1 + h^c)\, s^c / (s^c + h^c)$, $s$ being the slip, $c$ the slip exponent "
            r"and $h$ half way"
        ),
    )
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
    title = "shear strength falls past its peak"
    latex = (
        (
            r"$P_\mathrm{f} = P - H \cdot \text{loss} \cdot (1 - e^{-(s - \text{peak "
            r"slip})/\text{slip scale}})$ for the pull $P$ where the slip $s$ is larger than the "
            r"peak slip"
        ),
        (
            r"$H = P + \text{resistance} \cdot W$ is the gross thrust where it is above zero, $W$ "
            r"the normal load"
        ),
    )
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
    title = "drawbar pull changes the normal load"
    latex = (
        r"$N = W + \text{transfer} \cdot P$, between a fifth of $W$ and five times it",
        r"$P_\mathrm{f} = P\, (N/W)^{\text{pull exponent}}$ for the pull $P$",
        (
            r"$q_\mathrm{f} = q\, (N/W)^{\text{pressure exponent}}$ for the ground pressure $q$; "
            r"$W$ is the normal load"
        ),
    )
    parameters = ("transfer", "pull_exponent", "pressure_exponent")
    form = ("slip",)
    outputs = ("pull", "sinkage")
    needs = ("pull",)

    def _ln_load(self, transfer: Array, view: View) -> Array:
        ratio = 1.0 + transfer * view.base["pull"] / view.load_kn
        return np.log(np.clip(ratio, 0.2, 5.0))

    def on_conditions(
        self, phi: Array, output: str, conditions: dict[str, Array], view: View
    ) -> dict[str, Array]:
        """Raise the ground pressure with the load."""
        if output != "sinkage" or "ground_pressure" not in conditions:
            return conditions
        transfer, _, exponent = each(phi)
        factor = np.exp(exponent * self._ln_load(transfer, view))
        pressure = conditions["ground_pressure"] * factor
        return {**conditions, "ground_pressure": pressure}

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Scale the pull with the load."""
        if output != "pull":
            return mean_response
        transfer, exponent, _ = each(phi)
        return np.asarray(mean_response * np.exp(exponent * self._ln_load(transfer, view)))
