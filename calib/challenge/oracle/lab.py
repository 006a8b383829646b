"""What the lab leaves open about the soil, and what that does to the field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from calib.challenge.density import ConeLaw, draw_cone_law
from calib.challenge.mechanics import Reality, simulate, zero_pull_slip
from calib.challenge.mechanism import CONDITION_NAMES, Conditions, Readings
from calib.challenge.oracle.site import stacked
from calib.challenge.soil import Soil, draw_soil
from calib.challenge.stage import Stage

type Array = NDArray[np.float64]

_DRAWS = 400
_STEP = 0.05  # in prior sds
_NOTHING = 1e-9
_FROM_NOTHING = ("slip_dig",)  # uniform from 0: its logarithm would have no floor


@dataclass(frozen=True)
class View:
    """The field as seen by one who knows the soil up to a normal uncertainty.

    Attributes
    ----------
    residual : array
        Readings less their expectation without mechanism, whitened, shape ``(M,)``.
    whitener : array
        Shape ``(M, M)``; gaps in noise sd as rows are whitened by ``gaps @ whitener``.
    """

    residual: Array
    whitener: Array

    def seen(self, gaps: Array) -> Array:
        """Return gaps whitened, shapes ``(..., M)``."""
        return np.asarray(gaps @ self.whitener, dtype=np.float64)


def known_soil(residual: Array) -> View:
    """Return the view of one who knows the soil itself.

    Parameters
    ----------
    residual : array
        Field readings less those without mechanism, in noise sd, shape ``(M,)``.
    """
    return View(residual, np.eye(residual.size))


def after_lab(stage: Stage, lab_readings: Readings, residual: Array) -> View:
    """Return the view of one who knows the soil's law, and its numbers from prior and lab only.

    The readings are linearised about the true soil; the prior of the numbers is the generator's,
    as a normal distribution of their logarithms. Lab data then leave a normal uncertainty, which
    shifts and blurs what is expected in the field.

    Parameters
    ----------
    stage : Stage
        Design and true soil.
    lab_readings : dict
        The noisy readings of the lab, ``(N,)`` each.
    residual : array
        Field readings less those without mechanism, in noise sd, shape ``(M,)``.
    """
    offset, directions = _prior(stage.reality)
    lab, field = _responses(stage, directions)
    outputs = stage.design.outputs
    parts = [(lab_readings[n] - stage.lab_readings[n]) / stage.lab_sd[n] for n in outputs]
    precision = np.eye(offset.size) + lab @ lab.T
    covariance = np.linalg.inv(precision)
    found = covariance @ (offset + lab @ np.concatenate(parts))
    spread = np.eye(residual.size) + field.T @ covariance @ field
    whitener = np.linalg.inv(np.linalg.cholesky(spread)).T
    return View((residual - found @ field) @ whitener, whitener)


def _prior(reality: Reality) -> tuple[Array, list[Reality]]:
    """Return the prior mean less the truth in prior sds, ``(K,)``, and the truth moved by steps.

    The ``2K`` realities are the truth moved up and down along each principal axis of the prior.
    """
    rng = np.random.default_rng(0)
    soil, cone = reality.soil, reality.cone
    sinking, laws = bool(soil.slip_flow), (soil.pressure_law, soil.slip_law)
    offsets, moved = [], []
    soils: list[Soil] = []
    while len(soils) < _DRAWS:
        drawn = draw_soil(rng, slip_sinkage=sinking)
        soils += [drawn] if (drawn.pressure_law, drawn.slip_law) == laws else []
    offset, steps = _axes(soil, soils)
    offsets.append(offset)
    moved += [replace(reality, soil=replace(soil, **step)) for step in steps]  # type: ignore[arg-type]
    offset, steps = _axes(cone, [draw_cone_law(rng) for _ in range(_DRAWS)])
    offsets.append(offset)
    moved += [replace(reality, cone=replace(cone, **step)) for step in steps]
    return np.concatenate(offsets), moved


def _axes(
    true: Soil | ConeLaw, drawn: Sequence[Soil | ConeLaw]
) -> tuple[Array, list[dict[str, float]]]:
    """Return offset and steps of one law's numbers, on logarithms except from nothing up."""
    names = [f.name for f in fields(true) if isinstance(getattr(true, f.name), float)]
    log = np.array([name not in _FROM_NOTHING for name in names])

    def coordinates(one: Soil | ConeLaw) -> Array:
        values = np.array([getattr(one, name) for name in names])
        return np.where(log, np.log(np.maximum(values, _NOTHING)), values)

    here, cloud = coordinates(true), np.array([coordinates(one) for one in drawn])
    variances, axes = np.linalg.eigh(np.cov(cloud.T))
    keep = variances > _NOTHING
    sds, axes = np.sqrt(variances[keep]), axes[:, keep]
    offset = (cloud.mean(axis=0) - here) @ axes / sds
    steps = []
    for step in (sds * axes).T:
        for sign in (1.0, -1.0):
            new = here + sign * _STEP * step
            new = np.where(log, np.exp(new), new)
            steps.append(dict(zip(names, map(float, new), strict=True)))
    return np.asarray(offset, dtype=np.float64), steps


def _responses(stage: Stage, moved: Sequence[Reality]) -> tuple[Array, Array]:
    """Return what one prior sd along each axis does to lab and field, in noise sd, ``(K, M)``."""
    both = {
        name: np.concatenate([getattr(stage.lab, name), getattr(stage.field, name)])
        for name in CONDITION_NAMES
    }
    pressures, back = np.unique(both["inflation_kpa"], return_inverse=True)
    levels, n, k = pressures.size, back.size, len(moved)
    zero = zero_pull_slip(_together(moved, levels), np.tile(pressures, k))
    tiled = Conditions(**{name: np.tile(values, k) for name, values in both.items()})
    zeros = zero.reshape(k, levels)[:, back].ravel()
    got = simulate(_together(moved, n), tiled, zeros)
    lab, field = [], []
    for name in stage.design.outputs:
        rows = got[name].reshape(k // 2, 2, n)
        change = (rows[:, 0] - rows[:, 1]) / (2.0 * _STEP)
        lab.append(change[:, : stage.lab.size] / stage.lab_sd[name])
        field.append(change[:, stage.lab.size :] / stage.field_sd[name])
    return np.hstack(lab), np.hstack(field)


def _together(realities: Sequence[Reality], n: int) -> Reality:
    """Return realities one below the other, ``n`` rows each."""
    soil = stacked([reality.soil for reality in realities], n)
    cone = stacked([reality.cone for reality in realities], n)
    return replace(realities[0], soil=soil, cone=cone)
