"""How a simulator is emulated, what is known on the way, and what became of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from calib.data.quantities import output_of
from calib.errors import CalibError
from calib.inference.constants import NEGLIGIBLE
from calib.inference.design import across_zero
from calib.inference.joint import JointProblem, calibrate_joint
from calib.inference.mode import prior_widths
from calib.inference.priors import Prior
from calib.inference.problem import Problem
from calib.inference.random import generator, stream
from calib.inference.sampler import SamplerSettings, sample_posterior
from calib.models.base import Array
from calib.models.simulators.emulator import (
    Axes,
    Emulator,
    Training,
    build_emulator,
    emulated_model,
)
from calib.models.simulators.kriging import Region
from calib.models.simulators.simulator import Run, RunKeeper, without_value

# What is being done, how much of it is done, and of how much.
type Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class HeldOut:
    """The emulator against runs that it had not seen, at draws of the posterior.

    The rms error is over runs and rows, in sds of the noise. `z` are errors of the coefficients in
    their predicted sds, `pit` where these lie in their predicted distributions (even from 0 to 1 if
    the emulator knows its error), `covered` the share within central 90 % intervals, `errors` are
    those at the data's rows, (runs, n), on the scale of the response.
    """

    runs: int
    rmse: float
    z: Array
    pit: Array
    covered: float
    errors: Array


@dataclass(frozen=True)
class Emulation:
    """A problem whose simulator is emulated, and how well.

    Parameters
    ----------
    problem : Problem
        To be calibrated: its model is the emulator.
    runs : tuple of Run
        All that were asked for: probes, repeats and those that failed among them.
    held_out : HeldOut, optional
        None where no run was left for it.
    expected : float
        The error that the emulator itself expects, as `HeldOut.rmse`.
    between : float
        Rms error at conditions between the nodes, in sds of the noise.
    own_noise : float
        Sd of the simulator's own noise on the scale of the response; zero if it is deterministic.
    passed : bool
        Whether the emulator is good enough.
    reasons : tuple of str
        Why not.
    history : tuple of (int, float)
        Runs, and the expected error then.
    extended : bool
        Whether an emulator that was there serves another campaign, to which the runs were added.
    wider : mapping of str to float
        How many times as wide the posterior of each parameter is for the emulator's error, which
        is in the likelihood (to first order).
    shifted : mapping of str to float
        By how many of its posterior sds errors as those on runs not seen shift it (rms).
    """

    problem: Problem
    emulator: Emulator
    runs: tuple[Run, ...]
    held_out: HeldOut | None
    expected: float
    between: float
    own_noise: float
    passed: bool
    reasons: tuple[str, ...]
    history: tuple[tuple[int, float], ...]
    extended: bool = False
    wider: Mapping[str, float] = field(default_factory=dict)
    shifted: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        state = "passed" if self.passed else "NOT good enough"
        return f"<Emulation of {self.problem.bound.model.name} from {len(self.runs)} runs: {state}>"

    @property
    def failed(self) -> tuple[Run, ...]:
        """Runs without a value."""
        return tuple(run for run in self.runs if not run.ok)

    def document(self) -> Mapping[str, Any]:
        """Return it for JSON."""
        h = self.held_out
        return {
            "runs": len(self.runs),
            "nodes": next(iter(self.emulator.training.nodes.values())).size,
            "curves": len(self.emulator.curves),
            "expected_error_in_noise_sds": self.expected,
            "between_nodes_error_in_noise_sds": self.between,
            "simulator_noise_sd": self.own_noise,
            "passed": self.passed,
            "reasons": list(self.reasons),
            "posterior_times_as_wide": dict(self.wider),
            "posterior_shifted_by_sds": dict(self.shifted),
            "history": [list(entry) for entry in self.history],
            "held_out": None if h is None else {
                "runs": h.runs, "rmse_in_noise_sds": h.rmse,
                "covered_90": h.covered, "pit": h.pit.tolist(),
            },
            "failed": [
                {"parameters": r.theta.tolist(), "kind": r.failure.kind,
                 "reason": r.failure.reason, "printed": r.failure.printed}
                for r in self.failed if r.failure is not None
            ],
        }  # fmt: skip


# Draws on the way to the next runs: for a picture, not for a result.
_ROUGH = SamplerSettings(ensembles=2, walkers=64, steps=60, max_steps=60, keep=1024)


class Known:
    """What is known of one output: values of the runs on the scale of its response, an emulator.

    Parameters
    ----------
    problem : Problem
    axes : Axes
        Of the simulator's parameters, in which posteriors lie in `regions`.
    nodes : mapping of str to ndarray, shape (m,)
        Conditions of each run.
    across : ndarray of bool, shape (m,)
        See `State`.
    """

    def __init__(
        self, problem: Problem, axes: Axes, nodes: Mapping[str, Array], across: NDArray[np.bool_]
    ) -> None:
        self.problem = self.emulated = problem
        self.axes, self.across = axes, across
        self.training = Training(
            np.zeros((0, axes.loc.size)), np.zeros((0, across.size)), nodes
        )  # fmt: skip
        self.sigma = 0.1 * float(problem.response.std())
        self.own_noise = 0.0
        self.regions: tuple[Region, ...] = ()
        self._emulator: Emulator | None = None

    @property
    def emulator(self) -> Emulator:
        """The emulator; there is none before the first `rebuild`."""
        if self._emulator is None:
            raise RuntimeError("nothing was emulated yet")
        return self._emulator

    @property
    def built(self) -> int:
        """On how many runs the emulator stands."""
        return 0 if self._emulator is None else len(self._emulator.training.theta)

    def use(self, emulator: Emulator) -> None:
        """Put an emulator in the place of the model."""
        self._emulator, bound = emulator, self.problem.bound
        model = emulated_model(bound.model, emulator)
        self.emulated = replace(self.problem, bound=replace(bound, model=model))

    def values(self, runs: Sequence[Run], n: int) -> Array:
        """Return runs on the scale of the response, NaN of those without a value, shape (k, n)."""
        column, empty = self.problem.bound.model.output, np.full(n, np.nan)
        with np.errstate(all="ignore"):
            found = [self.problem.bound.to_response(r.outputs.get(column, empty)) for r in runs]
        return np.array(found).reshape(-1, n)

    def outputs(self, values: Array) -> Array:
        """Return values (k, m) as outputs, without those across zero."""
        return self.problem.bound.from_response(values[:, ~self.across])

    def without_across(self, nodes: Mapping[str, Array]) -> None:
        """Go on with other nodes, those not across zero; the other values are kept."""
        values = self.training.values[:, ~self.across]
        self.training = replace(self.training, values=values, nodes=nodes)
        self.across = self.across[~self.across]

    def rebuild(self, *, again: bool) -> None:
        """Fit the emulator again to all runs, `again` over the conditions as well."""
        known = self._emulator
        again |= known is None or known.mean.size != self.across.size
        self.use(
            build_emulator(
                replace(self.training, values=self.tamed(self.training.values)), self.axes,
                NEGLIGIBLE * self.sigma, self.regions,
                scales=None if known is None else known.functions.scales,
                over=None if again or known is None else known.over,
            )
        )  # fmt: skip

    def tamed(self, values: Array) -> Array:
        """Return values (..., m), those across zero no wilder than a process can bear."""
        low, high = self._bounds()
        return np.where(self.across, np.clip(values, low, high), values)

    @property
    def wild_near(self) -> bool:
        """Whether there are wild values near the posterior, as far as that is known."""
        values, known = self._near()
        return known and bool((self.tamed(values) != values).any())

    def _bounds(self) -> tuple[float, float]:
        """Beyond which values across zero are wild: by what the others are near the posterior."""
        values = self._near()[0][:, ~self.across]
        if not values.size:
            return -np.inf, np.inf
        low, high = float(values.min()), float(values.max())
        return low - 10.0 * (high - low), high + 10.0 * (high - low)

    def _near(self) -> tuple[Array, bool]:
        """Return the values of runs near the posterior; of all, and false, while few are there."""
        ok = self.training.ok
        z, values = self.axes.of(self.training.theta[ok]), self.training.values[ok]
        inside = np.zeros(len(z), dtype=bool)
        for region in self.regions:
            inside |= region.inside(z)
        known = bool(inside.sum() >= 8)
        return (values[inside] if known else values), known

    def error(self, z: Array) -> float:
        """The emulator's expected error at draws, rms over the rows, in sds of the noise."""
        return float(np.sqrt(self.row_variance(z).mean()))

    def row_variance(self, z: Array) -> Array:
        """Mean over the data's rows of the emulator's variance, in that of the noise, (k,)."""
        _, unknown = self.emulator.with_unknown(self.axes.natural(z))
        curves = self.emulator.curves_at(self.problem.conditions)[:, 1:]
        total = unknown * float((curves**2 @ self.emulator.variances).sum())
        return np.asarray(total / (len(curves) * self.sigma**2))


