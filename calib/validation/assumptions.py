"""What a calibration assumes of its rows and priors, tested: a remark for each that fails.

The tests that have a probability are one family: on rows and priors that are as assumed, `LEVEL` is
the chance that any of them fails. `docs/statistics/likelihood.md` lists them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from calib.data.checks import column_notes, lines_of, source_of, spelling_notes, unit_notes, word_of
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import distances
from calib.inference.estimators import PointEstimate, estimate_least_squares
from calib.inference.priors import Prior
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.validation.constants import FAR_SDS
from calib.validation.residuals import Check, Remark, outlying_notes, remark, residual_checks
from calib.validation.scores import PRIOR_SET


def checks_of(calibration: Calibration) -> tuple[Check, ...]:
    """Test a calibration's prior and, unless a column is in another unit, its residuals.

    Of such a column the priors make a misfit, whose residuals say nothing of the rows.
    """
    problem = calibration.problem
    judged = not any(column_notes(problem.table))
    residuals = residual_checks(problem, calibration.draws.mode) if judged else ()
    return (*_contradicted(calibration), *residuals)


def remarks_of(calibration: Calibration) -> tuple[Remark, ...]:
    """Say what a reader should correct, or know, that does not take one of the family of tests."""
    problem, t = calibration.problem, calibration.draws.mode
    return (
        *(remark("outlying", note=note) for note in outlying_notes(problem, t)),
        *file_remarks(problem, float(problem.theta(t[None])[0, -1])),
        *(
            (remark("unit_first"),)
            if any(column_notes(problem.table))
            else _surprising(calibration)
        ),
        *(
            remark("pressed", name=n, bound=plain_number(b), beyond=_beyond(calibration, n))
            for n, b in _bounds_pressed(calibration).items()
        ),
        *cut_off(problem, calibration.draws.flat),
    )


def conflicts(calibration: Calibration) -> tuple[str, ...]:
    """Name the parameters that the data put where their priors have less than 2.5 % of the mass."""
    priors, summary = calibration.problem.priors.central(0.95), calibration.summary
    return tuple(
        name
        for name, (low, high) in priors.items()
        if summary[name].sd_ratio <= PRIOR_SET and not low <= summary[name].median <= high
    )


def _surprising(calibration: Calibration) -> Iterator[Remark]:
    priors = calibration.problem.priors.central(0.95)
    for name in conflicts(calibration):
        s = calibration.summary[name]
        found, expected = (
            f"{plain_number(a, 2)} to {plain_number(b, 2)}"
            for a, b in ((s.hdi_lower, s.hdi_upper), priors[name])
        )
        yield remark("surprising", name=name, found=found, expected=expected)


def cut_off(problem: Problem, draws: Array) -> Iterator[Remark]:
    """A posterior, draws (n, d), that ends where the model has no value, and not by the data.

    Draws twice as far from their mean as they are lie beyond such an edge: a fifth of them if it is
    nearer than 1.7 sds.
    """
    some = draws[:: max(1, len(draws) // 100)][:100]
    mean = draws.mean(axis=0)
    t = np.concatenate([mean + 2.0 * (some - mean), mean - 2.0 * (some - mean)])
    t = t[np.isfinite(problem.priors.log_prob(t))]
    nowhere = np.isneginf(problem.log_likelihood(t))
    if nowhere.sum() <= 0.2 * len(t):
        return
    # Of the side where there is none, the coordinate that is farthest off.
    away = (t[nowhere].mean(axis=0) - mean) / draws.std(axis=0)
    i = int(np.argmax(np.abs(away)))
    low, high = problem.priors.ppf(np.outer([0.16, 0.84], np.ones(t.shape[1])))[:, i]
    # Of what the data hardly tell, an edge of the model is as much assumed as the prior is.
    if draws[:, i].std() <= 0.25 * (high - low):
        side = "large" if away[i] > 0.0 else "small"
        name = problem.priors.free[i].name
        yield remark("cut_off", model=problem.bound.model.name, side=side, name=name)


def parameter_remarks(calibration: Calibration, remarks: Sequence[Remark]) -> dict[str, str]:
    """Say of each parameter of a summary what a table has room for; nothing of most.

    `remarks` are those of the verdict, which says whether least squares far off fit better.
    """
    contradicted = any(r.title == "Prior contradicted" and r.shifts for r in remarks)
    best, pressed = _least_squares(calibration), _bounds_pressed(calibration)
    far = {} if best is None else _far_off(calibration, best)
    found = {}
    for name, s in calibration.summary.items():
        said = ["not identified"] * (s.sd_ratio > PRIOR_SET)
        if name in pressed:
            said.append(f"pressed against its bound {plain_number(pressed[name])}")
        if name in far:
            value, sds = far[name]
            said.append(
                f"{plain_number(value)} by least squares, {abs(sds):.0f} sds off"
                if contradicted
                else f"least squares fit as well with {plain_number(value)}"
            )
        found[name] = "; ".join(said)
    return found


def _bounds_pressed(calibration: Calibration) -> dict[str, float]:
    """Bounds, in natural values, at which posteriors heap up and their priors do not.

    A posterior that falls from a bound has at least a tenth of its mass within a quarter of an sd
    of it: a half-normal has 0.12, a uniform one 0.07.
    """
    flat, found = calibration.draws.flat, {}
    for j, prior in enumerate(calibration.problem.priors.free):
        if calibration.summary[prior.name].sd_ratio > PRIOR_SET:
            continue
        for bound in (prior.lower, prior.upper):
            near = np.abs(flat[:, j] - bound) < 0.25 * flat[:, j].std()
            if np.isfinite(bound) and bound != prior.loc and near.mean() > 0.1:
                found[prior.name] = float(np.exp(bound) if prior.log else bound)
    return found


def _beyond(calibration: Calibration, name: str) -> str:
    """Say what least squares give without the bounds of a parameter, where they are soon found."""
    problem = calibration.problem
    model = problem.bound.model
    if model.slow or model.uncertain is not None or name not in model.parameters:
        return ""

    def unbounded(prior: Prior) -> Prior:
        scale = prior.scale if np.isfinite(prior.scale) else prior.upper - prior.lower
        return replace(prior, lower=-np.inf, upper=np.inf, scale=scale)

    entries = tuple(unbounded(p) if p.name == name else p for p in problem.priors.entries)
    free = replace(problem, priors=replace(problem.priors, entries=entries))
    with suppress(CalibError):
        best = estimate_least_squares(free, generator(calibration.seed, name, "without bounds"))
        found = {name: _estimated(calibration, best)[name], **best.reported}
        said = [f"{n} = {plain_number(v)}" for n, v in found.items()]
        return f" (without its bounds least squares give {', '.join(said)})"
    return ""


def _estimated(calibration: Calibration, estimate: PointEstimate) -> dict[str, float]:
    """Parameters of the model by an estimate, sampled and reported."""
    names = calibration.problem.bound.model.parameters
    return {**dict(zip(names, map(float, estimate.theta), strict=True)), **estimate.reported}


def _least_squares(calibration: Calibration) -> PointEstimate | None:
    """The best estimate, unless it is on a bound, where others mean nothing.

    Of those that seeded the sampler; without any, by least squares unless the model is slow.
    """
    problem, estimates = calibration.problem, list(calibration.estimates)
    if not estimates and not problem.bound.model.slow and problem.bound.model.uncertain is None:
        with suppress(CalibError):
            name = problem.bound.model.name
            rng = generator(calibration.seed, name, "least_squares")
            estimates = [estimate_least_squares(problem, rng)]
    finite = [e for e in estimates if np.isfinite(e.rmse)]
    best = min(finite, key=lambda e: e.rmse, default=None)
    if best is None:
        return None
    known = dict(zip(calibration.problem.bound.model.parameters, best.theta, strict=True))
    for prior in calibration.problem.priors.free:
        ends = np.array([prior.lower, prior.upper])
        ends = np.exp(ends) if prior.log else ends
        if prior.name in known and np.isclose(known[prior.name], ends, atol=1e-6).any():
            return None
    return best


def _far_off(calibration: Calibration, best: PointEstimate) -> dict[str, tuple[float, float]]:
    """Parameters of the model whose estimate is far off, the farthest first: estimate and sds."""
    found = {}
    for name, value in _estimated(calibration, best).items():
        if name not in calibration.parameters:
            continue
        s, draws = calibration.summary[name], calibration.parameters[name].ravel()
        sds = distances(draws, np.array([value]), (s.hdi_lower, s.hdi_upper))[0][0]
        if abs(sds) > FAR_SDS:
            found[name] = (value, float(sds))
    return dict(sorted(found.items(), key=lambda item: -abs(item[1][1])))


def _contradicted(calibration: Calibration) -> Iterator[Check]:
    """Whether least squares, which know no prior, say otherwise than chance has it.

    Of the model's parameters by an F test of the sums of squares at the mode and at their own
    estimates, which is too rarely significant where a prior that is right takes the place of data;
    of the noise's scale, where it is one, by the chi-squared test of their own.
    """
    problem, best = calibration.problem, _least_squares(calibration)
    free = _n_free(problem)
    left = problem.response.size - free
    if best is None or left < 2:
        return
    mode = problem.theta(calibration.draws.mode[None])
    natural = np.concatenate([mode, problem.completed(best.theta, mode[0, -1])[None]])
    raw = problem.residuals(natural) / problem.scale(mode)
    with_prior, without = np.square(raw).sum(axis=1)
    if not np.isfinite(without):
        return
    if far := _far_off(calibration, best):
        gain = max(with_prior - without, 0.0) / free
        ratio = gain / max(without / left, 1e-12 * with_prior / left)
        said = []
        for name, (value, sds) in [*far.items()][:2]:
            s = calibration.summary[name]
            said.append(
                f"{name} = {plain_number(value)} where the posterior has {plain_number(s.mean)} ± "
                f"{plain_number(s.sd)} ({abs(sds):.0f} posterior sds away)"
            )
        part = plain_number(100.0 * without / with_prior)
        told = remark("contradicted", estimates=" and ".join(said), part=part)
        yield Check(float(scipy.stats.f.sf(ratio, free, left)), told)
    scale = calibration.summary.get("sigma")
    if scale is not None and problem.noise.iid_normal and problem.bound.model.uncertain is None:
        squares = min(with_prior, without) * (mode[0, -1] / scale.median) ** 2
        law = scipy.stats.chi2(left)
        scatter = plain_number(scale.median * np.sqrt(squares / left))
        told = remark("noise_contradicted", scatter=scatter, sigma=plain_number(scale.median))
        yield Check(2.0 * float(min(law.cdf(squares), law.sf(squares))), told)


def _n_free(problem: Problem) -> int:
    """How many parameters of the model, not of the noise, are free."""
    return sum(prior.name in problem.bound.model.parameters for prior in problem.priors.free)


def file_remarks(problem: Problem, scatter: float) -> tuple[Remark, ...]:
    """Say what is odd in the rows themselves: units, names, copies, conditions that do not vary.

    `scatter` is the sd of a reading about the prediction, on the scale of the response.
    """
    table, source = problem.table, source_of(problem.table)
    found = [remark("unit", note=note) for note in column_notes(table)]
    found += [remark("note", note=note) for note in spelling_notes(table)]
    for name, values in problem.conditions.items():
        quantity = QUANTITIES[name]
        if np.unique(values).size == 1:
            found.append(remark("constant", word=word_of(table, quantity)))
        found += [remark("unit", note=note) for note in unit_notes(table, quantity, values)]
    # Rows at fewer different conditions than there are parameters, however many rows.
    settings = len(np.unique(np.stack([*problem.conditions.values()], axis=1), axis=0))
    if settings < (free := _n_free(problem)):
        found.append(remark("few_settings", settings=settings, free=free))
    copied = _copies(problem, scatter)
    if n := int(copied.sum()):
        rows = "this row repeats" if n == 1 else f"these {n} rows repeat"
        found.append(remark("copies", source=source, lines=lines_of(table, copied), rows=rows))
    return tuple(found)


def _copies(problem: Problem, scatter: float) -> NDArray[np.bool_]:
    """Rows that repeat another one exactly, unless the readings are so coarse that some would."""
    at = np.stack([*problem.conditions.values()], axis=1)
    _, place, count = np.unique(at, axis=0, return_inverse=True, return_counts=True)
    rows = np.column_stack([place.ravel(), problem.observed])
    _, first, whole = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    copied = np.asarray(first[whole.ravel()] != np.arange(len(rows)))
    pairs = float((count * (count - 1) / 2.0).sum())
    # Two readings at one condition differ by a normal of sd sqrt(2) sigma, whose density at zero
    # times the last digit is the chance that they agree.
    agree = _last_digit(problem) / (2.0 * np.sqrt(np.pi) * max(scatter, 1e-300))
    chance = scipy.stats.poisson.sf(int(copied.sum()) - 1, pairs * min(agree, 1.0))
    return np.asarray(copied & (chance <= 0.01))


def _last_digit(problem: Problem) -> float:
    """Return the step of the readings, on the scale of the response; zero if there is none."""
    y = problem.observed
    size = float(np.abs(y).max())
    for places in range(10):
        if np.abs(y - np.round(y, places)).max() <= 1e-12 * size:
            step = 10.0**-places
            return float(step / np.median(y)) if problem.bound.model.response == "log" else step
    return 0.0
