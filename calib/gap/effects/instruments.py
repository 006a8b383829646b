"""Effects of instruments: the reading is wrong, the soil is not."""

from __future__ import annotations

import numpy as np

from calib.gap.effects.base import Conditions, Effect, View, each, saturating, words
from calib.models.base import Array

EARLY = "zero and span, and an early run once more"
"""How a reading that changes over the runs is checked."""


class _Fault(Effect):
    instrument = True


class SlipZeroShift(_Fault):
    """A rolling radius wrong by a factor: 1 - s_true = (1 - s_recorded)(1 - error)."""

    name = "slip_zero_shift"
    title, latex, check = words(name)
    form = ("pressure",)  # a tyre rolls on a smaller radius at less inflation
    parameters = ("radius_error",)
    outputs = ("pull", "sinkage")
    covariates = ("slip",)
    varies = False

    def on_conditions(self, phi: Array, output: str, given: Conditions, view: View) -> Conditions:
        """Shift the slip."""
        if "slip" not in given:
            return given
        return {**given, "slip": 1.0 - (1.0 - given["slip"]) * (1.0 - phi)}


class ForceOffset(_Fault):
    """A constant error of the drawbar reading."""

    name = "force_offset"
    title, latex, check = words(name)
    device = "load cell"
    parameters = ("offset",)
    outputs = ("pull",)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Add the offset (kN)."""
        return mean_response + phi if output == "pull" else mean_response


def _progress(view: View) -> Array:
    """Part of the campaign that is over at each run, by run order, shape (n,)."""
    first, last = view.order_range
    return np.clip((view.of("order") - first) / max(last - first, 1.0), 0.0, 1.2)


def _grown(curvature: Array, half_way: Array, view: View) -> Array:
    """Part of a drift that is there at each run, shape (k, n)."""
    return saturating(np.maximum(_progress(view), 1e-3), curvature, half_way)


class SensorDrift(_Fault):
    """A drift with run order: steady, settling, or from some run on; zeroed at any part of it."""

    name = "sensor_drift"
    title, latex, check = words(name)
    device = "load cell"
    parameters = ("drift", "curvature", "half_way", "zero_at")
    form = ("shape",)
    outputs = ("pull",)
    covariates = ("order",)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Add the drift (from the first run to the last)."""
        if output not in self.outputs:
            return mean_response
        drift, curvature, half_way, zero_at = each(phi)
        grown = _grown(curvature, half_way, view)
        return np.asarray(mean_response + drift * (grown - zero_at))

    def shape(self, view: View) -> Array | None:
        """Run order."""
        return _progress(view)


class SensorStep(_Fault):
    """A jump of the drawbar reading at some run; zeroed before it, after it or in between.

    It takes at least one run, so that a fit can move the change point from one to the next.
    """

    name = "sensor_step"
    title, latex, check = words(name)
    device = "load cell"
    parameters = ("jump", "zero_at", "change_point", "duration")
    outputs = ("pull",)
    covariates = ("order",)

    def _beyond(self, phi: Array, view: View) -> Array:
        """How far each run is beyond the change point, 0 to 1, shape (k, n)."""
        first, last = view.order_range
        _, _, change_point, duration = each(phi)
        lasts = duration + 1.0 / max(last - first, 1.0)
        return np.asarray(np.clip((_progress(view) - change_point) / lasts + 0.5, 0.0, 1.0))

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Add the jump, and the error before it."""
        if output not in self.outputs:
            return mean_response
        jump, zero_at, *_ = each(phi)
        return np.asarray(mean_response + jump * (self._beyond(phi, view) - zero_at))


class PressureGaugeBias(_Fault):
    """True inflation pressure differs from the gauge's by a gain and an offset.

    Slip was zeroed at the recorded pressure. At another one the tyre rolls on another radius, and
    against another resistance: 1 - s_true = (1 - s_recorded)(1 - r ln(p_true/p_recorded)).
    """

    name = "pressure_gauge_bias"
    title, latex, check = words(name)
    form = ("extrapolation",)  # the simulator is used at pressures it was not fitted at
    parameters = ("gain", "offset", "ground_response", "rolling_radius")
    outputs = ("pull", "sinkage")
    covariates = ("pressure",)
    varies = False

    def on_conditions(self, phi: Array, output: str, given: Conditions, view: View) -> Conditions:
        """Correct the inflation pressure, and the ground pressure and slip that go with it."""
        gain, offset, ground_response, rolling_radius = each(phi)
        recorded = view.of("pressure")
        true = np.maximum(recorded * np.exp(gain) + offset, 0.2 * recorded)
        changed = dict(given)
        if "pressure" in given:
            changed["pressure"] = true
        if "ground_pressure" in given:
            ratio = (true / recorded) ** (view.ground_exponent * ground_response)
            changed["ground_pressure"] = given["ground_pressure"] * ratio
        if "slip" in given:
            larger = rolling_radius * np.log(true / recorded)
            changed["slip"] = 1.0 - (1.0 - given["slip"]) * (1.0 - larger)
        return changed


class ConeIndexBias(_Fault):
    """A cone penetrometer that reads wrong by a gain and an offset."""

    name = "cone_index_bias"
    title, latex, check = words(name)
    parameters = ("gain", "offset")
    form = ("size", "cone", "water")
    outputs = ("density",)
    covariates = ("cone",)
    varies = False

    def on_conditions(self, phi: Array, output: str, given: Conditions, view: View) -> Conditions:
        """Correct the cone index."""
        if "cone" not in given:
            return given
        gain, offset = each(phi)
        recorded = given["cone"]
        typical = view.lab_of("cone")
        true = recorded * np.exp(gain) + offset * typical
        return {**given, "cone": np.maximum(true, 0.02 * recorded)}


class WaterContentBias(_Fault):
    """A moisture probe that reads wrong by a gain and an offset."""

    name = "water_content_bias"
    title, latex, check = words(name)
    parameters = ("gain", "offset")
    form = ("size", "cone", "water")
    outputs = ("density",)

    def on_conditions(self, phi: Array, output: str, given: Conditions, view: View) -> Conditions:
        """Correct the water content."""
        gain, offset = each(phi)
        changed = dict(given)
        for name in ("water", "water_by_volume"):
            if name in given:
                true = given[name] * np.exp(gain) + offset
                changed[name] = np.maximum(true, 0.0)
        return changed
