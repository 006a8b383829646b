"""Outlying rows, and whether the rows prefer another noise to a normal one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from calib.data.files import plain_number
from calib.inference.calibration import Calibration, calibrate
from calib.inference.noise import NORMAL, USUAL, Noise
from calib.inference.problem import Problem
from calib.inference.sampling.mode import find_modes
from calib.inference.sampling.sampler import Progress, SamplerSettings
from calib.models.base import Array
from calib.validation.comparison import CLEAR, SMALL
from calib.validation.validate import Validation, leave_one_out

# Probability of naming any row of data that are as the likelihood says.
LEVEL = 1e-3
_STEP, _HUGE = 1e-5, 1e9
# Rows taken out at most, and degrees of freedom below which nobody can say.
_MOST, _LEAST_LEFT = 10, 2
_LONG = 5000
_MOST_NAMED = 5


@dataclass(frozen=True)
class OutlyingRow:
    """A row far off the others' calibration: its line in the file, and the output measured there.

    `sds` is its distance from what the other rows predict, in units of that distance's sd.
    """

    line: int
    value: float
    sds: float


def outlying_rows(problem: Problem, t: Array) -> tuple[OutlyingRow, ...]:
    """Find rows, the farthest first, that are too far from what the others say for any of so many.

    `t` (d,) are internal coordinates of a fit to all rows; none is found where too few would be
    left to judge by. Two that are wrong can hide each other. As in Rosner's (1983) generalised
    procedure, doi:10.1080/00401706.1983.10487848, the row of the largest externally studentised
    residual (Cook & Weisberg 1982, section 2.2, with the model made linear at the fit) is taken out
    and the others are fitted again, a few times; the last time at which it was too large by
    Bonferroni's bound says how many are suspected, and each of these must be too far from the fit
    to the rest. Long data are not fitted again: in them one row hides nothing.
    """
    n = problem.response.size
    most = 1 if n > _LONG else min(max(2, n // 10), _MOST)
    used, suspects, here = np.ones(n, dtype=bool), 0, t
    order: list[int] = []
    fits = [here]
    while len(order) < most:
        sds, left = _studentised(problem, here, used)
        if left < _LEAST_LEFT:
            break
        far = int(np.argmax(sds))
        order.append(far)
        if _probability(sds[far], int(used.sum()), left) < LEVEL / most:
            suspects = len(order)
        used[far] = False
        here = _fitted(problem, here, used) if n <= _LONG else here
        fits.append(here)
    if not suspects:
        return ()
    used = np.ones(n, dtype=bool)
    used[order[:suspects]] = False
    sds, left = _from_the_rest(problem, fits[suspects], used)
    probability = _probability(sds, n, left)
    found = np.flatnonzero((probability < LEVEL) & (~used | (n > _LONG)))
    rows = [
        OutlyingRow(int(problem.table.lines[i]), float(problem.observed[i]), float(sds[i]))
        for i in found
    ]
    return tuple(sorted(rows, key=lambda row: -row.sds))


def outlying_notes(problem: Problem, t: Array) -> Sequence[str]:
    """Say which rows are outlying, for a reader who may mend them."""
    rows = outlying_rows(problem, t)
    # Not the path: the page goes to others.
    weight = "for one such row moves the posterior and widens it"
    if problem.noise.student:
        weight = "to which Student-t noise gives little weight"
    source = PurePath(problem.table.source).name
    column = problem.table.column(problem.bound.model.output)
    said = [
        f"{source}, line {row.line}: {column.header} = "
        f"{plain_number(float(column.written(row.value)), 4)} is {row.sds:.1f} sds from what the "
        f"other rows say; check the reading, {weight}"
        for row in rows[:_MOST_NAMED]
    ]
    more = len(rows) - _MOST_NAMED
    return [*said, f"{source}: so are {more} more"] if more > 0 else said


def _studentised(problem: Problem, t: Array, used: NDArray[np.bool_]) -> tuple[Array, int]:
    """Externally studentised residuals of the rows used, and the variance's degrees of freedom."""
    residual, design, rank = linear(problem, t, used)
    leverage = np.sum(design**2, axis=1)
    left = int(used.sum()) - rank - 1
    # A row that a parameter of its own fits exactly cannot be judged.
    judged = used & (leverage < 1.0 - 1e-9)
    alone = np.where(judged, 1.0 - leverage, 1.0)
    variance = np.maximum(np.sum(residual[used] ** 2) - residual**2 / alone, 0.0) / max(left, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sds = np.abs(residual) / np.sqrt(variance * alone)
    return np.where(judged, np.nan_to_num(sds, nan=0.0, posinf=_HUGE), 0.0), left


def _from_the_rest(problem: Problem, t: Array, used: NDArray[np.bool_]) -> tuple[Array, int]:
    """Distances from a fit to the rows used, in sds of a new row's, and degrees of freedom."""
    residual, design, rank = linear(problem, t, used)
    left = int(used.sum()) - rank
    variance = max(float(np.sum(residual[used] ** 2)) / left, 1e-300)
    return np.abs(residual) / np.sqrt(variance * (1.0 + np.sum(design**2, axis=1))), left


def linear(problem: Problem, t: Array, used: NDArray[np.bool_]) -> tuple[Array, Array, int]:
    """Residuals (n,), and the model made linear at a fit, orthonormal over the rows used.

    Where the noise depends on a condition, over its scale there in units of sigma. The design is of
    shape (n, rank), of directions that move predictions; the noise scale does not.
    """
    steps = _STEP * np.maximum(np.abs(t), 1.0)
    moved = np.concatenate([t[None], t + np.diag(steps), t - np.diag(steps)])
    natural = problem.theta(moved)
    relative = problem.noise.scale(natural[:1], problem.conditions) / natural[0, -1]
    residuals = problem.residuals(natural) / relative
    d = t.size
    # One-sided beside ground where the model has no value, as at the edge of an emulator.
    ends = residuals[1:].reshape(2, d, -1)
    there = np.isfinite(ends).all(axis=2)
    ends = np.where(there[:, :, None], ends, residuals[0])
    apart = np.maximum(there.sum(axis=0), 1) * steps
    jacobian = ((ends[1] - ends[0]) / apart[:, None]).T
    _, sizes, directions = np.linalg.svd(jacobian[used], full_matrices=False)
    rank = int(np.sum(sizes > 1e-7 * max(float(sizes[0]), 1e-300)))
    return residuals[0], jacobian @ directions[:rank].T / sizes[:rank], rank


def _fitted(problem: Problem, t: Array, used: NDArray[np.bool_]) -> Array:
    """Fit some rows, starting at another fit."""
    some = problem.with_table(problem.table.take(used))
    # Nothing is drawn: the one start is given.
    rng = np.random.default_rng(0)
    return find_modes(some.log_prob, some.priors, rng, starts=t[None], spread=0)[0].t


def _probability(sds: Array | float, n: int, left: int) -> Any:
    """Of so large a distance in any of n rows of normal noise (Bonferroni's bound)."""
    return np.minimum(2.0 * n * scipy.stats.t.sf(sds, left), 1.0)


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
        chosen, usual = noise_words(self.noise), "normal noise of one standard deviation"
        if self.preferred == "unknown":
            return (
                f"Whether {chosen} is preferred to {usual} cannot be said: one of the posteriors "
                "that this rests on did not converge, or gives a row that was left out no density."
            )
        said = {
            "neither": f"The data cannot tell {chosen} from {usual}",
            "chosen": f"The data prefer {chosen} to {usual}",
            "normal": f"The data prefer {usual} to {chosen}",
        }[self.preferred]
        places = 1 if self.se >= 0.1 else 2
        text = (
            f"{said} (elpd by leave-one-out {self.elpd:+.{places}f}, standard error "
            f"{self.se:.{places}f})."
        )
        if self.line and abs(self.elpd) > SMALL:
            text += (
                f" More than half of that is line {self.line} of the file alone, so that the "
                "standard error says little: look at this reading first."
            )
        return text


def noise_words(noise: Noise) -> str:
    """Name a noise in plain words."""
    law = "Student-t noise" if noise.student else "normal noise"
    along = noise.choice.correlated_along
    said = [f"depends on {noise.choice.depends_on}"] * bool(noise.column)
    said += [f"is correlated along {along}"] * bool(along)
    return f"{law} that {' and '.join(said)}" if said else law


def with_usual_noise(problem: Problem) -> Problem:
    """Return a problem with normal noise of one standard deviation, and the same other priors."""
    left_out = problem.noise.choice.parameters
    kept = tuple(p for p in problem.priors.entries if p.name not in left_out)
    return replace(problem, noise=NORMAL, priors=replace(problem.priors, entries=kept, noise=USUAL))


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
    if problem.noise.usual:
        return None
    usual = calibrate(
        with_usual_noise(problem), calibration.seed, label=f"{calibration.label} normal noise",
        estimates=calibration.estimates, settings=settings,
    )  # fmt: skip
    parts = [
        leave_one_out(c, settings=settings, progress=progress, workers=workers)
        if done is None else done
        for c, done in ((calibration, loo), (usual, None))
    ]  # fmt: skip
    rows = [np.full(p.observed.size, np.nan) if p.elpd_rows is None else p.elpd_rows for p in parts]
    if not all(np.isfinite(r).all() for r in rows):
        return NoisePreference(problem.noise, float("nan"), float("nan"), sound=False)
    difference = rows[0] - rows[1]
    sound = all(c.converged for c in (calibration, usual)) and not any(p.unconverged for p in parts)
    se = float(np.sqrt(difference.size * difference.var(ddof=1)))
    elpd, most = float(difference.sum()), int(np.argmax(np.abs(difference)))
    alone = 2.0 * abs(difference[most]) > abs(elpd)
    line = int(problem.table.lines[most]) if alone else 0
    return NoisePreference(problem.noise, elpd, se, sound, line)
