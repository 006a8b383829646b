"""How far each number may move when it is computed again elsewhere, and be the same result.

Numbers that follow from posterior draws may move by their Monte Carlo error, times a factor that
keeps the chance of a false alarm over all of them together small. Everything else is
deterministic and may move by the rounding that an optimiser amplifies; how much is stated here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from calib.calibration import Calibration
from calib.estimators import PointEstimate
from calib.reproduce.montecarlo import Place, posterior_errors, validation_errors
from calib.study import OutputResult

__all__ = [
    "MONTE_CARLO", "Allowance", "count_drawn", "describe", "estimate_allowances",
    "output_allowances", "run_allowances", "run_estimate_allowances",
]  # fmt: skip

MONTE_CARLO = "Monte Carlo error"
# Chance of one false alarm or more in a whole check.
_FAMILY = 1e-3
# Over 24 seeds of the embedded problems, numbers moved by up to 1.4 times what ArviZ expects: the
# walkers of an ensemble are not quite independent chains.
_SAFETY = 1.5

# Deterministic methods end where the rounding of sums lets them; searches by random numbers may
# take another path after one comparison of nearly equal costs.
_SEARCHES = ("genetic", "differential_evolution")
_STRICT_SD, _SEARCH_SD = 0.01, 1.0
_STRICT, _SEARCH, _ALONE = 1e-4, 0.05, 0.01
_STRICT_COST, _SEARCH_COST = 1e-6, 1e-3
_FLOOR = 1e-9
_MODE_SD, _LOG_POSTERIOR = 0.01, 1e-5
# Effective sample sizes of tails differ by up to a factor of four between seeds.
_ACCEPTANCE, _RHAT, _FACTOR, _MCSE_FACTOR = 0.1, 0.01, 10.0, 5.0


@dataclass(frozen=True)
class Allowance:
    """What is taken for the same.

    Parameters
    ----------
    size : float, optional
        Largest difference.
    factor : float, optional
        Largest ratio.
    words : bool
        Text may differ in its numbers.
    why : str
        What this is; with nothing else given, why no difference can be judged.
    """

    size: float | None = None
    factor: float | None = None
    words: bool = False
    why: str = ""


_HEAVY = Allowance(why="tail too heavy for a Monte Carlo error")
_MCSE = Allowance(factor=_MCSE_FACTOR, why=f"a factor of {_MCSE_FACTOR:g}")
_ROWS = Allowance(why="which rows are refitted is decided by their draws")
# Figures about the sampling, by the name of the entry: what matters of them is their size.
_ROUGH: Mapping[str, Allowance] = {
    **dict.fromkeys(
        (
            "ess_bulk",
            "ess_tail",
            "tau",
            "steps",
            "evaluations",
            "efficiency",
            "smallest_ess_bulk",
            "smallest_ess_tail",
            "smallest_steps_over_tau",
        ),
        Allowance(factor=_FACTOR, why=f"a factor of {_FACTOR:g}"),
    ),
    **dict.fromkeys(("rhat", "largest_rhat"), Allowance(_RHAT, why="stated")),
    "acceptance": Allowance(_ACCEPTANCE, why="stated"),
    "log_posterior_at_mode": Allowance(_LOG_POSTERIOR, why="stated"),
    "reasons": Allowance(words=True, why="words"),
    "note": Allowance(words=True, why="words"),
    "refitted": _ROWS,
    "refits_not_converged": _ROWS,
}


def describe(n: int) -> str:
    """Say in words what is allowed to numbers that follow from posterior draws."""
    return (
        f"{_multiple(n):.1f} Monte Carlo errors of a difference (one false alarm in "
        f"{1.0 / _FAMILY:g} checks of {n} such numbers, times {_SAFETY:g})"
    )


def _multiple(n: int) -> float:
    """Return how many standard errors of a difference are allowed where `n` are looked at."""
    return float(_SAFETY * norm.isf(_FAMILY / (2 * max(n, 1))))


def count_drawn(calibration: Calibration, n_validated: int = 0) -> int:
    """Return how many numbers of an output follow from posterior draws, at most.

    Six of each parameter, the evidence; of a validation one for each row, and fourteen scores.
    """
    return 6 * len(calibration.parameters) + 1 + (n_validated + 14 if n_validated else 0)


def output_allowances(
    result: OutputResult, n: int, recorded: Mapping[Place, object], paths: Iterable[Place]
) -> dict[Place, Allowance]:
    """Return the allowances of one output's part of `summary.json`.

    Parameters
    ----------
    result : OutputResult
        Computed again.
    n : int
        How many numbers follow from posterior draws, in the whole report.
    recorded : mapping
        The recorded numbers of the output by path.
    paths : iterable of tuple of str
        Of all entries, recorded or computed again.
    """
    calibration = result.calibration
    times = _multiple(n) * _of_difference(calibration, recorded.get(("sampling", "steps")))
    errors = posterior_errors(calibration)
    errors |= validation_errors(calibration, result.validation, times)
    found = _rough(paths) | _monte_carlo(errors, times)
    for path in paths:
        if path[:2] == ("sampling", "mode"):
            found[path] = _of_scale(calibration, path[-1], _MODE_SD)
        elif path[-1].startswith("mcse_"):
            heavy = errors.get(("posterior", path[1], "sd")) is None
            found[path] = _HEAVY if heavy else _MCSE
    return {
        **found,
        **estimate_allowances(result.estimates, result.by_pressure, calibration),
    }


def run_allowances(
    calibration: Calibration, recorded: Mapping[Place, object], paths: Iterable[Place]
) -> dict[Place, Allowance]:
    """Return the allowances of `run.json` and of the summary of its posterior.

    Parameters
    ----------
    calibration : Calibration
        Computed again.
    recorded, paths
        As for `output_allowances`.
    """
    errors = posterior_errors(calibration)
    errors["log_evidence",] = errors.pop(("sampling", "log_evidence"))
    times = _multiple(count_drawn(calibration))
    times *= _of_difference(calibration, recorded.get(("gate", "steps")))
    found = _rough(paths) | _monte_carlo(errors, times)
    for j, sd in enumerate(calibration.draws.flat.std(axis=0)):
        found["mode", str(j)] = Allowance(_MODE_SD * sd, why=f"{_MODE_SD:g} posterior sd")
    return found


def run_estimate_allowances(recorded: Mapping[Place, object]) -> dict[Place, Allowance]:
    """Return the allowances of the point estimates in `run.json`."""
    return {
        path: _relative(value, _STRICT_COST if path[-1] in ("cost", "rmse") else _ALONE)
        for path, value in recorded.items()
        if isinstance(value, float)
    }


def estimate_allowances(
    estimates: Iterable[PointEstimate],
    by_pressure: Mapping[float, Iterable[PointEstimate]],
    calibration: Calibration | None,
) -> dict[Place, Allowance]:
    """Return the allowances of point estimates, in terms of the posterior where there is one."""
    found: dict[Place, Allowance] = {}
    for e in estimates:
        search = e.method in _SEARCHES
        sds, cost = (_SEARCH_SD, _SEARCH_COST) if search else (_STRICT_SD, _STRICT_COST)
        for name, value in e.reported.items():
            found["estimates", e.method, name] = (
                _relative(value, _SEARCH if search else _ALONE)
                if calibration is None
                else _of_scale(calibration, name, sds)
            )
        spread = e.cost / (1.0 - e.r_squared) if e.r_squared < 1.0 else e.cost
        found |= {
            ("fit", e.method, "cost"): Allowance(cost * e.cost + _FLOOR * spread, why="stated"),
            ("fit", e.method, "rmse"): _relative(e.rmse, max(cost, np.sqrt(_FLOOR))),
            ("fit", e.method, "r_squared"): Allowance(cost, why="stated"),
            ("fit", e.method, "evaluations"): _ROUGH["evaluations"],
            ("fit", e.method, "note"): _ROUGH["note"],
        }
    for psi, alone in by_pressure.items():
        for e in alone:
            relative = _SEARCH if e.method in _SEARCHES else _STRICT
            place = ("by_pressure", f"{psi:g} psi", e.method)
            cost = _SEARCH_COST if e.method in _SEARCHES else _STRICT_COST
            found |= {(*place, name): _relative(v, relative) for name, v in e.reported.items()}
            found[*place, "cost"] = _relative(e.cost, cost)
    return found


def _rough(paths: Iterable[Place]) -> dict[Place, Allowance]:
    names = {path: next((key for key in reversed(path) if key in _ROUGH), "") for path in paths}
    return {path: _ROUGH[name] for path, name in names.items() if name}


def _of_difference(calibration: Calibration, steps: object) -> float:
    """Error of the difference of two runs over that of this one, should the other be shorter."""
    ratio = 1.0
    if isinstance(steps, int | float) and steps > 0:
        ratio = calibration.draws.report.steps / steps
    return float(np.sqrt(1.0 + np.clip(ratio, 1.0, 4.0)))


def _monte_carlo(errors: Mapping[Place, float | None], times: float) -> dict[Place, Allowance]:
    return {
        path: _HEAVY if error is None else Allowance(times * error, why=MONTE_CARLO)
        for path, error in errors.items()
    }


def _of_scale(calibration: Calibration, name: str, sds: float) -> Allowance:
    """A part of the posterior's width: half the distance between its 16 and 84 % quantiles."""
    draws = calibration.parameters.get(name)
    if draws is None:
        return Allowance(0.0, why="fixed")
    low, high = np.quantile(draws, [0.16, 0.84])
    return Allowance(float(sds * 0.5 * (high - low)), why=f"{sds:g} posterior sd")


def _relative(value: object, part: float) -> Allowance:
    size = part * abs(value) if isinstance(value, int | float) else 0.0
    return Allowance(float(size), why=f"{part:.0e} of it")