class State:
    """What is known so far of outputs that have a posterior; `nodes` (m,) are those of each run.

    The posterior is that of the one output's problem, or of a `joint` problem, in which others may
    have a part. `most` runs are made at the most, those that were `tried` before among them. Nodes
    `across` zero (m,) serve a diagnosis only, which asks what another rolling radius does to small
    slips: they are given up where runs near the posterior are wild there, or have a value but for
    them.
    """

    def __init__(
        self, problems: Sequence[Problem], keeper: RunKeeper, nodes: Mapping[str, Array],
        seed: int, most: int = 0, label: str = "emulate", across: NDArray[np.bool_] | None = None,
        tried: Sequence[Run] = (), progress: Progress | None = None,
        joint: JointProblem | None = None,
    ) -> None:  # fmt: skip
        self.keeper, self.nodes, self.joint = keeper, nodes, joint
        self.seed, self.most, self.label, self.progress = seed, most, label, progress
        self.axes = _axes(problems[0])
        self.free = np.array([not p.fixed for p in _entries(problems[0])])
        n = next(iter(nodes.values())).size
        self.across = np.zeros(n, dtype=bool) if across is None else across
        self.outputs = tuple(Known(p, self.axes, nodes, self.across) for p in problems)
        self.runs: list[Run] = list(tried)
        self.mode: Array | None = None
        self.region: Region | None = None
        self.earlier: tuple[Region, ...] = ()

    @classmethod
    def beyond(
        cls, emulator: Emulator, problem: Problem, keeper: RunKeeper, seed: int, most: int,
        progress: Progress | None = None,
    ) -> State:  # fmt: skip
        """Return the state in which an emulator begins to serve another problem as well."""
        nodes = emulator.training.nodes
        across = across_zero(nodes)
        state = cls([problem], keeper, nodes, seed, most, "extend", across, progress=progress)
        state.outputs[0].training, state.earlier = emulator.training, emulator.regions
        state.outputs[0].use(emulator)
        return state

    @property
    def name(self) -> str:
        """What is emulated, for messages."""
        return ", ".join(known.problem.bound.model.name for known in self.outputs)

    @property
    def emulator(self) -> Emulator:
        """That of the first output: all know alike where there are values."""
        return self.outputs[0].emulator

    @property
    def training(self) -> Training:
        """That of the first output: all learn from the same runs."""
        return self.outputs[0].training

    @property
    def scatters(self) -> bool:
        """Whether a simulator that is declared deterministic gives other values each time."""
        own = any(known.own_noise for known in self.outputs)
        return own and self.keeper.simulator.deterministic

    @property
    def left(self) -> int:
        """How many runs may still be made."""
        return max(self.most - len(self.runs), 0)

    def carry_out(self, theta: Array) -> Array:
        """Make runs; return values of outputs (o) on the scales of the responses, (k, o, m)."""
        values = self._made(theta, self.nodes)
        lost = np.flatnonzero(~has_value(values))
        before = len(self.runs)
        plain = self._without_across(theta[lost[0]]) if lost.size else None
        if plain is not None:
            self.runs = [*map(across_too, self.runs[:before]), *self.runs[before:]]
            values = values[..., ~self.across]
            self._give_up_across()
            if self.outputs[0].built:
                self.rebuild()
            values[lost[0]] = plain
            lost = lost[1 : 1 + self.left]
            values[lost] = self._made(theta[lost], self.nodes)
        return values

    def repeat(self, theta: Array, replicate: int) -> Array:
        """Make runs that had a value again; return values as `carry_out` does."""
        return self._made(theta, self.nodes, replicate)

    def _without_across(self, theta: Array) -> Array | None:
        """Return the values (o, d) of a failed run, repeated without the nodes across zero.

        None if it fails there too, or failed by chance.
        """
        if self.earlier or not self.across.any() or self.left < 2:
            return None
        plain = {name: v[~self.across] for name, v in self.nodes.items()}
        found = self._made(theta[None], plain)
        if not has_value(found)[0]:
            return None
        again = self._made(theta[None], self.nodes, 99)
        return None if has_value(again)[0] else found[0]

    def _give_up_across(self) -> None:
        """Go on without the nodes across zero."""
        self.nodes = {name: v[~self.across] for name, v in self.nodes.items()}
        self.across = self.across[~self.across]
        for known in self.outputs:
            known.without_across(self.nodes)

    def _made(self, theta: Array, nodes: Mapping[str, Array], replicate: int = 0) -> Array:
        found = self.keeper.runs(theta, nodes, replicate)
        self.runs += found
        n = next(iter(nodes.values())).size
        values = np.stack([known.values(found, n) for known in self.outputs], axis=1)
        values[~has_value(values)] = np.nan
        return values

    def learn(self, theta: Array, values: Array) -> None:
        """Take runs into the training, values (k, o, m)."""
        for i, known in enumerate(self.outputs):
            known.training = known.training.plus(theta, values[:, i])

    def tamed(self, values: Array) -> Array:
        """Return values (..., o, m) as `Known.tamed` does each."""
        return np.stack([k.tamed(values[..., i, :]) for i, k in enumerate(self.outputs)], axis=-2)

    def rebuild(self) -> None:
        """Fit the emulators again to all runs."""
        for known in self.outputs:
            known.regions = (*self.earlier, *([] if self.region is None else [self.region]))
        if not self.earlier and any(known.wild_near for known in self.outputs):
            self._give_up_across()
        runs = len(self.training.theta)
        self._tell("runs in the emulator", self.outputs[0].built, runs)
        for known in self.outputs:
            known.rebuild(again=self.region is None)
        self._tell("runs in the emulator", runs, runs)

    def _tell(self, what: str, done: int, planned: int) -> None:
        if self.progress is not None:
            self.progress(what, done, planned)

    def sample(self, step: int) -> Array:
        """Draw from the posterior under the emulators; return z of the draws, shape (k, d)."""
        self._tell("sampling for the next runs", 0, 1)
        tell = partial(self._tell, "sampling for the next runs")
        try:
            z = self._drawn(step, tell) if self.joint is None else self._drawn_jointly(step, tell)
        except CalibError as error:
            raise self.without_value("no parameters are left for the data") from error
        self.region = _region(z, self.free)
        return z

    def _drawn(self, step: int, tell: Callable[[int, int], None]) -> Array:
        (known,) = self.outputs
        draws = sample_posterior(
            known.emulated, stream(self.seed, self.label, step), settings=_ROUGH, progress=tell,
            starts=None if self.mode is None else self.mode[None],
        )  # fmt: skip
        self.mode = draws.mode
        natural = known.emulated.theta(_some(draws.flat))
        known.sigma = float(np.median(natural[:, -1]))
        return self.axes.of(known.problem.of_model(natural))

    def _drawn_jointly(self, step: int, tell: Callable[[int, int], None]) -> Array:
        """Draw from the joint posterior: parameters of all groups, where there are groups."""
        if self.joint is None:
            raise RuntimeError("there is no joint posterior")
        joint = self.joint.with_models([known.emulated.bound.model for known in self.outputs])
        seed = int(generator(self.seed, self.label, step).integers(2**31))
        found = calibrate_joint(joint, seed, settings=_ROUGH, progress=tell)
        of_group: dict[str, Array] = {}
        for known in self.outputs:
            sigmas = []
            output = output_of(known.problem.bound.model.output)
            for group in [g for o, g in joint.parts if o == output]:
                part = found.calibration(output, group or None)
                natural = part.problem.theta(_some(part.draws.flat))
                sigmas.append(float(np.median(natural[:, -1])))
                of_group.setdefault(group, self.axes.of(known.problem.of_model(natural)))
            known.sigma = min(sigmas)
        return _some(np.concatenate([*of_group.values()]))

    def without_value(self, why: str) -> CalibError:
        """Return what to say where runs that failed are in the way."""
        return without_value(why, self.keeper.simulator, self.runs, self.keeper.folder)

    def error(self, z: Array) -> float:
        """The largest error that an emulator expects at draws, see `Known.error`."""
        return max(known.error(z) for known in self.outputs)

    def serves(self, z: Array) -> bool:
        """Whether nearly all draws lie where an emulator that is there was found good."""
        inside = np.zeros(len(z), dtype=bool)
        for region in self.earlier:
            inside |= region.inside(z)
        good = bool(self.earlier) and self.emulator.good and self.emulator.support is None
        return good and bool(inside.mean() > 0.95)

    def lost(self, z: Array) -> bool:
        """Whether to most draws a run that failed is closer than any other: no value is known."""
        if self.region is None:
            return False
        runs = self.region.coordinates(self.axes.of(self.training.theta))
        nearest = cdist(self.region.coordinates(z), runs).argmin(axis=1)
        return bool((~self.training.ok[nearest]).mean() > 0.5)


