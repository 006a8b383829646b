"""The one table of what `calib check` takes for the same.

Every entry of a document has one tolerance, that of the first row whose pattern fits its path. It
follows from what the entry is, never from how others compare; what no row names is arithmetic, and
text, flags and counts must be equal where no row says otherwise. The kinds:

- arithmetic: by sums and closed forms, which processors round otherwise in the last bits.
- optimum: where a deterministic search stopped, off by a small part of a posterior sd.
- random search: one comparison of nearly equal costs that falls the other way sends it elsewhere.
- Monte Carlo: of posterior draws, which may be others (`calib.checking.tolerances.multiple`).
- diagnosis: of evidence and importance sampling with recorded seeds, which rounding moves where a
  draw changes sides of a threshold; a part of its own sd, or of one in probability.
- order of magnitude: how the work went, not what was found.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Any, Literal

import numpy as np
import scipy

from calib.inference.calibration import Calibration
from calib.inference.joint import JointCalibration
from calib.validation.comparison import Comparison
from calib.validation.scores import Sensitivity
from calib.validation.validate import (
    Errors,
    Place,
    Validation,
    held_error,
    least_ess,
    lever_of,
    posterior_errors,
    row_moves,
    validation_errors,
)

MONTE_CARLO = "Monte Carlo"

_FAMILY = 1e-3  # chance of one false alarm or more in a whole check
_SAFETY = 1.5  # walkers are not quite chains: numbers move by up to 1.4 times what ArviZ expects


def multiple(n: int) -> float:
    """Return how many standard errors of a difference are allowed where `n` are looked at.

    One check in a thousand finds a difference where there is none: seven of some hundred numbers.
    """
    return float(_SAFETY * scipy.stats.norm.isf(_FAMILY / (2 * max(n, 1))))


def describe(n: int) -> str:
    """Say in words what is allowed to `n` numbers that follow from posterior draws."""
    chance = f"one false alarm in {1.0 / _FAMILY:g} checks of {n} such numbers"
    return f"{multiple(n):.1f} Monte Carlo errors of a difference ({chance}, times {_SAFETY:g})"


def drawn_in_output(calibration: Calibration, validation: Validation, n: int, steps: Any) -> Errors:
    """Return what Monte Carlo error allows to an output of a report with n drawn numbers in all.

    `steps` is the recorded length of the other run.
    """
    times = multiple(n) * _of_difference(calibration, steps)
    scores = validation_errors(calibration, validation, times)
    return _scaled(posterior_errors(calibration) | scores, times)


def drawn_in_run(calibration: Calibration, n: int, steps: Any) -> Errors:
    """Return the same for a run, and the posterior sds that its mode is judged by."""
    errors = posterior_errors(calibration)
    errors["log_evidence",] = errors.pop(("sampling", "log_evidence"))
    sds = enumerate(calibration.draws.flat.std(axis=0).tolist())
    scaled = _scaled(errors, multiple(n) * _of_difference(calibration, steps))
    return scaled | {("mode", str(j)): sd for j, sd in sds}


def drawn_in_joint(calibration: JointCalibration, n: int, steps: Any) -> Errors:
    """Return the same for a joint calibration, whose evidence is not worked out."""
    times = multiple(n) * _of_difference(calibration, steps)
    return _scaled(posterior_errors(calibration), times)


def drawn_in_comparison(comparison: Comparison, n: int, steps: Mapping[str, Any]) -> Errors:
    """Return the same for a comparison, by paths below ``models``; `steps` are by model.

    Differences are from the first model.
    """
    best = comparison.candidates[0]
    found: Errors = {}
    best_moves = row_moves(best.calibration)
    for c in comparison.candidates:
        times = multiple(n) * _of_difference(c.calibration, steps.get(c.model))
        moves = row_moves(c.calibration)
        lever = lever_of(best.rows - c.rows)
        # Draws of the row of the fewest are worth so many times less.
        heavy = np.sqrt(1.0 + least_ess(c.calibration) * np.square(moves).mean(axis=0).max())
        errors: Errors = {
            **_stated(validation_errors(c.calibration, c.loo, times), float(heavy)),
            ("below_best",): float(np.hypot(moves.sum(axis=1).std(), best_moves.sum(axis=1).std())),
            ("below_best_se",): float(np.hypot((moves @ lever).std(), (best_moves @ lever).std())),
            ("log_evidence",): posterior_errors(c.calibration)["sampling", "log_evidence"],
            **{("elpd_rows", str(i)): float(sd) for i, sd in enumerate(moves.std(axis=0))},
        }
        if c.held is not None:
            held = _stated(validation_errors(c.calibration, c.held, times), 1.0)
            held["elpd",] = held_error(c.calibration, c.held)
            errors |= {("held_out", *place): size for place, size in held.items()}
        found |= {(c.model, *place): size for place, size in _scaled(errors, times).items()}
    return found


def _of_difference(calibration: Calibration | JointCalibration, steps: Any) -> float:
    """Error of the difference of two runs over that of this one, should the other be shorter."""
    known = isinstance(steps, int | float) and steps > 0
    ratio = calibration.draws.report.steps / steps if known else 1.0
    return float(np.sqrt(1.0 + np.clip(ratio, 1.0, 4.0)))


def _scaled(errors: Mapping[Place, float | None], times: float) -> Errors:
    return {place: None if error is None else times * error for place, error in errors.items()}


def _stated(errors: Mapping[Place, float], heavy: float) -> Errors:
    """Those of a validation's errors that a comparison states, as it names them."""
    times = {"elpd": 1.0, "elpd_se": 1.0, "rmse": heavy, "crps": heavy}
    found: Errors = {
        (name,): by * errors["validation", name]
        for name, by in times.items()
        if ("validation", name) in errors
    }
    return found | {("coverage_90",): errors["validation", "coverage", "90"]}


