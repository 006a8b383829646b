"""The calibrated simulators, fitted quickly, to judge whether a drawn case is fair.

A case is fair if the models of its case file describe lab and undisturbed field within noise,
and if a named effect's gap does not vanish by recalibrating them. These are the published
simulators, not the mechanics that make the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from challenge.mechanism import Conditions, Readings
from challenge.tyre import average_ground_pressure

type Array = NDArray[np.float64]
type Predict = Callable[[Array, Conditions], Array]

_CENTRE_KPA, _SPREAD_KPA = 200.0, 80.0
_STEP = 1e-4


def _basis(conditions: Conditions, size: int) -> Array:
    u = (conditions.inflation_kpa - _CENTRE_KPA) / _SPREAD_KPA
    return np.stack([u**power for power in range(size)])


def _magic_formula(size: int) -> Predict:
    """Magic Formula in percent slip; D, slope BCD and E polynomials in pressure."""

    def predict(theta: Array, conditions: Conditions) -> Array:
        basis = _basis(conditions, size)
        peak, slope, bend = (theta[1 + i * size : 1 + (i + 1) * size] @ basis for i in range(3))
        shape = theta[0]
        bx = slope / (shape * np.where(np.abs(peak) < 1e-6, 1e-6, peak)) * 100.0 * conditions.slip
        inner = bx - bend * (bx - np.arctan(bx))
        return np.asarray(peak * np.sin(shape * np.arctan(inner)), dtype=np.float64)

    return predict


def _bekker(theta: Array, conditions: Conditions) -> Array:
    """Rut in mm: ``ln z = (ln p - ln k) / (n0 + n1 s)``, with ``n1`` absent in plain Bekker."""
    pressure = average_ground_pressure(conditions.inflation_kpa, conditions.load_kn)
    exponent = theta[1] + (theta[2] * conditions.slip if theta.size > 2 else 0.0)
    exponent = np.maximum(exponent, 0.2)
    log_rut = np.clip((np.log(pressure) - theta[0]) / exponent, -20.0, 2.0)
    return np.asarray(1e3 * np.exp(log_rut), dtype=np.float64)


def _ayers_perumpral(theta: Array, conditions: Conditions) -> Array:
    """Density from cone index and water content, the constants on their natural scales."""
    wet = np.exp(theta[1]) + (conditions.water_content - theta[2]) ** 2
    log_density = (np.log(conditions.cone_index_kpa) - theta[0] + np.log(wet)) / theta[3]
    return np.asarray(np.exp(np.clip(log_density, -5.0, 5.0)), dtype=np.float64)


def _model(name: str, levels: int) -> Predict:
    if name == "magic_formula_pressure":
        return _magic_formula(min(levels, 3))
    return {
        "magic_formula": _magic_formula(1),
        "modified_bekker": _bekker,
        "bekker": _bekker,
        "ayers_perumpral": _ayers_perumpral,
    }[name]


def _starts(name: str, levels: int, lab: Conditions, reading: Array) -> list[Array]:
    """Return starting points for the least squares of one model."""
    if name.startswith("magic_formula"):
        size = 1 if name == "magic_formula" else min(levels, 3)
        low = (lab.slip > 0.0) & (lab.slip < 0.06)
        slope = float(np.median(reading[low] / (100.0 * lab.slip[low]))) if low.any() else 0.2
        pad = [0.0] * (size - 1)
        peak = float(np.max(reading))
        return [
            np.array([shape, peak, *pad, slope, *pad, bend, *pad])
            for shape, bend in ((1.5, 0.0), (1.3, -1.0))
        ]
    if name == "ayers_perumpral":
        middle = float(np.median(np.log(lab.cone_index_kpa)))
        return [
            np.array([middle - power * np.log(1.6) - 2.5, -3.0, wet, power])
            for power in (8.0, 15.0)
            for wet in (0.15, 0.5)
        ]
    start = [12.0, 1.8] + ([1.0] if name == "modified_bekker" else [])
    return [np.array(start)]


@dataclass(frozen=True)
class Simulator:
    """Calibrated models of a case.

    Attributes
    ----------
    models : dict
        Output to model name.
    theta : dict
        Output to its parameters.
    levels : int
        Number of pressure levels in the lab.
    """

    models: dict[str, str]
    theta: dict[str, Array]
    levels: int

    def predict(self, conditions: Conditions) -> Readings:
        """Return the predictions per output, ``(N,)`` each."""
        return {
            output: _model(name, self.levels)(self.theta[output], conditions)
            for output, name in self.models.items()
        }


def calibrate(
    models: dict[str, str], conditions: Conditions, readings: Readings, sd: Readings
) -> Simulator:
    """Fit every model to readings by weighted least squares.

    Parameters
    ----------
    models : dict
        Output to model name.
    conditions : Conditions
        Conditions of the readings.
    readings, sd : dict
        Readings and their noise sd per output, ``(N,)`` each.
    """
    levels = int(np.unique(conditions.inflation_kpa).size)
    theta = {}
    for output, name in models.items():
        starts = _starts(name, levels, conditions, readings[output])
        theta[output] = _fit(_model(name, levels), starts, conditions, readings[output], sd[output])
    return Simulator(models, theta, levels)


def recalibrate(
    simulator: Simulator, conditions: Conditions, readings: Readings, sd: Readings
) -> Simulator:
    """Fit the same models to other readings, starting from where they are."""
    theta = {}
    for output, name in simulator.models.items():
        start, model = simulator.theta[output], _model(name, simulator.levels)
        theta[output] = _fit(model, [start], conditions, readings[output], sd[output], ridge=start)
    return Simulator(simulator.models, theta, simulator.levels)


def _fit(
    model: Predict,
    starts: list[Array],
    conditions: Conditions,
    reading: Array,
    sd: Array,
    ridge: Array | None = None,
) -> Array:
    def residual(theta: Array) -> Array:
        # An undefined prediction is as bad as a miss of a thousand sd, not an error.
        miss = np.nan_to_num((model(theta, conditions) - reading) / sd, nan=1e3)
        held = [] if ridge is None else [0.03 * (theta - ridge) / (0.3 * np.abs(ridge) + 0.1)]
        return np.concatenate([np.clip(miss, -1e3, 1e3), *held])

    best: tuple[float, Array] | None = None
    for start in starts:
        got = least_squares(residual, start, method="trf", x_scale="jac", max_nfev=80)
        if best is None or got.cost < best[0]:
            best = float(got.cost), np.asarray(got.x, dtype=np.float64)
        if got.cost < 0.005 * reading.size:
            break
    assert best is not None  # starts is never empty
    return best[1]


def misfit(simulator: Simulator, conditions: Conditions, readings: Readings, sd: Readings) -> float:
    """Return the largest rms over outputs of prediction less reading, in noise sd."""
    predicted = simulator.predict(conditions)
    rms = [
        np.sqrt(np.mean(((predicted[name] - readings[name]) / sd[name]) ** 2))
        for name in simulator.models
    ]
    return float(max(rms))


def _directions(name: str, theta: Array) -> list[Array]:
    """Return the parameter changes that count as smooth recalibration, one plausible sd each.

    For the Magic Formula: common factors of C, D, slope and E and a tilt of D and slope with
    pressure; for the others every parameter. The sizes are those between two sandy loams:
    15 % of peak and 25 % of slope, 20-25 % of rut depth, 3-5 % of density.
    """
    eye = np.eye(theta.size)
    if name == "ayers_perumpral":
        return list(eye * np.array([0.3, 0.3, 0.03, 0.1 * abs(theta[3])])[:, None])
    if not name.startswith("magic_formula"):
        scale = np.array([0.4, 0.1 * theta[1], 0.15 * abs(theta[-1]) + 0.1])[: theta.size]
        return list(eye * scale[:, None])
    size = (theta.size - 1) // 3
    blocks = [np.where(_block(i, size, theta.size), theta, 0.0) for i in range(3)]
    blocks[2] = blocks[2] + 0.5 * eye[1 + 2 * size]
    common = [0.05 * theta[0] * eye[0]]
    common += [sd * block for sd, block in zip((0.15, 0.25, 0.3), blocks, strict=True)]
    tilts = [0.05 * theta[1] * eye[2], 0.08 * theta[1 + size] * eye[2 + size]] if size > 1 else []
    return common + tilts


def _block(i: int, size: int, length: int) -> NDArray[np.bool_]:
    index = np.arange(length)
    return (index >= 1 + i * size) & (index < 1 + (i + 1) * size)


def _responses(
    simulator: Simulator, conditions: Conditions, sd: Readings, directions: dict[str, list[Array]]
) -> Array:
    """Return what each change of parameters does to all outputs, in noise sd, ``(K, M)``."""
    rows, outputs = [], list(simulator.models)
    for output in outputs:
        model = _model(simulator.models[output], simulator.levels)
        theta = simulator.theta[output]
        for direction in directions[output]:
            step = _STEP / max(float(np.linalg.norm(direction)), 1e-12)
            up, down = (model(theta + s * step * direction, conditions) for s in (1, -1))
            change = (up - down) / (2.0 * step) / sd[output]
            rows.append([change if name == output else np.zeros_like(change) for name in outputs])
    return np.array([np.concatenate(row) for row in rows])


def recalibration_span(simulator: Simulator, conditions: Conditions, sd: Readings) -> Array:
    """Return what smooth parameter changes of plausible size do to the predictions.

    Returns
    -------
    array
        In noise sd, shape ``(n_directions, n_outputs * N)``, outputs in the order of the case.
    """
    directions = {
        output: _directions(name, simulator.theta[output])
        for output, name in simulator.models.items()
    }
    return _responses(simulator, conditions, sd, directions)


def full_jacobian(simulator: Simulator, conditions: Conditions, sd: Readings) -> Array:
    """Return the predictions' derivatives by every parameter over noise sd.

    Returns
    -------
    array
        Shape ``(n_parameters, n_outputs * N)``.
    """
    directions = {output: list(np.eye(theta.size)) for output, theta in simulator.theta.items()}
    return _responses(simulator, conditions, sd, directions)
