"""Several models on the same rows: what each predicts of a row that it has not seen.

Of each model the log predictive density of every row is found without that row (leave-one-out by
smoothed importance sampling, by fitting again where its Pareto k is above 0.7), and of rows that
were held out. The noise of a calibration is compared with normal noise in the same way. Densities
are of the output itself, whatever scale a model's noise is on, so that models of its logarithm can
be compared with others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from calib.arguments import takes
from calib.batch.folders import keep
from calib.data import Table, as_table
from calib.data.reader import Tabular
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import estimate
from calib.inference.io import save_calibration
from calib.inference.likelihood import Noise
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampler import Progress, SamplerSettings
from calib.models import get_model
from calib.models.base import Array
from calib.shown import Shown
from calib.validation.constants import CLEAR, SMALL
from calib.validation.residuals import WORDS
from calib.validation.validate import Validation, leave_one_out, validate_held_out

type ComparisonProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Candidate:
    """A model, calibrated and scored: by leave-one-out, and on the rows held out if there are any.

    `held_elpd` is their summed log predictive density, each given the fitted rows; NaN without any.
    """

    calibration: Calibration
    loo: Validation
    held: Validation | None
    held_elpd: float

    @property
    def model(self) -> str:
        """Name of the model."""
        return self.calibration.problem.bound.model.name

    @property
    def rows(self) -> Array:
        """Log predictive density of each fitted row without it, shape (n,)."""
        return _rows_of(self.loo)

    @property
    def sound(self) -> bool:
        """Whether the calibration, and every one without a row, passed the gate."""
        return self.calibration.converged and not self.loo.unconverged


def _rows_of(loo: Validation) -> Array:
    return np.full(loo.observed.size, np.nan) if loo.elpd_rows is None else loo.elpd_rows


class Difference(NamedTuple):
    """How far a model's expected log predictive density is below the best, and its error."""

    elpd: float
    se: float

    @property
    def clear(self) -> bool:
        """Whether the data tell the two models apart."""
        return self.elpd > max(SMALL, CLEAR * self.se)


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """Models on the same rows, the best first.

    Parameters
    ----------
    candidates : tuple of Candidate
        By their expected log predictive densities.
    weights : mapping of str to float
        Stacking weights by model; they sum to 1.
    """

    candidates: tuple[Candidate, ...]
    weights: Mapping[str, float]
    seed: int

    def __repr__(self) -> str:
        """Name the models with their weights."""
        weights = ", ".join(f"{c.model} {self.weights[c.model]:.2f}" for c in self.candidates[:5])
        return f"<Comparison on {self.candidates[0].rows.size} rows, weights: {weights}>"

    @property
    def sound(self) -> bool:
        """Whether every posterior it rests on passed the gate."""
        return all(c.sound for c in self.candidates)

    @property
    def differences(self) -> dict[str, Difference]:
        """Of each model from the best; zero for that itself."""
        best = self.candidates[0].rows
        return {c.model: difference(best - c.rows) for c in self.candidates}

    @property
    def sentence(self) -> str:
        """What the data prefer, and which models they cannot tell apart, in plain words."""
        told_apart = {model: d.clear for model, d in self.differences.items()}
        return sentence(told_apart, [c.model for c in self.candidates if not c.sound])


def sentence(told_apart: Mapping[str, bool], unsound: Sequence[str]) -> str:
    """Say which models data prefer, and which they cannot tell apart.

    Models come the best first, with whether the data tell each from it; `unsound` did not converge.
    """
    if unsound:
        return (
            f"No preference is stated: {_joined(unsound)} did not converge. Raise max_steps "
            "(--max-steps), or give tighter priors."
        )
    best, *others = told_apart
    told = [m for m in others if told_apart[m]]
    untold = [m for m in others if not told_apart[m]]
    parts = []
    if told:
        parts.append(f"The data prefer {best} to {_joined(told)}.")
    if untold:
        parts.append(f"They cannot tell {best} from {_joined(untold)}." if told else
                     f"The data cannot tell {_joined([best, *untold])} apart.")  # fmt: skip
    return " ".join(parts)