ORDER_OF_MAGNITUDE = "order of magnitude"

type Entries = Mapping[Place, Any]
type Of = Literal[
    "itself", "one", "posterior sd", "Monte Carlo error", "sd beside it", "width of its interval",
    "ratio", "what is left unexplained", "what is left to one",
]  # fmt: skip


@dataclass(frozen=True)
class Tolerance:
    """The tolerance of one kind of entry; the module's docstring names the kinds.

    At most a `part` of the natural scale that it is `of`, and a `floor` in the entry's own unit.
    Text may differ in its numbers if `words`; more is called a difference if `judged`.
    """

    kind: str
    part: float = 0.0
    of: Of = "itself"
    floor: float = 0.0
    words: bool = False
    judged: bool = True


ARITHMETIC = Tolerance("arithmetic", 1e-6)
_DRAWN = Tolerance(MONTE_CARLO, 1.0, "Monte Carlo error")
_WORDS = Tolerance("words", words=True, judged=False)
_EITHER = Tolerance("beside a threshold, or one of several nearly equal modes", judged=False)
_READ_OFF = Tolerance("read off numbers against thresholds")


def _chance(part: float) -> Tolerance:
    return Tolerance("diagnosis", part, "one")


_M, _GAP = "summary.json/models/*", "summary.json/paper_gaps/*"
_OF_GAP = "(gaps/*/|)"  # in a report, or a folder of its own
_FOUND = f"{_OF_GAP}diagnosis.json"
_SEARCHES = "(genetic|differential_evolution)"
_PARAMETERS = f"({_GAP}|{_FOUND}/effects/*)/parameters/*"
_COMPARED = "comparison.json/models/*"

