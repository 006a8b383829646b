"""The conditions of lab, field and test runs that a design calls for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from challenge.design import Design
from challenge.mechanism import Conditions
from challenge.tyre import PSI_KPA, REFERENCE_LOAD_KN

type Array = NDArray[np.float64]

_LAB_SPEED, _LAB_WATER, _NO_CONE = 0.06, 0.05, 500.0
_FIELD_SLIPS = (0.02, 0.05, 0.08, 0.12, 0.16, 0.2, 0.28, 0.36, 0.45, 0.55, 0.65)
_SPEEDS = (0.06, 0.3, 1.0, 2.0)
_CONE_RANGE, _WATER_RANGE = (200.0, 1800.0), (0.03, 0.085)


def _inflation(design: Design, inflation: Array) -> Array:
    """Round as the file will show it, so that the recorded value is the value."""
    if design.psi:
        return np.round(inflation / PSI_KPA, 3) * PSI_KPA
    return np.round(inflation, 3)


def _load(rng: np.random.Generator, design: Design, n: int) -> Array:
    """Draw loads; a load that nobody recorded is the constant one."""
    span = design.load_span if "load_kn" in design.columns else 0.0
    return np.round(REFERENCE_LOAD_KN * (1.0 + span * rng.uniform(-1.0, 1.0, n)), 4)


def _cone(rng: np.random.Generator, design: Design, n: int) -> Array:
    if "cone_index_kpa" not in design.columns:
        return np.full(n, _NO_CONE)
    low, high = np.log(_CONE_RANGE)
    return np.round(np.exp(rng.uniform(low, high, n)), 1)


def lab_conditions(rng: np.random.Generator, design: Design) -> Conditions:
    """Return the lab's conditions: every slip at every pressure, run in random order.

    A campaign for density alone draws cone index and water content instead.
    """
    slips, pressures = np.array(design.lab_slips), np.array(design.inflation_kpa)
    wheel = "slip" in design.columns
    n = pressures.size * slips.size if wheel else design.lab_rows
    wobble = design.wobble * rng.uniform(-1.0, 1.0, (2, n))
    water = _LAB_WATER * (1.0 + wobble[0])
    if "cone_index_kpa" in design.columns:
        water = rng.uniform(*_WATER_RANGE, n)
    return Conditions(
        run_order=rng.permutation(n).astype(np.float64),
        slip=np.tile(slips, pressures.size) if wheel else np.zeros(n),
        inflation_kpa=_inflation(
            design, np.repeat(pressures, slips.size) if wheel else np.full(n, 200.0)
        ),
        load_kn=_load(rng, design, n),
        speed_m_s=np.round(_LAB_SPEED * (1.0 + wobble[1]), 4),
        pass_number=np.ones(n),
        water_content=np.round(water, 4),
        cone_index_kpa=_cone(rng, design, n),
    )


def _moving_with(rng: np.random.Generator, design: Design, name: str, latent: Array) -> Array:
    """Return uniforms with the design's correlation to the slip's latent, shape ``(N,)``."""
    rho = design.coupling.get(name, 0.0)
    mixed = rho * latent + np.sqrt(1.0 - rho**2) * rng.standard_normal(latent.size)
    return np.asarray(special.ndtr(mixed), dtype=np.float64)


def _levels(uniform: Array, values: tuple[float, ...]) -> Array:
    index = np.minimum((uniform * len(values)).astype(int), len(values) - 1)
    return np.asarray(np.array(values)[index], dtype=np.float64)


def _field_slip(rng: np.random.Generator, design: Design, uniform: Array) -> Array:
    if design.levels:
        slip = _levels(uniform, _FIELD_SLIPS) + rng.uniform(0.0, 0.01, uniform.size)
    else:
        slip = 0.01 + 0.67 * uniform**1.4
    return np.round(np.minimum(slip, max(design.lab_slips)), 5)


def field_conditions(rng: np.random.Generator, design: Design, rows: int) -> Conditions:
    """Return conditions of a field campaign; what does not vary is as in the lab.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    design : Design
        The design.
    rows : int
        Number of runs.
    """
    latent = rng.standard_normal(rows)
    uniforms = {
        name: _moving_with(rng, design, name, latent)
        for name in ("inflation_kpa", "speed_m_s", "pass_number", "water_content", "run_order")
    }
    varies = set(design.varying)
    low, high = np.log(_SPEEDS[0]), np.log(_SPEEDS[-1])
    speed = np.exp(low + (high - low) * uniforms["speed_m_s"])
    if design.levels:
        speed = _levels(uniforms["speed_m_s"], _SPEEDS)
    water = _WATER_RANGE[0] + np.ptp(_WATER_RANGE) * uniforms["water_content"]
    passes = _levels(uniforms["pass_number"], (1.0, 2.0, 3.0, 4.0))
    order = np.argsort(np.argsort(uniforms["run_order"])).astype(np.float64)
    slip = _field_slip(rng, design, np.asarray(special.ndtr(latent)))
    conditions = Conditions(
        run_order=order,
        slip=slip if "slip" in varies else np.zeros(rows),
        inflation_kpa=_inflation(design, _pressures(design, uniforms["inflation_kpa"])),
        load_kn=_load(rng, design, rows),
        speed_m_s=np.round(speed if "speed_m_s" in varies else np.full(rows, _LAB_SPEED), 4),
        pass_number=passes if "pass_number" in varies else np.ones(rows),
        water_content=np.round(
            water if "water_content" in varies else np.full(rows, _LAB_WATER), 4
        ),
        cone_index_kpa=_cone(rng, design, rows),
    )
    return _in_run_order(conditions)


def _pressures(design: Design, uniform: Array) -> Array:
    if "slip" not in design.columns:
        return np.full(uniform.shape, 200.0)
    return _levels(uniform, design.inflation_kpa)


def _in_run_order(conditions: Conditions) -> Conditions:
    """Sort the rows as they were run, which is how field sheets are filled in."""
    index = np.argsort(conditions.run_order, kind="stable")
    return Conditions(**{name: value[index] for name, value in vars(conditions).items()})