def _joined(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def difference(rows: Array) -> Difference:
    """Sum up by how much the rows of one model are more probable than those of another."""
    return Difference(float(rows.sum()), float(np.sqrt(rows.size * rows.var(ddof=1))))


@takes(seed=Integral, settings=SamplerSettings)
def compare(
    models: Sequence[str],
    table: Tabular,
    seed: int = 2019,
    *,
    held_out: Tabular | None = None,
    priors: Mapping[str, Path] | None = None,
    settings: SamplerSettings | None = None,
    progress: ComparisonProgress | None = None,
    workers: int = 1,
) -> Comparison:
    """Calibrate several models on the same rows and compare what they predict.

    Parameters
    ----------
    models : sequence of str
        At least two, of one output.
    table : Table, mapping of str to array_like, or pandas.DataFrame
        With the output, and the conditions of every model.
    held_out : Table, mapping or DataFrame, optional
        Rows of the same campaign that are not fitted.
    priors : mapping of str to Path, optional
        Prior files by model; the shipped ones by default.
    settings : SamplerSettings, optional
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    workers : int
        Processes for fits without a row; the numbers do not depend on it.

    Raises
    ------
    CalibError
        If there are not two models, they have different outputs, or the table lacks a column.

    References
    ----------
    Vehtari, Gelman & Gabry (2017), doi:10.1007/s11222-016-9696-4; Yao, Vehtari, Simpson & Gelman
    (2018), doi:10.1214/17-BA1091; Sivula, Magnusson, Matamoros & Vehtari (2020), arXiv:2008.10296.

    Examples
    --------
    >>> import calib
    >>> ruts = calib.load_he2019("rut_depth")
    >>> comparison = calib.compare(["bekker", "modified_bekker"], ruts)
    >>> comparison.sentence
    'The data prefer modified_bekker to bekker.'
    """
    check_comparable([models] if isinstance(models, str) else models)
    given, table = priors or {}, as_table(table)
    if strange := [name for name in given if name not in models]:
        raise CalibError(
            f"priors are given for {', '.join(strange)}, which is not compared",
            where="calib.compare, priors",
            expected=", ".join(models),
            hint="name the models that are compared",
        )
    return compare_problems(
        [build_problem(name, table, given.get(name)) for name in models], seed,
        held_out=None if held_out is None else as_table(held_out), settings=settings,
        progress=progress, workers=workers,
    )  # fmt: skip


def compare_problems(
    problems: Sequence[Problem],
    seed: int,
    *,
    held_out: Table | None = None,
    settings: SamplerSettings | None = None,
    progress: ComparisonProgress | None = None,
    workers: int = 1,
) -> Comparison:
    """Compare as `compare` does models that are bound to the same rows already."""
    tell = progress or (lambda what, done, planned: None)
    found = [_candidate(p, held_out, seed, settings, tell, workers) for p in problems]
    for one in found:
        # One that has no density at a row would be infinitely worse.
        rows = one.calibration.problem.table
        empty = rows.lines[~np.isfinite(one.rows)]
        if empty.size:
            raise CalibError(
                f"{one.model} gives {empty.size} of {len(rows)} rows no density",
                where=f"{rows.source}, line {empty[0]}",
                expected="rows that every model can have, however improbable",
                hint="leave the model out, or the rows where it is not defined",
            )
    weights = stacking_weights(np.stack([c.rows for c in found], axis=1))
    named = {c.model: float(w) for c, w in zip(found, weights, strict=True)}
    ranked = tuple(sorted(found, key=lambda c: -c.loo.elpd))
    return Comparison(ranked, {c.model: named[c.model] for c in ranked}, seed)


def check_comparable(models: Sequence[str]) -> None:
    """Raise a CalibError unless there are at least two models, all of one output."""
    if not all(isinstance(name, str) for name in models):
        raise CalibError(
            f"a model is given as {', '.join(type(name).__name__ for name in models)}",
            expected="the names of models",
            hint='write calib.compare(["bekker", "reece"], table, seed=1)',
        )
    if len(models) < 2 or len(set(models)) < len(models):
        raise CalibError(
            f"there is nothing to compare in {', '.join(models) or 'no model'}",
            expected="two or more models, each once",
            hint="name two or more: calib.compare([MODEL, MODEL], table), or calib compare MODEL "
            "MODEL my.csv, or calib report my.csv --compare MODEL --compare MODEL",
        )
    outputs = {name: get_model(name).output for name in models}
    if len(set(outputs.values())) > 1:
        raise CalibError(
            "the models predict different outputs",
            where="; ".join(f"{name}: {output}" for name, output in outputs.items()),
            expected="models of one output",
            hint="compare those of one output at a time",
        )


def _candidate(
    problem: Problem, held_out: Table | None, seed: int, settings: SamplerSettings | None,
    tell: ComparisonProgress, workers: int,
) -> Candidate:  # fmt: skip
    name = problem.bound.model.name
    start = estimate(problem, "least_squares", generator(seed, name, "least_squares"))
    calibration = calibrate(
        problem, seed, label=name, estimates=(start,), settings=settings,
        progress=lambda done, n: tell(f"{name}: sampling", done, n),
    )  # fmt: skip
    keep(name, partial(save_calibration, calibration))
    loo = leave_one_out(
        calibration, settings=settings, workers=workers,
        progress=lambda done, n: tell(f"{name}: leaving rows out", done, n),
    )  # fmt: skip
    if held_out is None:
        return Candidate(calibration, loo, None, float("nan"))
    rows = problem.with_table(held_out).log_likelihood_rows(calibration.draws.flat)
    # Where a parameter vector gives the equation no value, its density is zero.
    density = logsumexp(np.where(np.isfinite(rows), rows, -np.inf), axis=0) - np.log(len(rows))
    return Candidate(
        calibration, loo, validate_held_out(calibration, held_out), float(density.sum())
    )


def stacking_weights(elpd: Array) -> Array:
    """Weights (models,) of predictive distributions whose mixture predicts the rows best.

    From the log predictive density of each row without it, (n, models) (Yao et al. 2018,
    doi:10.1214/17-BA1091, Eq 4). The sum of logarithms is concave in the weights; each step of
    expectation maximisation increases it.
    """
    density = np.exp(elpd - elpd.max(axis=1, keepdims=True))
    weights = np.full(density.shape[1], 1.0 / density.shape[1])
    for _ in range(100_000):
        mixed = density * weights
        new = (mixed / mixed.sum(axis=1, keepdims=True)).mean(axis=0)
        if np.abs(new - weights).max() < 1e-9:
            break
        weights = new
    return np.asarray(new / new.sum())


@dataclass(frozen=True)
class NoisePreference:
    """How much better a noise predicts rows left out than normal noise of one sd does.

    Difference of the expected log predictive densities, and its standard error. It is sound if both
    calibrations, and all without a row, passed the gate, and every row has a density. `line` is
    that of the row in the file that makes more than half of the difference; 0 if none does.
    """

    noise: Noise
    elpd: float
    se: float
    sound: bool
    line: int = 0

    @property
    def preferred(self) -> str:
        """``"chosen"``, ``"normal"``, ``"neither"``, or ``"unknown"`` where it is not sound."""
        if not self.sound:
            return "unknown"
        if abs(self.elpd) <= max(SMALL, CLEAR * self.se):
            return "neither"
        return "chosen" if self.elpd > 0.0 else "normal"

    @property
    def sentence(self) -> str:
        """What was found, in plain words."""
        words, places = WORDS["noise_preference"], 1 if self.se >= 0.1 else 2
        text: str = words[self.preferred].format(
            chosen=noise_words(self.noise), elpd=f"{self.elpd:+.{places}f}",
            se=f"{self.se:.{places}f}",
        )  # fmt: skip
        alone = self.line and abs(self.elpd) > SMALL and self.preferred != "unknown"
        return text + (words["one_line"].format(line=self.line) if alone else "")


def noise_words(noise: Noise) -> str:
    """Name a noise in plain words."""
    law = "Student-t noise" if noise.student else "normal noise"
    along = noise.correlated_along
    said = [f"depends on {noise.depends_on}"] * bool(noise.column)
    said += [f"is correlated along {along}"] * bool(along)
    return f"{law} that {' and '.join(said)}" if said else law


def with_usual_noise(problem: Problem) -> Problem:
    """Return a problem with normal noise of one standard deviation, and all else the same."""
    left_out = problem.noise.parameters
    kept = tuple(p for p in problem.priors.entries if p.name not in left_out)
    usual = problem.noise.of_errors
    priors = replace(problem.priors, entries=kept, noise=replace(usual, errors=()))
    return replace(problem, noise=usual, priors=priors)


def noise_preference(
    calibration: Calibration,
    *,
    loo: Validation | None = None,
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
    workers: int = 1,
) -> NoisePreference | None:
    """Compare the noise of a calibration with normal noise of one sd by leave-one-out.

    None where the noise is that of all by default. `loo` is of the calibration, where it was left
    one out already; settings are for the other calibration and the refits.

    References
    ----------
    Vehtari, Gelman & Gabry (2017), doi:10.1007/s11222-016-9696-4.
    """
    problem = calibration.problem
    if not problem.noise.parameters:
        return None
    usual = calibrate(
        with_usual_noise(problem), calibration.seed, label=f"{calibration.label} normal noise",
        estimates=calibration.estimates, settings=settings,
    )  # fmt: skip
    parts = [
        leave_one_out(c, settings=settings, progress=progress, workers=workers)
        if done is None
        else done
        for c, done in ((calibration, loo), (usual, None))
    ]
    better = _rows_of(parts[0]) - _rows_of(parts[1])
    if not np.isfinite(better).all():
        return NoisePreference(problem.noise, float("nan"), float("nan"), sound=False)
    sound = all(c.converged for c in (calibration, usual)) and not any(p.unconverged for p in parts)
    elpd, se = difference(better)
    most = int(np.argmax(np.abs(better)))
    line = int(problem.table.lines[most]) if 2.0 * abs(better[most]) > abs(elpd) else 0
    return NoisePreference(problem.noise, elpd, se, sound, line)