# Pattern: parts of a path, * for any; the file first. (a|b) stands for either.
TABLE: tuple[tuple[str, Tolerance], ...] = (
    # How the work went. Of a posterior with many steps, some are kept: as many as there are steps.
    (f"({_M}/fit/*/evaluations|{_M}/sampling/gate/smallest_*|(run|joint).json/shape/*|"
     f"({_M}/posterior/*|(run|joint).json/gate)/(ess_bulk|ess_tail)(|/*)|"
     f"({_M}/sampling|(run|joint).json|(run|joint).json/gate)/(steps|tau|evaluations|efficiency)(|/*))",
     Tolerance(ORDER_OF_MAGNITUDE, 10.0, "ratio")),
    (f"{_M}/posterior/*/mcse_*", Tolerance(ORDER_OF_MAGNITUDE, 5.0, "ratio")),
    (f"({_M}/posterior/*/rhat|{_M}/sampling/gate/largest_rhat|(run|joint).json/gate/rhat/*)",
     Tolerance(ORDER_OF_MAGNITUDE, 0.01, "one")),
    (f"({_M}/sampling|(run|joint).json)/acceptance", Tolerance(ORDER_OF_MAGNITUDE, 0.1, "one")),
    (f"({_M}/fit/*/note|audit.json/findings/*/evidence)", Tolerance("words", words=True)),
    # Some from the mode, which stops a little elsewhere.
    (f"(({_M}/sampling|(run|joint).json/gate)/reasons|{_M}/warnings|{_M}/noise/against_normal/sentence)"
     "(|/*)", _WORDS),
    # A case that is kept has the names of its own files.
    (f"{_FOUND}/warnings/*", _WORDS),
    # Point estimates
    (f"{_M}/estimates/{_SEARCHES}/*", Tolerance("random search", 1.0, "posterior sd")),
    (f"({_M}/(estimates/*|sampling/mode)|(run|joint).json/(estimates/*/reported|mode))/*",
     Tolerance("optimum", 0.005, "posterior sd")),
    (f"{_M}/(fit|by_pressure/*)/{_SEARCHES}/(cost|rmse|r_squared)",
     Tolerance("random search", 1e-3)),
    (f"{_M}/fit/*/(cost|rmse)", Tolerance("arithmetic", 1e-6, "what is left unexplained")),
    (f"({_M}/by_pressure/*|(run|joint).json/estimates)/*/(cost|rmse)",
     Tolerance("arithmetic", 1e-6, floor=1e-12)),
    (f"{_M}/by_pressure/*/{_SEARCHES}/*", Tolerance("random search", 0.05)),
    (f"{_M}/by_pressure/*/*/*", Tolerance("optimum", 1e-4)),
    ("(run|joint).json/estimates/*/theta/*", Tolerance("optimum", 0.01, floor=1e-6)),
    (f"{_M}/sampling/log_posterior_at_mode", Tolerance("optimum", 1e-5, "one")),
    # What is drawn from posteriors
    (f"({_M}|(run|joint).json)/(posterior/*/(mean|sd|median|hdi_lower|hdi_upper|posterior_to_prior_sd)|"
     "(sampling/|)log_evidence)", _DRAWN),
    (f"{_M}/validation/(rmse|crps|max_relative_error|elpd|elpd_se|n_relative_error_above_6_percent|"
     "(pit|coverage|coverage_interval)/*)", _DRAWN),
    (f"{_COMPARED}/(elpd|elpd_rows/*|elpd_se|below_best|below_best_se|rmse|crps|coverage_90|"
     "log_evidence)", _DRAWN),
    # Fitted to the 190 largest of 4000 weights, k has an sd of (1 + k)/sqrt(190), which is 0.1.
    (f"({_M}/validation/largest_pareto_k|{_COMPARED}/pareto_k_max)",
     Tolerance(MONTE_CARLO, 1.0, "one")),
    # Three seeds moved the sum of 24 rows by 0.08, and by half of it where one row was far off.
    (f"{_M}/noise/against_normal/(elpd_difference|se)", Tolerance(MONTE_CARLO, 0.7, floor=1.0)),
    # Eight seeds moved it by no more than half of this.
    (f"{_M}/prior_sensitivity/parameters/*/(prior|likelihood)",
     Tolerance(MONTE_CARLO, 1.0, floor=0.04)),
    (f"{_M}/prior_sensitivity/parameters/*/contraction",
     Tolerance(MONTE_CARLO, 0.7, "what is left to one")),
    (f"{_M}/prior_sensitivity/parameters/*/(identified|reading)", _READ_OFF),
    # What is read off differences of models is held against their rows (check_comparison); of two
    # models much alike either may take all the weight.
    (f"({_M}/(validation/(refitted|refits_not_converged)|noise/against_normal/preferred)(|/*)|"
     f"comparison.json/verdict|{_COMPARED}/verdict/*|"
     f"{_COMPARED}/(weight|told_apart|refitted_rows|refits_not_converged)|"
     f"{_FOUND}/(regions|next_measurement|remainder/where)*|audit.json/findings/genetic_joint/"
     "found*)", _EITHER),
    # Gaps: of 1200 draws, with seven Monte Carlo errors of a difference (of an end of a 90 % band
    # 0.2 of its width, of a gap 0.3 of its sd). Eight seeds moved probabilities by up to 0.025.
    (f"({_GAP}/(variants/*/probability/*|checks/*/probability*)|({_GAP}|{_FOUND})/shrink/*/"
     "fraction)", _chance(0.1)),
    (f"{_GAP}/variants/*", _EITHER),
    # Ends are quantiles over all hypotheses: 0.01 more of those that explain much less moves the
    # lower end by 0.05 (eight seeds: up to 0.11). A share is of 800 draws; its sd is up to 0.35.
    (f"(({_GAP}|{_FOUND})/shrink/*/interval|{_FOUND}/(inclusion/*|remainder)/share_interval)/*",
     _chance(0.25)),
    (f"{_FOUND}/(inclusion/*|remainder)/share", _chance(0.12)),
    (f"(({_GAP}|{_FOUND})/shrink/*/*|{_PARAMETERS}/sd)", Tolerance("diagnosis", 0.1)),
    (f"{_GAP}/checks/*/in_90_band", _chance(1.0)),
    (f"{_GAP}/checks/*/*", Tolerance("diagnosis", 0.2)),
    (f"({_GAP}/probability/*|{_FOUND}/(effects/*|inclusion/*|remainder)/probability)",
     _chance(0.05)),
    (f"{_GAP}/open_sd_rms", Tolerance("diagnosis", 0.05)),
    (f"{_PARAMETERS}/mean", Tolerance("diagnosis", 0.1, "sd beside it")),
    (f"{_FOUND}/where/*/gap", Tolerance("diagnosis", 0.3, "sd beside it")),
    (f"{_FOUND}/where/*/gap_sd", Tolerance("diagnosis", 0.25)),
    (f"{_FOUND}/where/*/probability", _chance(0.15)),
    (f"{_OF_GAP}fresh_prediction.csv/*/*_(before|after|after_lower|after_upper)",
     Tolerance("diagnosis", 0.2, "width of its interval")),
    # A hundredth of a posterior sd, of coordinates of the order of one.
    (f"{_OF_GAP}corrected.json/lab_mode/*/*", Tolerance("optimum", 1e-3, floor=1e-3)),
    # The audit: least costs of searches from many starts; two findings rest on posterior draws.
    ("audit.json/findings/(table6_likelihood|table6_prediction_at_30)/found/*",
     Tolerance(MONTE_CARLO, 0.15, "width of its interval")),
    ("audit.json/findings/*/found/*", Tolerance("random search", 1e-3)),
)  # fmt: skip


