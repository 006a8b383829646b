"""What a calibration assumes of its rows and priors, tested: a remark for each that fails.

The likelihood takes rows as independent, and scattered as it says, about what the conditions of the
model explain. The tests that have a probability are one family: on rows that are so, `LEVEL` is the
chance that any of them fails. `docs/statistics/likelihood.md` lists them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import scipy

from calib.data.checks import column_notes, lines_of, source_of, spelling_notes, unit_notes, word_of
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import distances
from calib.inference.estimators import PointEstimate, estimate_least_squares
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.validation.residuals import Check, Remark, outlying_notes, residual_checks
from calib.validation.scores import PRIOR_SET

# Chance that readings agree to the last digit, from which equal rows are taken for copies.
_COPIED = 0.01
# Draws that are looked at for an edge of where the model has a value, and what part beyond it is.
_PROBES, _MANY = 100, 0.2
# Estimates so many posterior sds off, which the likelihood finds better too, contradict the prior.
FAR_SDS = 3.0
# A posterior that falls from a bound has at least a tenth of its mass within a quarter of an sd of
# it: a half-normal has 0.12, a uniform one 0.07.
_BESIDE, _HEAPED = 0.25, 0.1
_UNIT_FIRST = (
    "whether neighbouring rows are alike, the scatter even and its tails light is not judged while "
    "a column looks to be in another unit"
)
_CONTRADICTED = "Prior contradicted"
_MEND_PRIOR = "widen the prior (`calib priors`), or look for what is wrong with the data"


def checks_of(calibration: Calibration) -> tuple[Check, ...]:
    """Test a calibration's prior and, unless a column is in another unit, its residuals.

    Of such a column the priors make a misfit, whose residuals say nothing of the rows.
    """
    problem = calibration.problem
    residuals = () if any(column_notes(problem.table)) else residual_checks(
        problem, calibration.draws.mode
    )  # fmt: skip
    return (*_contradicted(calibration), *residuals)


def remarks_of(calibration: Calibration) -> tuple[Remark, ...]:
    """Say what a reader should mend, or know, that does not take one of the family of tests."""
    problem, t = calibration.problem, calibration.draws.mode
    outlying = (Remark(note, "Rows far off", True) for note in outlying_notes(problem, t))
    return (
        *outlying, *file_remarks(problem, float(problem.theta(t[None])[0, -1])),
        *((Remark(_UNIT_FIRST),) if any(column_notes(problem.table)) else ()),
        *_pressed(calibration), *_cut_off(problem, calibration.draws.flat),
    )  # fmt: skip


def _cut_off(problem: Problem, draws: Array) -> Iterable[Remark]:
    """A posterior that ends where the model has no value, and not where the data end it.

    Draws twice as far from their mean as they are lie beyond such an edge: a fifth of them if it is
    nearer than 1.7 sds.
    """
    some = draws[:: max(1, len(draws) // _PROBES)][:_PROBES]
    mean = draws.mean(axis=0)
    t = np.concatenate([mean + 2.0 * (some - mean), mean - 2.0 * (some - mean)])
    t = t[np.isfinite(problem.priors.log_prob(t))]
    nowhere = np.isneginf(problem.log_likelihood(t))
    if nowhere.sum() <= _MANY * len(t):
        return
    # Of the side where there is none, the coordinate that is farthest off.
    away = (t[nowhere].mean(axis=0) - mean) / draws.std(axis=0)
    i = int(np.argmax(np.abs(away)))
    low, high = problem.priors.ppf(np.outer([0.16, 0.84], np.ones(t.shape[1])))[:, i]
    if draws[:, i].std() > 0.25 * (high - low):
        # Of what the data hardly tell, an edge of the model is as much assumed as the prior is.
        return
    at = f"{'large' if away[i] > 0.0 else 'small'} {problem.priors.free[i].name}"
    yield Remark(
        f"{problem.bound.model.name}: the posterior ends where the model has no value, at {at} "
        "above all: it is cut off there, not where the data end it; mend the model there, or "
        "exclude such values by the bounds of the priors",
        "Posterior cut off", shifts=True,
    )  # fmt: skip


def parameter_remarks(calibration: Calibration, remarks: Sequence[Remark]) -> dict[str, str]:
    """Say of each parameter of a summary what a table has room for; nothing of most.

    `remarks` are those of the verdict, which says whether least squares far off fit better.
    """
    contradicted = any(r.title == _CONTRADICTED and r.shifts for r in remarks)
    best, pressed = _least_squares(calibration), _bounds_pressed(calibration)
    far = {} if best is None else _far_off(calibration, best)
    found = {}
    for name, s in calibration.summary.items():
        said = ["set by the prior"] * (s.sd_ratio > 0.9)
        if name in pressed:
            said.append(f"pressed against its bound {plain_number(pressed[name])}")
        if best is not None and name in far:
            value = plain_number(_estimated(calibration, best, name))
            said.append(
                f"{value} by least squares, {abs(far[name]):.0f} sds off" if contradicted
                else f"least squares fit as well with {value}"
            )  # fmt: skip
        found[name] = "; ".join(said)
    return found


def _bounds_pressed(calibration: Calibration) -> dict[str, float]:
    """Bounds, in natural values, that posteriors heap up at and the priors by themselves do not."""
    flat, found = calibration.draws.flat, {}
    for j, prior in enumerate(calibration.problem.priors.free):
        if calibration.summary[prior.name].sd_ratio > PRIOR_SET:
            continue
        for bound in (prior.lower, prior.upper):
            beside = np.abs(flat[:, j] - bound) < _BESIDE * flat[:, j].std()
            if np.isfinite(bound) and bound != prior.loc and beside.mean() > _HEAPED:
                found[prior.name] = float(np.exp(bound) if prior.log else bound)
    return found


def _pressed(calibration: Calibration) -> Iterable[Remark]:
    for name, bound in _bounds_pressed(calibration).items():
        yield Remark(
            f"the posterior of {name} is pressed against {plain_number(bound)}, where its prior "
            f"ends: values beyond are excluded by the prior, not by the data"
            f"{_beyond(calibration, name)}; widen it (`calib priors`) unless they are impossible",
            "Posterior at a bound", shifts=True,
        )  # fmt: skip


def _beyond(calibration: Calibration, name: str) -> str:
    """Say what least squares give without the bounds of a parameter, where they are soon found."""
    problem = calibration.problem
    model = problem.bound.model
    if model.slow or model.uncertain is not None or name not in model.parameters:
        return ""
    entries = tuple(
        replace(
            p, lower=-np.inf, upper=np.inf,
            scale=p.scale if np.isfinite(p.scale) else p.upper - p.lower,
        ) if p.name == name else p
        for p in problem.priors.entries
    )  # fmt: skip
    free = replace(problem, priors=replace(problem.priors, entries=entries))
    with suppress(CalibError):
        best = estimate_least_squares(free, generator(calibration.seed, name, "without bounds"))
        sampled = dict(zip(model.parameters, best.theta, strict=True))
        found = {name: float(sampled[name]), **best.reported}
        said = [f"{n} = {plain_number(v)}" for n, v in found.items()]
        return f" (without its bounds least squares give {', '.join(said)})"
    return ""


def _least_squares(calibration: Calibration) -> PointEstimate | None:
    """The estimate that seeded the sampler, unless it is on a bound, where others mean nothing."""
    finite = [e for e in calibration.estimates if np.isfinite(e.rmse)]
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


def _estimated(calibration: Calibration, best: PointEstimate, name: str) -> float:
    sampled = dict(zip(calibration.problem.bound.model.parameters, best.theta, strict=True))
    return float({**sampled, **best.reported}[name])


def _far_off(calibration: Calibration, best: PointEstimate) -> dict[str, float]:
    """Parameters of the model whose estimate is far off, the farthest first, with how many sds."""
    model, found = calibration.problem.bound.model, {}
    for name, draws in calibration.parameters.items():
        if name in model.parameters or name in model.reported:
            s = calibration.summary[name]
            value = np.array([_estimated(calibration, best, name)])
            sds = distances(draws.ravel(), value, (s.hdi_lower, s.hdi_upper))[0]
            found[name] = float(np.nan_to_num(sds[0], nan=0.0))
    far = sorted(found, key=lambda name: -abs(found[name]))
    return {name: found[name] for name in far if abs(found[name]) > FAR_SDS}


def _contradicted(calibration: Calibration) -> Iterable[Check]:
    """Whether least squares, which know no prior, say otherwise than chance has it.

    Of the model's parameters by an F test of the sums of squares at the mode and at their own
    estimates, which is too rarely significant where a prior that is right takes the place of data;
    of the noise's scale, where it is one, by the chi-squared test of their own.
    """
    problem, best = calibration.problem, _least_squares(calibration)
    names = set(problem.bound.model.parameters)
    free = sum(prior.name in names for prior in problem.priors.free)
    left = problem.response.size - free
    if best is None or left < 2:
        return
    mode = problem.theta(calibration.draws.mode[None])
    natural = np.concatenate([mode, problem.completed(best.theta, mode[0, -1])[None]])
    raw = problem.residuals(natural) / problem.noise.scale(mode, problem.conditions)
    with_prior, without = np.square(raw).sum(axis=1)
    if not np.isfinite(without):
        return
    if far := _far_off(calibration, best):
        gain = max(with_prior - without, 0.0) / free
        ratio = gain / max(without / left, 1e-12 * with_prior / left)
        said = [
            f"{name} = {plain_number(_estimated(calibration, best, name))} where the posterior has "
            f"{plain_number(calibration.summary[name].mean)} ± "
            f"{plain_number(calibration.summary[name].sd)} ({abs(sds):.0f} posterior sds away)"
            for name, sds in [*far.items()][:2]
        ]
        yield Check(float(scipy.stats.f.sf(ratio, free, left)), Remark(
            f"the data contradict the prior: least squares, which know no prior, give "
            f"{' and '.join(said)} and leave {plain_number(100.0 * without / with_prior)} % of the "
            f"squared residuals; {_MEND_PRIOR}", _CONTRADICTED, shifts=True,
        ))  # fmt: skip
    scale = calibration.summary.get("sigma")
    if scale is not None and problem.noise.usual and problem.bound.model.uncertain is None:
        squares = min(with_prior, without) * (mode[0, -1] / scale.median) ** 2
        below = float(scipy.stats.chi2.cdf(squares, left))
        scatter = scale.median * np.sqrt(squares / left)
        yield Check(2.0 * min(below, float(scipy.stats.chi2.sf(squares, left))), Remark(
            f"the data contradict the prior of sigma: about least squares, which know no prior, "
            f"the rows scatter by {plain_number(scatter)} where the posterior of sigma has "
            f"{plain_number(scale.median)}; {_MEND_PRIOR}", _CONTRADICTED,
        ))  # fmt: skip


def file_remarks(problem: Problem, scatter: float) -> tuple[Remark, ...]:
    """Say what is odd in the rows themselves: units, names, copies, conditions that do not vary.

    `scatter` is the sd of a reading about the prediction, on the scale of the response.
    """
    found = [Remark(note, "Unit in doubt", True) for note in column_notes(problem.table)]
    found += map(Remark, spelling_notes(problem.table))
    for name, values in problem.conditions.items():
        quantity = QUANTITIES[name]
        if np.unique(values).size == 1:
            found.append(Remark(
                f"{source_of(problem.table)}: {word_of(problem.table, quantity)} is the same in "
                "all rows; what depends on it comes from the prior, and predictions elsewhere "
                "with it"
            ))  # fmt: skip
        notes = unit_notes(problem.table, quantity, values)
        found += [Remark(note, "Unit in doubt", True) for note in notes]
    return (*found, *map(Remark, _few_settings(problem)), *_copies(problem, scatter))


def _few_settings(problem: Problem) -> Iterable[str]:
    """Rows at fewer different conditions than there are parameters, however many rows."""
    settings = len(np.unique(np.stack([*problem.conditions.values()], axis=1), axis=0))
    names = set(problem.bound.model.parameters)
    free = sum(prior.name in names for prior in problem.priors.free)
    if settings < free:
        yield (
            f"{source_of(problem.table)}: the rows are at {settings} different settings of the "
            f"conditions, which tell no more than so many numbers about {free} parameters; the "
            "rest comes from the prior"
        )


def _copies(problem: Problem, scatter: float) -> Iterable[Remark]:
    """Rows that repeat another one exactly, unless the readings are so coarse that some would."""
    table = problem.table
    at = np.stack([*problem.conditions.values()], axis=1)
    _, place, count = np.unique(at, axis=0, return_inverse=True, return_counts=True)
    rows = np.column_stack([place.ravel(), problem.observed])
    _, first, whole = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    copied = first[whole.ravel()] != np.arange(len(table))
    if not copied.any():
        return
    pairs = float((count * (count - 1) / 2.0).sum())
    # Two readings at one condition differ by a normal of sd sqrt(2) sigma, whose density at zero
    # times the last digit is the chance that they agree.
    agree = _last_digit(problem) / (2.0 * np.sqrt(np.pi) * max(scatter, 1e-300))
    if scipy.stats.poisson.sf(int(copied.sum()) - 1, pairs * min(agree, 1.0)) > _COPIED:
        return
    yield Remark(
        f"{source_of(table)}, {lines_of(table, copied)}: {_rows(int(copied.sum()))} another one "
        "exactly; a copy counts as a measurement and narrows every width: delete it, unless it was "
        "measured",
        "Copied rows",
    )


def _last_digit(problem: Problem) -> float:
    """Return the step of the readings, on the scale of the response; zero if there is none."""
    y = problem.observed
    size = float(np.abs(y).max())
    for places in range(10):
        if np.abs(y - np.round(y, places)).max() <= 1e-12 * size:
            step = 10.0**-places
            return float(step / np.median(y)) if problem.bound.model.response == "log" else step
    return 0.0


def _rows(n: int) -> str:
    return "this row repeats" if n == 1 else f"these {n} rows repeat"
