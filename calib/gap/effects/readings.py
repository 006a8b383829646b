"""What a case's own instruments may do: the reading of an output, and of a condition, is wrong.

A reading y of any output

    drifts or jumps over the runs, as the drawbar cell's does (`<output>_drift`, `<output>_step`);
    is off by a factor, y' = (1 + gain) y (`<output>_gain`);
    is off by a constant, y' = y + offset (`<output>_offset`).

Where logarithms are compared, a drift and a jump are factors; gain and offset are as stated, and a
reading is never below a twentieth of what it should be. The drawbar cell's own drift, step and
offset are `sensor_drift`, `sensor_step` and `force_offset`.

A condition c that truly held differs from its record, c' = (1 + gain) c + offset
(`<condition>_bias`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from calib.gap.effects.base import Conditions, Effect, View
from calib.gap.effects.instruments import ForceOffset, SensorDrift, SensorStep
from calib.models.base import Array

type Kind = Literal["drift", "step", "gain", "offset"]


class _Gain(ForceOffset):
    parameters = ("gain",)
    latex = (r"$P_\mathrm{f} = (1 + \text{gain})\, P$ for the pull $P$",)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        return np.asarray(mean_response * (1.0 + phi))


# Of each kind how a drawbar cell does it, what happens, and the sd of its size over a typical one.
_KINDS: Mapping[Kind, tuple[Effect, str, float]] = {
    "drift": (SensorDrift(), "drifts with run order", 0.25),
    "step": (SensorStep(), "jumps at some run, as when a gauge is replaced or slips", 0.25),
    "gain": (_Gain(), "is off by a factor", 0.05),
    "offset": (ForceOffset(), "is off by a constant", 0.1),
}
_SHAPES = {
    "curvature": 'dist = "lognormal"\nmedian = 1.0\nsd_log = 1.0',
    "half_way": 'dist = "lognormal"\nmedian = 0.5\nsd_log = 1.2',
    "zero_at": 'dist = "uniform"\nlower = 0.0\nupper = 1.0',
    "change_point": 'dist = "uniform"\nlower = 0.1\nupper = 0.9',
    "duration": 'dist = "lognormal"\nmedian = 0.02\nsd_log = 0.7',
}


class Reading(Effect):
    """An output's reading is wrong.

    Parameters
    ----------
    kind : {"drift", "step", "gain", "offset"}
    role, output : str
        Physical role of the output, and its name.
    unit : str
        Of its readings.
    typical : float
        Of its readings, in their unit.
    log : bool
        Whether their logarithms are compared.
    """

    instrument = seldom = True

    def __init__(
        self, kind: Kind, role: str, output: str, unit: str, typical: float, *, log: bool = False
    ) -> None:
        self._as, happens, sd = _KINDS[kind]
        self._log, self._over_runs = log, bool(self._as.covariates)
        word = output.replace("_", " ")
        self.name, self.outputs = f"{output}_{kind}", (role,)
        self.device = self._as.device if role == "pull" else f"{word} gauge"
        self.title, self.check = f"the {word} reading {happens}", self._as.check
        self.parameters, self.covariates = self._as.parameters, self._as.covariates
        self.form = self._as.form
        symbol = r"\ln y" if log and self._over_runs else "y"
        self.latex = tuple(
            line.replace(r"P_\mathrm{f}", rf"{symbol}_\mathrm{{f}}")
            .replace("the pull $P$", f"the {word} $y$")
            .replace("P", symbol)
            for line in self._as.latex
        )
        if kind == "gain" or (log and self._over_runs):
            typical, unit = 1.0, "1"
        size, *shapes = self.parameters
        self.priors = _priors(self.name, {size: (sd, typical, unit)}, shapes)

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Change the reading."""
        if output not in self.outputs:
            return mean_response
        if not self._log or self._over_runs:
            return self._as.on_output(phi, "pull", mean_response, view)
        true = np.exp(mean_response)
        return np.log(np.maximum(self._as.on_output(phi, "pull", true, view), 0.05 * true))

    def shape(self, view: View) -> Array | None:
        """Run order, of a drift."""
        return self._as.shape(view)


class ConditionBias(Effect):
    """A condition that truly held differs from its record by a gain and an offset.

    Parameters
    ----------
    role, stem : str
        Physical role of the condition, and its name without the unit.
    outputs : tuple of str
        Physical roles of the outputs whose simulators take it.
    unit : str
        Of the condition.
    typical : float
        Of its values in the laboratory.
    """

    instrument = seldom = True
    parameters = ("gain", "offset")

    def __init__(
        self, role: str, stem: str, outputs: tuple[str, ...], unit: str, typical: float
    ) -> None:
        word = stem.replace("_", " ")
        self.name, self.outputs, self.covariates = f"{stem}_bias", outputs, (role,)
        self.title = f"the true {word} differs from the recorded one"
        self.check = "against another instrument; above zero there is more than it reads"
        self.latex = (
            rf"$c_\mathrm{{f}} = (1 + \text{{gain}})\, c + \text{{offset}}$ for the {word} $c$",
        )
        sizes = {"gain": (0.05, 1.0, "1"), "offset": (0.05, typical, unit)}
        self.priors = _priors(self.name, sizes)

    def on_conditions(self, phi: Array, output: str, given: Conditions, view: View) -> Conditions:
        """Correct the condition; what is positive stays so."""
        (role,) = self.covariates
        if role not in given:
            return given
        recorded = given[role]
        true = recorded * (1.0 + phi[:, :1]) + phi[:, 1:]
        return {**given, role: np.where(recorded > 0.0, np.maximum(true, 0.02 * recorded), true)}


def _priors(
    name: str, sizes: Mapping[str, tuple[float, float, str]], shapes: Sequence[str] = ()
) -> str:
    """Write the priors of errors, by their relative sd, a typical value and unit, and of shapes."""
    entries = [
        (
            p,
            f'dist = "normal"\nmean = 0.0\nsd = {sd * typical!r}',
            unit,
            f"Error of the reading: {100.0 * sd:g} % of a typical one (sd)",
            "This project: no published value was found; wide enough to be noticed",
        )
        for p, (sd, typical, unit) in sizes.items()
    ]
    source = "Those of the priors sensor_drift and sensor_step"
    entries += [(p, _SHAPES[p], "1", "As of the drawbar reading", source) for p in shapes]
    return f'model = "{name}"\n' + "".join(
        f'\n[parameters.{p}]\n{prior}\nunit = "{unit}"\nreason = "{reason}"\nsource = "{source}"\n'
        for p, prior, unit, reason, source in entries
    )
