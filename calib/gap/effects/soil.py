"""Effects of soil state: its strength depends on a covariate the simulator does not see.

Stronger soil raises the whole traction curve, steepens it, lowers the motion resistance and makes
the rut shallower. Each of the three effects does this along its own covariate h, which is zero at
the laboratory's value:

    pull'(s) = exp(a_pull h) pull(s exp(a_slope h)) + a_resistance h W
    ln rut' = ln rut + (a_rut + a_rut_slip s) h
"""

from __future__ import annotations

import numpy as np

from calib.gap.effects.base import Effect, Known, View, each
from calib.models.base import Array

__all__ = ["MoistureSoftening", "MultipassCompaction", "RateEffect"]

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

    def on_output(self, phi: Array, output: str, location: Array, view: View) -> Array:
        """Scale the pull and shift the resistance; shift the logarithm of the rut."""
        h = self.covariate(view)
        pull, _, resistance, rut, rut_slip = each(phi)
        if output == "pull":
            factor = np.exp(np.clip(pull * h, -2.0, 2.0))
            return np.asarray(location * factor + resistance * h * view.load_kn)
        if output == "sinkage":
            slip = np.maximum(view.slip(), 0.0)
            return np.asarray(location + (rut + rut_slip * slip) * h)
        return location

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
