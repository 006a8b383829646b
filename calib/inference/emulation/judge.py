"""How good an emulator is: on runs that it had not seen, by its own account, between the nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

from calib.inference.emulation.settings import Emulation, EmulationSettings, HeldOut
from calib.inference.emulation.state import State
from calib.models.base import Array

_NINETY = 1.645
_LEAST_COVERED = 0.7
# The error a further run is worth making for, as a part of what the gate allows.
WORTH = 0.3


def held_out(state: State, theta: Array, values: Array) -> HeldOut | None:
    """Compare the emulator with runs that it has not seen; None where none has a value."""
    emulator = state.emulator
    if emulator is None:
        return None
    means, variances = emulator.with_variance(theta)
    ok = np.isfinite(values).all(axis=1) & np.isfinite(means).all(axis=1)
    if not ok.any():
        return None
    true = (values[ok] - emulator.mean) @ emulator.curves.T
    off = true - means[ok]
    # What the basis cannot hold is an error as well.
    rest = values[ok] - emulator.mean - true @ emulator.curves
    rows = emulator.curves_at(state.problem.conditions)[:, 1:]
    total = np.square(off @ rows.T).sum(axis=1) + np.square(rest).mean(axis=1) * len(rows)
    # A run of a simulator with noise of its own has that besides, no error of the emulator: in each
    # of the coefficients, as the curves are orthonormal, and in what these do not hold.
    own = state.own_noise**2
    left = 1.0 - len(emulator.curves) / emulator.mean.size
    squared = max(float(total.mean()) - own * (np.square(rows).sum() + left * len(rows)), 0.0)
    z = off / np.sqrt(np.maximum(variances[ok] + own, 1e-300))
    return HeldOut(
        int(ok.sum()), float(np.sqrt(squared / len(rows))) / state.sigma, z, ndtr(z).ravel(),
        float((np.abs(z) < _NINETY).mean()),
    )  # fmt: skip


def judged(
    state: State, z: Array, chosen: EmulationSettings, measured: HeldOut | None,
    own_noise: float, history: Sequence[tuple[int, float]],
) -> Emulation:  # fmt: skip
    """Put together what became of an emulation, and whether it is good enough."""
    if state.emulator is None:
        raise AssertionError
    expected = state.error(z)
    over = state.emulator.over
    left_out = over.left_out(np.concatenate([state.emulator.mean[None], state.emulator.curves]))
    # At the ends of the box a node that is left out has none beyond it.
    left_out = left_out[:, ((over.nodes > 0.0) & (over.nodes < 1.0)).all(axis=1)]
    theta = state.axes.natural(z[state.holds(z)][:64])
    c = np.concatenate([np.ones((len(theta), 1)), state.emulator.coefficients(theta)], axis=1)
    squares = np.square(c @ left_out)
    between = float(np.sqrt(np.nanmean(squares))) / state.sigma if squares.size else 0.0
    reasons = []
    off = measured.rmse if measured is not None else expected
    if off > chosen.tolerance:
        reasons.append(
            f"the emulator is off by {off:.2f} noise sds (rms), where {chosen.tolerance:g} are "
            "allowed: give it more runs, or tighter priors"
        )
    if (
        measured is not None
        and measured.covered < _LEAST_COVERED
        and off > WORTH * chosen.tolerance
    ):
        reasons.append(
            f"its 90 % intervals hold {100 * measured.covered:.0f} % of the runs it had not seen"
        )
    return Emulation(
        state.emulated, state.emulator, tuple(state.runs), measured, expected, between, own_noise,
        not reasons, tuple(reasons), tuple(history), bool(state.earlier),
    )  # fmt: skip