def tolerance_of(place: Place, entries: Entries) -> Tolerance:
    """Return the tolerance of an entry, by its path, the file first, among all of its document."""
    found = _row("/".join(place))
    if found is _READ_OFF:
        return _EITHER if _near_threshold(place, entries) else ARITHMETIC
    # A hypothesis as improbable may be at another mode.
    improbable = 0.2
    if found.of == "sd beside it" and "effects" in place:
        hypothesis = place[: place.index("effects") + 2]
        if (entries.get((*hypothesis, "probability")) or 0.0) < improbable:
            return replace(found, judged=False)
    if place[-2:-1] == ("share_interval",):
        # An end is nothing or not where a twentieth of the draws that have a gap hangs on it.
        p = entries.get((*place[:-2], "probability")) or 0.0
        if p < improbable if place[-1] == "1" else 0.9 < p < 0.99:
            return replace(found, judged=False)
    return found


def is_drawn(place: Place) -> bool:
    """Whether an entry has a Monte Carlo error of its own."""
    return _row("/".join(place)) is _DRAWN


def _near_threshold(place: Place, entries: Entries) -> bool:
    """Whether numbers that a reading is read off turn it when they move a little."""
    ends = []
    for name in ("prior", "likelihood", "contraction"):
        at = (*place[:-1], name)
        value, row = entries.get(at), _row("/".join(at))
        if not isinstance(value, float):
            return True
        # Other seeds moved it by no more than half of its tolerance.
        size = 0.5 * (allowed_difference(row, at, value, entries, {}) or 0.0)
        ends.append((value - size, value + size))
    moved = (Sensitivity("", *numbers) for numbers in product(*ends))
    return len({(s.identified, s.reading) for s in moved}) > 1