def has_value(values: Array) -> NDArray[np.bool_]:
    """Whether runs have all their values (k, o, m), shape (k,)."""
    return np.asarray(np.isfinite(values).all(axis=(1, 2)))


def _some(draws: Array) -> Array:
    """Return 512 of draws (k, d), evenly picked."""
    return np.asarray(draws[np.linspace(0, len(draws) - 1, 512).round().astype(int)])


def across_too(run: Run) -> Run:
    """Say of a run that failed that it was asked across zero, which is given up."""
    if run.failure is None:
        return run
    reason = f"{run.failure.reason} (with conditions below zero, which are not asked for any more)"
    return replace(run, failure=replace(run.failure, reason=reason))


def _entries(problem: Problem) -> tuple[Prior, ...]:
    """Priors of the simulator's parameters."""
    return problem.priors.entries[: len(problem.bound.model.parameters)]


def _axes(problem: Problem) -> Axes:
    entries = _entries(problem)
    free = np.array([not p.fixed for p in entries])
    width = np.ones(len(entries))
    width[free] = prior_widths(problem.priors)[: int(free.sum())]
    return Axes(
        np.array([p.log and not p.fixed for p in entries]), np.array([p.loc for p in entries]),
        width,
    )  # fmt: skip


def _region(z: Array, free: NDArray[np.bool_]) -> Region:
    """A region in which draws are round; parameters that are held stay as they are."""
    covariance = np.cov(z.T) if z.shape[1] > 1 else np.atleast_2d(np.var(z))
    covariance = covariance + np.diag(np.where(free, 1e-8 * np.diag(covariance) + 1e-14, 1.0))
    return Region(z.mean(axis=0), np.linalg.cholesky(covariance), 2.5 + np.sqrt(free.sum()))
