"""Which tests to run next: those that are expected to narrow a prediction or settle a question.

Within each explanation (a calibration has one) all is taken as normal, with the means and
covariances of posterior draws: what readings leave of a variance is then known before they are
made (Chaloner & Verdinelli 1995, doi:10.1214/ss/1177009939). How they move the weights of
explanations is averaged over simulated truths. Tests are added one by one, each the best for its
cost (Krause, Singh & Guestrin 2008, JMLR 9:235-284). The forecast is then checked without
normality: readings are simulated from draws, and all other draws weighted by them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, owens_t, softmax

from calib.data import Table
from calib.data.files import number_in
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import psis
from calib.inference.likelihood import IID_NORMAL, Noise
from calib.models.base import Array, Conditions
from calib.shown import Shown
from calib.validation.constants import HALF_BAND, MIN_DEFINED, MOST_TESTS, PARETO_K_MAX

type Aim = Literal["bands", "causes", "decision"]
TRUTHS, SIMULATED = 256, 400  # while tests are chosen, and for the check
MOMENTS, WEIGHTED = 1000, 4000  # draws of a calibration: for moments, and to be weighted
_CELLS = 2_000_000


@dataclass(frozen=True)
class Beliefs:
    """N draws of what m tests would read, and of o outputs at t targets.

    Parameters
    ----------
    names : tuple of str
        Explanations; one of a calibration.
    cause, weight : ndarray, shape (N,)
        The explanation that a draw belongs to, by its place, and how much the draw counts.
    readings, scale : ndarray, shape (N, m, o)
        Mean of a reading and scale of its noise, on the scale of the response.
    targets : ndarray, shape (N, o, t)
        Mean outputs, in their units.
    half : ndarray, shape (N, o, t)
        Half of the 90 % band of the noise there.
    own, noise : ndarray, shape (N, p), and Noise
        The noise at scale one: natural parameters and family.
    """

    names: tuple[str, ...]
    cause: NDArray[np.intp]
    weight: Array
    readings: Array
    scale: Array
    targets: Array
    half: Array
    own: Array
    noise: Noise = IID_NORMAL

    def defined(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Tests (m,) and targets (t,) at which nearly all draws have a value."""
        least = MIN_DEFINED * self.weight.sum()
        tests = self.weight @ np.isfinite(self.readings).all(axis=2) >= least
        return tests, self.weight @ np.isfinite(self.targets).all(axis=1) >= least

    def at(self, tests: NDArray[np.generic], targets: NDArray[np.generic]) -> Beliefs:
        """Keep some tests and targets, and the draws that have a value at all of them."""
        readings, wanted = self.readings[:, tests], self.targets[..., targets]
        rows = np.isfinite(readings).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=(1, 2))
        if (left := self.weight[rows].sum() / self.weight.sum()) < 0.5:
            raise CalibError(
                f"the model has a value at all conditions for {left:.0%} of the posterior",
                expected="most of it", hint="leave out conditions far from the calibrated ones",
            )  # fmt: skip
        return replace(
            self, cause=self.cause[rows], weight=self.weight[rows] / self.weight[rows].sum(),
            readings=readings[rows], scale=self.scale[:, tests][rows], targets=wanted[rows],
            half=self.half[..., targets][rows], own=self.own[rows],
        )  # fmt: skip

    def spread(self) -> tuple[Array, Array]:
        """Targets from their means, and the root mean variance of each output, shape (o, 1)."""
        away = self.targets - np.tensordot(self.weight, self.targets, 1)
        variance = np.tensordot(self.weight, away**2, 1).mean(axis=1, keepdims=True)
        return away, np.sqrt(np.maximum(variance, 1e-300))

    def relative(self) -> Array:
        """Targets, shape (N, o * t), whose variances have the sum one."""
        away, sd = self.spread()
        return np.asarray((away / sd).reshape(len(away), -1) / np.sqrt(away[0].size))

    def truths(self, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
        """Pick draws, each as often as it weighs."""
        at = (np.arange(count) + rng.uniform()) / count
        return np.minimum(np.searchsorted(np.cumsum(self.weight), at), len(self.weight) - 1)


def beliefs_of(
    calibration: Calibration, tests: Conditions, targets: Conditions, rng: np.random.Generator,
    size: int,
) -> Beliefs:  # fmt: skip
    """Draw from a calibration, of an emulator's error too."""
    problem = calibration.problem
    natural, noise = problem.theta(calibration.subset(size)), problem.noise
    both = {name: np.concatenate([v, targets[name]]) for name, v in tests.items()}
    location = problem.draw_mean_response(natural, both, rng)
    n, m = len(natural), next(iter(tests.values())).size
    wanted = problem.bound.from_response(location[:, m:])
    half = noise.of_normal(natural, targets, np.full((1, 1), HALF_BAND))
    half = half * (wanted if problem.bound.model.response == "log" else np.ones_like(wanted))
    own = [noise.own("nu", natural)] if noise.student else []
    scale = np.broadcast_to(noise.scale(natural, tests), (n, m))[..., None]
    return Beliefs(
        (calibration.label,), np.zeros(n, dtype=np.intp), np.ones(n), location[:, :m, None], scale,
        wanted[:, None], half[:, None], np.hstack([*own, np.ones((n, 1))]), Noise(noise.family),
    )  # fmt: skip


class _State:
    """Normals within each of h explanations given readings, those simulated of k truths.

    Covariances are those of deviations, of which each reading takes a part (Potter's square root).
    The first `r` targets are principal components, which keep variances and distances; those of a
    decision, from the threshold, are behind them.
    """

    def __init__(
        self, b: Beliefs, aim: Aim, over: tuple[int, float] | None, rng: np.random.Generator
    ) -> None:
        self.aim, self.rng, self.several = aim, rng, len(b.names) > 1
        relative, n = b.relative(), len(b.names)
        root = relative * np.sqrt(b.weight)[:, None]
        tall = len(root) > root.shape[1]
        size, axes = np.linalg.eigh(root.T @ root if tall else root @ root.T)
        # What lies between explanations takes its time: all but a thousandth of the variance.
        kept = np.cumsum(size) > (1e-3 if self.several else 1e-12) * size.sum()
        axes = axes[:, kept] if tall else root.T @ axes[:, kept] / np.sqrt(size[kept])
        wanted = relative @ axes / np.sqrt(size[kept].sum())
        self.r = wanted.shape[1]
        if over is not None:
            wanted = np.hstack([wanted, b.targets[:, over[0]] - over[1]])
        picked = b.truths(TRUTHS if self.several else 1, rng)
        self.p = np.bincount(b.cause, b.weight, n)
        self.truth, self.ln_w = b.readings[picked], np.tile(np.log(self.p), (picked.size, 1))
        # Student's noise tells as much of a mean as normal noise of this variance: the reciprocal
        # of Fisher's information.
        loss = (b.own[:, :1] + 3.0) / (b.own[:, :1] + 1.0) if b.noise.student else np.ones((1, 1))
        variance = b.scale**2 * loss[..., None]
        self.scale, self.parts, means, noises = np.sqrt(variance[picked]), [], [], []
        for h in range(n):
            rows = b.cause == h
            share = b.weight[rows] / self.p[h]
            of = b.readings[rows], wanted[rows]
            means.append([np.tensordot(share, v, 1) for v in of])
            away = [(v - m).T * np.sqrt(share) for v, m in zip(of, means[h], strict=True)]
            self.parts.append([np.ascontiguousarray(v.T) for v in away])
            noises.append(np.tensordot(share, variance[rows], 1))
        self.noise = np.array(noises)  # (h, m, o)
        # (k, h, m, o) and (k, h, targets)
        read, mean = (np.array(each)[None] for each in zip(*means, strict=True))
        self.read, self.mean = (np.repeat(v, picked.size, axis=0) for v in (read, mean))
        self._moments()
        self.first = mean[0, 0, self.r :, None], self.var[0, self.r :, None]

    def _moments(self) -> None:
        self.cov = np.array([np.einsum("nmo,nmp->mop", a, a) for a, _ in self.parts])
        self.cross = np.array([np.tensordot(t.T, a, 1) for a, t in self.parts])
        self.var = np.array([np.square(t).sum(axis=0) for _, t in self.parts])
        self.z = self.rng.standard_normal((len(self.truth), self.truth.shape[2]))

    def now(self) -> dict[Aim, float]:
        """Return all losses as they are; that of a decision if there is one."""
        weight, mean = softmax(self.ln_w, axis=1)[..., None], self.mean[..., None]
        asked: dict[Aim, bool] = {"bands": True, "causes": self.several}
        asked["decision"], var = self.mean.shape[2] > self.r, self.var[..., None]
        return {a: float(self._loss(a, weight, mean, var)[0]) for a in asked if asked[a]}

    def losses(self, tests: NDArray[np.intp]) -> Array:
        """Return what each of some tests is expected to leave of the aim's loss, shape (c,)."""
        at_once = max(1, _CELLS // self.mean.size)
        cuts = np.arange(at_once, tests.size, at_once)
        return np.concatenate([self._after(some) for some in np.split(tests, cuts)])

    def _after(self, tests: NDArray[np.intp]) -> Array:
        total, each = self.cov[:, tests], np.arange(self.noise.shape[2])
        total[..., each, each] += self.noise[:, tests]
        root = np.linalg.cholesky(total)
        white = np.linalg.inv(root)
        gain = np.einsum("hrco,hcpo->hrcp", self.cross[:, :, tests], white)
        var = np.maximum(self.var[..., None] - np.square(gain).sum(axis=-1), 0.0)
        read = self.truth[:, tests] + self.z[:, None] * self.scale[:, tests]
        z = np.einsum("hcpo,khco->khcp", white, read[:, None] - self.read[:, :, tests])
        ln_w = self.ln_w[..., None] - 0.5 * np.square(z).sum(axis=-1)
        ln_w -= np.log(np.einsum("hcoo->hco", root)).sum(axis=-1)
        mean = self.mean[..., None] + np.einsum("hrcp,khcp->khrc", gain, z)
        return self._loss(self.aim, softmax(ln_w, axis=1), mean, var)

    def _loss(self, aim: Aim, weight: Array, mean: Array, var: Array) -> Array:
        """Loss by weights (k, h, c), means (k, h, targets, c) and variances (h, targets, c)."""
        if aim == "causes":
            return np.asarray(1.0 - np.square(weight).sum(axis=1).mean(axis=0))
        if aim == "bands":  # within explanations and between them
            mean = mean[:, :, : self.r]
            middle = np.einsum("khc,khrc->krc", weight, mean)
            between = np.einsum("khc,khrc->kc", weight, mean**2) - np.square(middle).sum(axis=1)
            return np.asarray(self.p @ var[:, : self.r].sum(axis=1) + between.mean(axis=0))
        mean, var = mean[:, :, self.r :], var[:, self.r :]
        if self.several:
            p = np.einsum("khc,khrc->krc", weight, ndtr(mean / np.sqrt(np.maximum(var, 1e-300))))
            return np.asarray(np.minimum(p, 1.0 - p).mean(axis=(0, 1)))
        # The posterior mean will be normal, and on the other side of the threshold than the truth
        # with this probability (Owen 1956, doi:10.1214/aoms/1177728074).
        (mean, before), var = self.first, var[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(var / np.maximum(before - var, 0.0))
            return np.asarray(2.0 * owens_t(np.abs(mean) / np.sqrt(before), ratio).mean(axis=0))

    def take(self, test: int) -> dict[Aim, float]:
        """Make a test: condition on its readings, one output after the other."""
        # With noise that it was not chosen by.
        read = self.truth[:, test] + self.rng.standard_normal(self.z.shape) * self.scale[:, test]
        for o in range(read.shape[1]):
            for h, (a, t) in enumerate(self.parts):
                u, noise = a[:, test, o].copy(), self.noise[h, test, o]
                s = float(u @ u + noise)
                away = read[:, o] - self.read[:, h, test, o]
                self.ln_w[:, h] -= 0.5 * (away**2 / s + np.log(s))
                for deviations, mean in ((a, self.read[:, h]), (t, self.mean[:, h])):
                    shared = np.tensordot(u, deviations, 1)
                    mean += np.multiply.outer(away / s, shared)
                    deviations -= np.multiply.outer(u / (s + np.sqrt(s * noise)), shared)
        self._moments()
        return self.now()


@dataclass(frozen=True, repr=False)
class NextTests(Shown):
    """Tests to run next, the most telling first.

    Parameters
    ----------
    table : Table
        Their conditions, rows of the grid; one that is to be repeated stands there again.
    aim : {"bands", "causes", "decision"}
    cost : ndarray, shape (k,)
    outside : tuple of tuple of str
        For every test, the conditions that leave the calibrated range.
    names, outputs : tuple of str
        Explanations that were in play; canonical columns.
    band, reading : tuple of float
        For each output the 90 % width of its mean now, and of the noise, which no test narrows:
        root mean squares over the targets.
    forecast : mapping of str to ndarray, shape (k + 1,)
        After 0 to k tests: ``bands``, their width relative to now; of several explanations
        ``causes``, the expected probability of the wrong ones; ``decision``, the probability of a
        wrong one.
    simulated : mapping of str to pair of float
        What they are after all tests, by simulation, with Monte Carlo standard errors.
    unreliable : float
        Part of the simulated outcomes that too few draws bear out (Pareto k above 0.7).
    halved : int or None
        Tests after which the band is half as wide, if that is the aim and 50 are enough.
    left : float
        Part of the width that is left then, or after 50 tests.
    excluded : pair of int
        Rows of the grid and conditions to predict at which the model has no value.
    targets : int
        Conditions that are predicted.
    """

    table: Table
    aim: Aim
    cost: Array
    outside: tuple[tuple[str, ...], ...]
    names: tuple[str, ...]
    outputs: tuple[str, ...]
    band: tuple[float, ...]
    reading: tuple[float, ...]
    forecast: Mapping[str, Array]
    simulated: Mapping[str, tuple[float, float]]
    unreliable: float
    halved: int | None
    left: float
    excluded: tuple[int, int]
    targets: int

    def __repr__(self) -> str:
        left = float(self.forecast["bands"][-1])
        return f"<NextTests: {len(self.table)}, which leave {left:.0%} of the band's width>"


def chosen_tests(
    make: Callable[[NDArray[np.intp] | None], Beliefs], grid: Table, budget: float, aim: Aim,
    over: tuple[int, float] | None, outputs: tuple[str, ...], flags: tuple[tuple[str, ...], ...],
    rng: np.random.Generator,
) -> NextTests:  # fmt: skip
    """Choose tests and check what they bring.

    Parameters
    ----------
    make : callable
        Beliefs about some rows of the grid; about all of them for None.
    over : (int, float), optional
        The output of a decision, by its place, and the threshold.

    Raises
    ------
    CalibError
        If there is nothing to pay for, to predict or to settle.
    """
    every, whole = _costs(grid), make(None)
    tests, targets = whole.defined()
    places = np.flatnonzero(tests)
    if not places.size or not targets.any():
        raise CalibError(
            "the model has no value at any of the conditions", where=grid.source,
            expected="conditions that it can predict", hint="stay within the calibrated range",
        )  # fmt: skip
    cost, beliefs = every[places], whole.at(tests, targets)
    if not cost.min() <= budget < cost.min() * (MOST_TESTS + 1):
        raise CalibError(
            f"a budget of {budget:g} for tests that cost {cost.min():g} or more", where=grid.source,
            expected=f"what 1 to {MOST_TESTS} tests cost", hint="correct the budget or the costs",
        )  # fmt: skip

    def searched(by: Array) -> tuple[list[int], _State, list[dict[Aim, float]]]:
        state, found = _State(beliefs, aim, over, rng), list[int]()
        trace = [state.now()]
        if trace[0].get(aim, 0.0) < 1e-4:
            raise CalibError(
                f"the {'causes are' if aim == 'causes' else 'decision is'} as good as certain: the "
                "probability of being wrong is below 0.01 %, and no test can lower it noticeably",
                expected="a decision or causes in doubt",
                hint="no test is needed for it; to narrow the prediction, plan for the bands",
            )  # fmt: skip
        while (left := np.flatnonzero(cost <= budget - cost[found].sum() + 1e-9)).size:
            gain = trace[-1][aim] - state.losses(left)
            found.append(int(left[np.argmax(gain / by[left])]))
            trace.append(state.take(found[-1]))
        return found, state, trace

    # The better of the best for their cost and the best whatever their cost is never far from the
    # best of all (Leskovec et al. 2007, doi:10.1145/1281192.1281239).
    ways = [cost, np.ones_like(cost)][: 1 + bool(np.ptp(cost))]
    picked, state, trace = min(map(searched, ways), key=lambda found: found[2][-1][aim])
    losses = [each["bands"] for each in trace]
    while aim == "bands" and losses[-1] > 0.25 and len(losses) <= MOST_TESTS:
        gain = losses[-1] - state.losses(np.arange(places.size))
        losses.append(state.take(int(np.argmax(gain / cost)))["bands"])
    rows, used = places[picked], int(targets.sum())
    halves = [k for k, loss in enumerate(losses) if loss <= 0.25]
    forecast: dict[str, Array] = {a: np.array([each[a] for each in trace]) for a in trace[0]}
    forecast["bands"] = np.sqrt(forecast["bands"])
    checked = make(rows).at(np.arange(rows.size), targets)
    simulated, unreliable = _checked(checked, [*trace[0]], over, rng)
    return NextTests(
        grid.take(rows), aim, every[rows], tuple(flags[i] for i in rows), whole.names, outputs,
        tuple((2.0 * HALF_BAND * beliefs.spread()[1][:, 0]).tolist()),
        tuple((2.0 * np.sqrt(beliefs.weight @ np.square(beliefs.half).mean(axis=2))).tolist()),
        forecast, simulated, unreliable, halves[0] if halves and aim == "bands" else None,
        float(np.sqrt(losses[-1])), (int((~tests).sum()), targets.size - used), used,
    )  # fmt: skip


def _costs(grid: Table) -> Array:
    """Cost of each row: its ``cost``, or one."""
    cost = np.ones(len(grid))
    for row, cell in enumerate(grid.extra.get("cost", ())):
        cost[row] = np.nan
        with suppress(ValueError):
            cost[row] = number_in(cell, decimal_comma=False)
        if not 0.0 < cost[row] < np.inf:
            raise CalibError(
                f"a test costs {cell!r}", where=f"{grid.source}, row {row + 1}, column 'cost'",
                expected="a positive number", hint="correct the cost, or leave the column out",
            )  # fmt: skip
    return cost


def _checked(
    b: Beliefs, aims: list[Aim], over: tuple[int, float] | None, rng: np.random.Generator
) -> tuple[dict[str, tuple[float, float]], float]:
    """Simulate the readings of all tests, and weight all draws by them but the one they are of."""
    n, truths = len(b.weight), b.truths(SIMULATED, rng)
    flat, scale = b.readings.reshape(n, -1), b.scale.reshape(n, -1)
    read = flat[truths] + scale[truths] * b.noise.draw(b.own[truths], {}, rng, flat.shape[1])
    one = b.noise.scale(b.own, {})
    ln = np.log(b.weight) - np.log(scale).sum(axis=1) + np.stack(
        [b.noise.log_density((y - flat) / scale, b.own, one).sum(axis=1) for y in read]
    )  # fmt: skip
    others = np.arange(n) != truths[:, None]
    raw, weight = ln[others].reshape(SIMULATED, -1), np.zeros_like(ln)
    with np.errstate(all="ignore"):  # a tail too long to be smoothed is left as it is
        smooth, shape = psis(raw)
    sound = np.isfinite(smooth).all(axis=1, keepdims=True)
    weight[others] = softmax(np.where(sound, smooth, raw), axis=1).ravel()
    x = b.relative()
    # Against the truth: where all weight is on one draw, there is no spread, and yet an error.
    found = {"bands": np.square(x[truths] - weight @ x).sum(axis=1)}
    found["causes"] = 1.0 - (weight * (b.cause == b.cause[truths, None])).sum(axis=1)
    if over is not None:
        p = weight @ (b.targets[:, over[0]] > over[1])
        right = b.targets[truths, over[0]] > over[1]
        found["decision"] = ((p > 0.5) != right).mean(axis=1)
    means = {a: float(found[a].mean()) for a in aims}
    errors = {a: float(found[a].std(ddof=1) / np.sqrt(SIMULATED)) for a in aims}
    means["bands"] **= 0.5
    errors["bands"] /= 2.0 * means["bands"]
    return {a: (means[a], errors[a]) for a in aims}, 1.0 - float((shape <= PARETO_K_MAX).mean())
