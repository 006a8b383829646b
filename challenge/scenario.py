"""A scenario: a design of campaigns, and a soil that the case's models describe within noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from challenge.campaign import field_conditions, lab_conditions
from challenge.density import draw_cone_law
from challenge.design import Design, Needs, Tier, draw_design
from challenge.mechanics import Reality, self_propelled_slip, simulate
from challenge.mechanism import DENSITY, DRAWBAR, RUT, Conditions, Readings
from challenge.soil import draw_soil
from challenge.surrogate import Simulator, calibrate, misfit
from challenge.tyre import Tyre

type Array = NDArray[np.float64]

LACK_OF_FIT = 0.35
_SOILS = 12
_PULL_KN, _RUT_MM = (0.35, 2.3), (6.0, 115.0)
_DENSITY_RANGE = (1.25, 2.1)


@dataclass(frozen=True)
class Scenario:
    """A design with an undisturbed reality on it, fair to the models of the case.

    Attributes
    ----------
    design : Design
        The design.
    reality : Reality
        The lab's.
    lab, field, test : Conditions
        Recorded conditions.
    field_zero, test_zero : array
        Slip of the self-propelled point at the conditions, ``(N,)``.
    lab_readings, field_without, test_without : dict
        Noise-free readings without any mechanism.
    lab_sd, field_sd : dict
        Noise sd per output, ``(N,)``.
    simulator : Simulator
        The models as calibrated on the noise-free lab.
    """

    design: Design
    reality: Reality
    lab: Conditions
    field: Conditions
    test: Conditions
    field_zero: Array
    test_zero: Array
    lab_readings: Readings
    field_without: Readings
    test_without: Readings
    lab_sd: Readings
    field_sd: Readings
    simulator: Simulator

    def in_field(self, reality: Reality) -> Readings:
        """Return noise-free field readings of a reality, the measured outputs only."""
        got = simulate(reality, self.field, self.field_zero)
        return {name: got[name] for name in self.design.outputs}

    def on_test(self, reality: Reality) -> Readings:
        """Return noise-free readings of a reality on the test conditions."""
        got = simulate(reality, self.test, self.test_zero)
        return {name: got[name] for name in self.design.outputs}

    def gap(self, readings: Readings, without: Readings | None = None) -> Array:
        """Return field readings less those without the mechanism, in noise sd, flattened."""
        base = self.field_without if without is None else without
        parts = [(readings[n] - base[n]) / self.field_sd[n] for n in self.design.outputs]
        return np.concatenate(parts)


def rms(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _plausible(readings: Readings, design: Design) -> bool:
    """Whether the readings look like those of a tyre on sandy loam."""
    ranges = {DRAWBAR: _PULL_KN, RUT: _RUT_MM, DENSITY: _DENSITY_RANGE}
    inside = True
    for output in design.outputs:
        low, high = ranges[output]
        reading = readings[output]
        # Pulls begin at nothing, so only their peak has to be worth measuring.
        smallest = reading.max() if output == DRAWBAR else reading.min()
        inside = inside and bool(low < smallest and reading.max() < high)
    return inside


def _describe(
    design: Design, lab: Conditions, readings: Readings, sd: Readings
) -> Simulator | None:
    """Calibrate the case's models on the noise-free lab; None where one does not fit.

    The quick ones go first, since a soil that one model cannot describe is thrown away.
    """
    theta, levels = {}, 0
    for output in sorted(design.models, key=(DENSITY, RUT, DRAWBAR).index):
        one = calibrate({output: design.models[output]}, lab, readings, sd)
        if not misfit(one, lab, readings, sd) < LACK_OF_FIT:
            return None
        theta[output], levels = one.theta[output], one.levels
    return Simulator(design.models, theta, levels)


def _measured(
    reality: Reality, design: Design, part: Conditions, zero: Array
) -> tuple[Readings, Readings] | None:
    """Return noise-free readings and noise sds of the design's outputs; None if implausible."""
    got = simulate(reality, part, zero)
    if not _plausible(got, design):
        return None
    readings = {name: got[name] for name in design.outputs}
    sd = {name: design.noise.sd(name, value, part.slip) for name, value in readings.items()}
    return readings, sd


def _try_scenario(
    rng: np.random.Generator, design: Design, parts: list[Conditions]
) -> Scenario | None:
    """Draw a soil for a design; None if the case's models cannot describe it within noise."""
    sinkage = design.models.get(RUT) != "bekker"
    reality = Reality(draw_soil(rng, slip_sinkage=sinkage), Tyre(), draw_cone_law(rng))
    together = np.concatenate([part.inflation_kpa for part in parts])
    ends = np.cumsum([part.size for part in parts])[:-1]
    zeros = np.split(self_propelled_slip(reality, together), ends)
    lab = _measured(reality, design, parts[0], zeros[0])
    simulator = None if lab is None else _describe(design, parts[0], *lab)
    if lab is None or simulator is None:
        return None
    later = [_measured(reality, design, parts[i], zeros[i]) for i in (1, 2)]
    field, test = later
    if field is None or test is None:
        return None
    worst = max(misfit(simulator, parts[1], *field), misfit(simulator, parts[2], *test))
    if not worst < LACK_OF_FIT:
        return None
    return Scenario(
        design=design,
        reality=reality,
        lab=parts[0],
        field=parts[1],
        test=parts[2],
        field_zero=zeros[1],
        test_zero=zeros[2],
        lab_readings=lab[0],
        field_without=field[0],
        test_without=test[0],
        lab_sd=lab[1],
        field_sd=field[1],
        simulator=simulator,
    )


def draw_scenario(rng: np.random.Generator, tier: Tier, needs: Needs) -> Scenario | None:
    """Draw a design and a soil that the design's models describe; None if a few soils fail."""
    design = draw_design(rng, tier, needs)
    parts = [
        lab_conditions(rng, design),
        field_conditions(rng, design, design.field_rows),
        field_conditions(rng, design, design.test_rows),
    ]
    recorded = {name for name in needs.varies if parts[1].varies(name)}
    if recorded != set(needs.varies):
        return None
    for _ in range(_SOILS):
        scenario = _try_scenario(rng, design, parts)
        if scenario is not None:
            return scenario
    return None