@cache
def _row(path: str) -> Tolerance:
    return next((t for pattern, t in TABLE if compiled(pattern).fullmatch(path)), ARITHMETIC)


@cache
def compiled(pattern: str) -> re.Pattern[str]:
    """Return the regular expression of a row's pattern."""
    signs = {"*": ".*", "(": "(?:", ")": ")", "|": "|"}
    return re.compile("".join(signs.get(c, re.escape(c)) for c in pattern))


def allowed_difference(
    tolerance: Tolerance, place: Place, old: Any, entries: Entries, errors: Errors
) -> float | None:
    """Return the largest difference that is taken for the same; None where none can be stated.

    Of a number that was `old`, by its path among `entries` computed again; `errors` is what Monte
    Carlo error allows, by paths.
    """
    *above, last = place
    new = entries[place]
    size, scale = abs(new), None
    if tolerance == ARITHMETIC and isinstance(new, int):
        return 0.0  # a count, or a seed
    match tolerance.of:
        case "itself":
            scale = size
        case "one":
            scale = 1.0
        case "Monte Carlo error":
            scale = errors.get(place, 0.0)
        case "what is left to one":
            scale = 1.0 - size
        case "what is left unexplained":
            scale = size / max(1.0 - (entries.get((*above, "r_squared")) or 0.0), 1e-9)
        case "ratio" if last.startswith("mcse_") and errors.get((*above, "sd"), 0.0) is None:
            return None
        case "ratio":
            return float((tolerance.part - 1.0) * min(abs(old), size))
        case "posterior sd":
            scale = _posterior_sd(place, entries, errors) or size
        case "sd beside it":
            scale = entries.get((*above, {"mean": "sd", "gap": "gap_sd"}[last]))
        case "width of its interval":
            band = re.fullmatch(r"(.*)_(before|after|after_lower|after_upper)", last)
            scale = _width((*above, f"{band[1]}_after_" if band else ""), entries)
    return None if scale is None else tolerance.part * scale + tolerance.floor


def _posterior_sd(place: Place, entries: Entries, errors: Errors) -> float:
    """A quarter of the 95 % interval of the parameter, from the posterior in the same document."""
    if place in errors:
        return errors[place] or 0.0
    ends = ((*place[:i], "posterior", place[-1], "hdi_") for i in range(len(place) - 1, 0, -1))
    return next((0.25 * width for width in (_width(e, entries) for e in ends) if width), 0.0)


def _width(ends: Place, entries: Entries) -> float | None:
    """Width of an interval, by the path of both ends without lower or upper."""
    low, high = (entries.get((*ends[:-1], f"{ends[-1]}{end}")) for end in ("lower", "upper"))
    if isinstance(low, int | float) and isinstance(high, int | float):
        return float(abs(high - low))
    return None
