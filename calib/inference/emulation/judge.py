"""How good an emulator is: on runs that it had not seen, by its own account, between the nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import ndtr

from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES
from calib.inference.emulation.settings import Emulation, EmulationSettings, HeldOut
from calib.inference.emulation.state import NEGLIGIBLE, State
from calib.models.base import Array

_NINETY = 1.645
_LEAST_COVERED = 0.7
# The expected error at which the emulator is put to the check, as a part of what the gate allows.
WORTH = 0.8
# Fewer runs of a table where the posterior is do not tell how good the emulator is there.
_LEAST_THERE = 5
# From so many runs on the course of the error is taken to tell how many will be needed.
FORESEEN_FROM = 100
# The data say little of a parameter whose posterior sd is at least this part of the prior's.
_LITTLE = 0.7
_SCATTERS = "its output scatters: write deterministic = false in the simulator file"


def held_out(state: State, theta: Array, values: Array) -> HeldOut | None:
    """Compare the emulator with runs that it has not seen; None where none has a value."""
    emulator = state.emulator
    if emulator is None:
        return None
    means, variances = emulator.with_variance(theta)
    ok = np.isfinite(values).all(axis=1) & np.isfinite(means).all(axis=1)
    true = (values[ok] - emulator.mean) @ emulator.curves.T
    # What the basis cannot hold is an error as well.
    rest = values[ok] - emulator.mean - true @ emulator.curves
    return _compared(state, true - means[ok], rest, variances[ok]) if ok.any() else None


def left_out(state: State) -> HeldOut | None:
    """Compare each run where the posterior is with what the others say; None of a few."""
    emulator, region = state.emulator, state.region
    if emulator is None or region is None:
        return None
    training = emulator.training
    there = region.inside(state.axes.of(training.theta[training.ok]))
    if there.sum() < _LEAST_THERE:
        return None
    off, unknown = emulator.functions.left_out()
    rest = training.values[training.ok] - emulator.mean
    rest -= (rest @ emulator.curves.T) @ emulator.curves
    variances = unknown[:, None] * emulator.variances
    return _compared(state, off[there], rest[there], variances[there])


def _compared(state: State, off: Array, rest: Array, variances: Array) -> HeldOut:
    """Judge errors of the coefficients (k, j), and of what the basis cannot hold, (k, m)."""
    if state.emulator is None:
        raise AssertionError
    rows = state.emulator.curves_at(state.problem.conditions)[:, 1:]
    errors = off @ rows.T
    total = np.square(errors).sum(axis=1) + np.square(rest).mean(axis=1) * len(rows)
    # A run of a simulator with noise of its own has that besides, no error of the emulator: in each
    # of the coefficients, as the curves are orthonormal, and in what these do not hold.
    own = state.own_noise**2
    left = 1.0 - rows.shape[1] / rest.shape[1]
    squared = max(float(total.mean()) - own * (np.square(rows).sum() + left * len(rows)), 0.0)
    z = off / np.sqrt(np.maximum(variances + own, 1e-300))
    return HeldOut(
        len(off), float(np.sqrt(squared / len(rows))) / state.sigma, z, ndtr(z).ravel(),
        float((np.abs(z) < _NINETY).mean()), errors,
    )  # fmt: skip


def judged(
    state: State, z: Array, chosen: EmulationSettings, measured: HeldOut | None,
    own_noise: float, history: Sequence[tuple[int, float]],
) -> Emulation:  # fmt: skip
    """Put together what became of an emulation, and whether it is good enough."""
    if state.emulator is None:
        raise AssertionError
    expected, between = state.error(z), _between(state, z)
    wider, shifted = _consequences(state, z, measured)
    reasons = []
    off = measured.rmse if measured is not None else expected
    if off > chosen.tolerance:
        more = "give it more runs, or tighter priors"
        if own_noise and state.keeper.simulator.deterministic:
            more = _SCATTERS
        elif state.most:
            more += f" ({foreseen(state, z, chosen, history)})"
        reasons.append(
            f"the emulator is off by {off:.2f} noise sds (rms), where {chosen.tolerance:g} are "
            f"allowed: {more}. {_usable(state, off, wider, shifted)}"
        )
    if measured is not None and measured.covered < _LEAST_COVERED and off > 0.3 * chosen.tolerance:
        reasons.append(
            f"its 90 % intervals hold {100 * measured.covered:.0f} % of the runs it had not seen"
        )
    if between > chosen.tolerance and not _has_all_rows(state):
        reasons.append(
            f"between its nodes it is off by {between:.2f} noise sds (rms), where "
            f"{chosen.tolerance:g} are allowed, and rows of the data lie there: give it more nodes"
        )
    return Emulation(
        state.emulated, state.emulator, tuple(state.runs), measured, expected, between, own_noise,
        not reasons, tuple(reasons), tuple(history), bool(state.earlier), wider, shifted,
    )  # fmt: skip


def foreseen(
    state: State, z: Array, chosen: EmulationSettings, history: Sequence[tuple[int, float]]
) -> str:
    """Say how many runs will be needed, by a power of their number, and what would lower it."""
    if state.own_noise and state.keeper.simulator.deterministic:
        return _SCATTERS
    runs, errors = np.array(history).T
    said = "how many cannot be foreseen, for the error does not fall as it should"
    if len(history) > 1:
        slope, level = np.polyfit(np.log(runs), np.log(np.maximum(errors, 1e-300)), 1)
        needed = float(np.exp((np.log(chosen.tolerance) - level) / slope)) if slope < 0 else np.inf
        rounded = plain_number(needed, 2)
        if len(state.runs) < float(rounded) < 100 * runs[-1]:
            said = f"as its error falls it needs some {rounded} runs"
    names = [p.name for p in state.problem.priors.entries[:-1]]
    ratio = np.where(state.free, z.std(axis=0), 0.0)
    little = [
        f"{names[i]} ({100 * ratio[i]:.0f} %)" for i in np.argsort(-ratio) if ratio[i] > _LITTLE
    ]
    if little:
        said += (
            '; fewer if you fix, with dist = "fixed", what you know of '
            f"{', '.join(little)}: of these the data say least (posterior sds in parts of the "
            "prior's)"
        )
    return said


def idle(state: State, z: Array) -> list[str]:
    """Name parameters that move no output by what is looked into, wherever draws have them."""
    entries, emulator = state.problem.priors.entries[:-1], state.emulator
    z = z[state.holds(z)]
    if emulator is None or not len(z):
        return []
    at, found = emulator.curves_at(state.problem.conditions)[:, 1:].T, []
    usual = emulator.coefficients(state.axes.natural(z))
    for i in np.flatnonzero(state.free):
        moved = z.copy()
        moved[:, i] = np.roll(z[:, i], len(z) // 2)
        off = (emulator.coefficients(state.axes.natural(moved)) - usual) @ at
        if np.nanmax(np.sqrt(np.square(off).mean(axis=1))) < NEGLIGIBLE * state.sigma:
            found.append(entries[i].name)
    return found


def _between(state: State, z: Array) -> float:
    """Rms error at conditions between the nodes, in sds of the noise."""
    if state.emulator is None:
        raise AssertionError
    over = state.emulator.over
    left_out = over.left_out(np.concatenate([state.emulator.mean[None], state.emulator.curves]))
    # At the ends of the box a node that is left out has none beyond it.
    left_out = left_out[:, ((over.nodes > 0.0) & (over.nodes < 1.0)).all(axis=1)]
    theta = state.axes.natural(z[state.holds(z)][:64])
    c = np.concatenate([np.ones((len(theta), 1)), state.emulator.coefficients(theta)], axis=1)
    squares = np.square(c @ left_out)
    return float(np.sqrt(np.nanmean(squares))) / state.sigma if squares.size else 0.0


def _has_all_rows(state: State) -> bool:
    """Whether every row of the data is a node."""
    nodes = np.stack([*state.nodes.values()], axis=1)
    rows = np.stack([state.problem.conditions[name] for name in state.nodes], axis=1)
    scale = np.maximum(np.abs(nodes).max(axis=0), 1e-300)
    apart = np.abs(rows[:, None] - nodes) / scale
    return bool((apart.max(axis=2).min(axis=1) < 1e-6).all())


def _consequences(
    state: State, z: Array, measured: HeldOut | None
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """What the emulator's error does to each parameter, to first order.

    How many times as wide its posterior is for the error in the likelihood, and by how many of its
    sds errors like those that were measured shift it (rms).
    """
    emulator = state.emulator
    names = [
        p.name for p, free in zip(state.problem.priors.entries, state.free, strict=False) if free
    ]
    z = z[state.holds(z)]
    if emulator is None or len(z) < 2 * len(names) + 2:
        return {}, {}
    means, unknown = emulator.with_unknown(state.axes.natural(z))
    rows = emulator.curves_at(state.problem.conditions)[:, 1:]
    u = z[:, state.free] - z[:, state.free].mean(axis=0)
    slopes = np.linalg.lstsq(u, (means - means.mean(axis=0)) @ rows.T, rcond=None)[0]  # (d, n)
    # In units of the prior's sds, whose own precision is one.
    prior, noise = np.eye(len(names)), state.sigma**2 * np.eye(len(rows))
    both = noise + float(np.median(unknown)) * (rows * emulator.variances) @ rows.T
    weighed = np.linalg.solve(both, slopes.T)
    posterior = np.linalg.inv(prior + slopes @ weighed)
    alone = np.linalg.inv(prior + slopes @ slopes.T / state.sigma**2)
    sd = np.sqrt(np.diag(posterior))
    wider = dict(zip(names, (sd / np.sqrt(np.diag(alone))).tolist(), strict=True))
    if measured is None:
        return wider, {}
    shifts = np.sqrt(np.mean(np.square(measured.errors @ weighed @ posterior), axis=0)) / sd
    return wider, dict(zip(names, shifts.tolist(), strict=True))


def _usable(
    state: State, off: float, wider: Mapping[str, float], shifted: Mapping[str, float]
) -> str:
    """Say for what an emulator that is not good enough can be used all the same."""
    said = "Its error is in the likelihood"
    if wider:
        most = max(wider, key=wider.__getitem__)
        percent = plain_number(100.0 * (wider[most] - 1.0), 2)
        said += f", which makes the posterior of {most} {percent} % wider and of no other more"
    if shifted:
        most = max(shifted, key=shifted.__getitem__)
        said += f"; estimates are off by at most {shifted[most]:.2f} of their sds (rms, {most})"
    model = state.problem.bound.model
    unit = f"{100.0 * off * state.sigma:.2g} %"
    if model.response != "log":
        unit = f"{plain_number(off * state.sigma, 2)} {QUANTITIES[model.output].unit_word}".rstrip()
    return (
        f"{said}; the simulator's own output is known to {unit} (rms). It is usable for what is "
        "coarser than that, not to compare models or to tell smaller gaps"
    )
