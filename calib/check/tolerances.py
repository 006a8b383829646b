"""What is taken for the same: one table.

Every entry of a document has one tolerance, that of the first row whose pattern fits its path, and
it follows from what the entry is, never from how other entries compare:

arithmetic
    follows from data and priors by sums and closed forms. Processors round these otherwise in the
    last bits, and conditioning amplifies that to a millionth of the number at the most.
optimum
    where a deterministic search stopped: it is as far off the optimum as its stopping rule allows,
    which is a small part of the posterior's sd (or of the cost, where the optimum is flat).
random search
    one comparison of nearly equal costs that falls the other way sends it along another path.
Monte Carlo
    follows from posterior draws, which may be others altogether: seven standard errors of a
    difference (`calib.check.montecarlo.multiple` says why seven).
diagnosis
    follows from Laplace's evidence and importance sampling with recorded seeds. Rounding moves it
    only where a draw changes sides of a threshold; a part of its own sd, or of one in probability.
order of magnitude
    tells how the work went, not what was found.

What no row names is arithmetic; text, flags and counts must be equal where no row says otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from typing import Any

from calib.check.montecarlo import MONTE_CARLO, Place

ORDER_OF_MAGNITUDE = "order of magnitude"

type Entries = Mapping[Place, Any]


class Of(StrEnum):
    """The natural scale that a tolerance is a part of."""

    ITSELF = "of it"
    ONE = ""
    POSTERIOR = "posterior sd"
    ERROR = "Monte Carlo errors"
    ITS_SD = "of the sd beside it"
    BAND = "of its band's width"
    INTERVAL = "of its interval's width"
    RATIO = "times smaller or larger"
    UNEXPLAINED = "of it over what is left unexplained"
    REST = "of what it leaves to one"


@dataclass(frozen=True)
class Tolerance:
    """What is taken for the same, of entries of a kind that the module's docstring names.

    Parameters
    ----------
    part : float
        Largest difference in units of the natural scale.
    floor : float
        Added to it, in the entry's own unit.
    words : bool
        Text, which may differ in its numbers.
    judged : bool
        Whether a difference beyond it is called one; if not, it is listed as not judged.
    """

    kind: str
    part: float = 0.0
    of: Of = Of.ITSELF
    floor: float = 0.0
    words: bool = False
    judged: bool = True


ARITHMETIC = Tolerance("arithmetic", 1e-6)
_DRAWN = Tolerance(MONTE_CARLO, 1.0, Of.ERROR)
_OPTIMUM = Tolerance("optimum", 0.005, Of.POSTERIOR)
_SEARCH = Tolerance("random search", 1.0, Of.POSTERIOR)
_ROUGHLY = Tolerance(ORDER_OF_MAGNITUDE, 10.0, Of.RATIO)
_WORDS = Tolerance("words", words=True)
_JUMPS = Tolerance("one of several nearly equal modes", judged=False)
_READ_OFF = Tolerance("read off numbers against thresholds")
_SIDES = Tolerance("which side of a threshold a number is on", judged=False)


def _chance(part: float) -> Tolerance:
    return Tolerance("diagnosis", part, Of.ONE)


# Pattern: parts of a path, * for any; the file first. {a,b} stands for either.
TABLE: tuple[tuple[str, Tolerance], ...] = (
    # Point estimates
    ("summary.json/models/*/estimates/{genetic,differential_evolution}/*", _SEARCH),
    ("summary.json/models/*/estimates/*/*", _OPTIMUM),
    ("summary.json/models/*/fit/*/evaluations", _ROUGHLY),
    ("summary.json/models/*/fit/*/note", _WORDS),
    ("summary.json/models/*/fit/{genetic,differential_evolution}/{cost,rmse,r_squared}",
     Tolerance("random search", 1e-3)),
    ("summary.json/models/*/fit/*/{cost,rmse}", Tolerance("arithmetic", 1e-6, Of.UNEXPLAINED)),
    ("summary.json/models/*/by_pressure/*/{genetic,differential_evolution}/cost",
     Tolerance("random search", 1e-3)),
    ("summary.json/models/*/by_pressure/*/*/cost", ARITHMETIC),
    ("summary.json/models/*/by_pressure/*/{genetic,differential_evolution}/*",
     Tolerance("random search", 0.05)),
    ("summary.json/models/*/by_pressure/*/*/*", Tolerance("optimum", 1e-4)),
    ("run.json/estimates/*/{cost,rmse}", Tolerance("arithmetic", 1e-6, floor=1e-12)),
    ("run.json/estimates/*/reported/*", _OPTIMUM),
    ("run.json/estimates/*/theta/*", Tolerance("optimum", 0.01, floor=1e-6)),
    # Posterior, and what is drawn from it
    ("{summary.json/models/*,run.json}/posterior/*/{mean,sd,median,hdi_lower,hdi_upper}", _DRAWN),
    ("summary.json/models/*/posterior/*/posterior_to_prior_sd", _DRAWN),
    ("summary.json/models/*/posterior/*/mcse_*", Tolerance(ORDER_OF_MAGNITUDE, 5.0, Of.RATIO)),
    ("{summary.json/models/*/posterior/*,run.json/gate}/{ess_bulk,ess_tail}{,/*}", _ROUGHLY),
    ("{summary.json/models/*/posterior/*/rhat,summary.json/models/*/sampling/gate/largest_rhat,"
     "run.json/gate/rhat/*}", Tolerance(ORDER_OF_MAGNITUDE, 0.01, Of.ONE)),
    ("{summary.json/models/*/sampling,run.json}/log_evidence", _DRAWN),
    ("{summary.json/models/*/sampling,run.json}/acceptance",
     Tolerance(ORDER_OF_MAGNITUDE, 0.1, Of.ONE)),
    ("{summary.json/models/*/sampling,run.json,run.json/gate}/"
     "{steps,tau,evaluations,efficiency}{,/*}", _ROUGHLY),
    ("summary.json/models/*/sampling/gate/smallest_*", _ROUGHLY),
    ("{summary.json/models/*/sampling,run.json/gate}/reasons{,/*}",
     Tolerance("words", words=True, judged=False)),
    ("{summary.json/models/*/sampling,run.json}/mode/*", _OPTIMUM),
    ("summary.json/models/*/sampling/log_posterior_at_mode", Tolerance("optimum", 1e-5, Of.ONE)),
    # Of a posterior with many steps, some are kept: as many as there are steps.
    ("run.json/shape/*", Tolerance(ORDER_OF_MAGNITUDE, 10.0, Of.RATIO)),
    # Validation
    ("summary.json/models/*/validation/{rmse,crps,max_relative_error,elpd,elpd_se}", _DRAWN),
    ("summary.json/models/*/validation/n_relative_error_above_6_percent", _DRAWN),
    ("summary.json/models/*/validation/{pit,coverage,coverage_interval}/*", _DRAWN),
    # Fitted to the 190 largest of 4000 weights, k has an sd of (1 + k)/sqrt(190), which is 0.1.
    ("summary.json/models/*/validation/largest_pareto_k",
     Tolerance(MONTE_CARLO, 1.0, Of.ONE)),
    ("summary.json/models/*/validation/{refitted,refits_not_converged}{,/*}", _SIDES),
    # From the mode, which stops a little elsewhere.
    ("summary.json/models/*/warnings{,/*}", Tolerance("words", words=True, judged=False)),
    # Smoothed importance sampling of two posteriors: three seeds moved the sum of 24 rows by 0.08,
    # and by half of it where it was that of one row off by a hundred times.
    ("summary.json/models/*/noise/against_normal/{elpd_difference,se}",
     Tolerance(MONTE_CARLO, 0.7, floor=1.0)),
    ("summary.json/models/*/noise/against_normal/preferred", _SIDES),
    ("summary.json/models/*/noise/against_normal/sentence",
     Tolerance("words", words=True, judged=False)),
    # Prior sensitivity: eight seeds moved it by no more than half of this.
    ("summary.json/models/*/prior_sensitivity/parameters/*/{prior,likelihood}",
     Tolerance(MONTE_CARLO, 1.0, floor=0.04)),
    ("summary.json/models/*/prior_sensitivity/parameters/*/contraction",
     Tolerance(MONTE_CARLO, 0.7, Of.REST)),
    ("summary.json/models/*/prior_sensitivity/parameters/*/{identified,reading}", _READ_OFF),
    # Models compared. Weights and what is read off differences are held against the rows that they
    # follow from (check_comparison); of two models much alike either may take all the weight.
    ("comparison.json/models/*/{told_apart,refitted_rows,refits_not_converged}", _SIDES),
    ("comparison.json/verdict", _SIDES),
    ("comparison.json/models/*/weight", _JUMPS),
    ("comparison.json/models/*/pareto_k_max", Tolerance(MONTE_CARLO, 1.0, Of.ONE)),
    ("comparison.json/models/*/{elpd,elpd_rows/*,elpd_se,below_best,below_best_se,rmse,crps,"
     "coverage_90,log_evidence}", _DRAWN),
    # The source's gaps. What is drawn there rests on 1200 draws, and has seven Monte Carlo errors
    # of a difference: of an end of a 90 % band 0.2 of its width, of a gap 0.3 of its sd. Eight
    # seeds moved probabilities by 0.025 at the most, rounding by 0.002.
    ("summary.json/paper_gaps/*/variants/*/probability/*", _chance(0.1)),
    ("summary.json/paper_gaps/*/variants/*", _JUMPS),
    # The ends are quantiles over all hypotheses. Where a few per cent of probability belong to
    # those that explain much less, 0.01 more of it moves the lower end by 0.05 (eight seeds: by
    # 0.11 at the most).
    ("{summary.json/paper_gaps,gaps}/*{,/diagnosis.json}/shrink/*/interval/*", _chance(0.25)),
    ("{summary.json/paper_gaps,gaps}/*{,/diagnosis.json}/shrink/*/fraction", _chance(0.1)),
    ("{summary.json/paper_gaps,gaps}/*{,/diagnosis.json}/shrink/*/*", Tolerance("diagnosis", 0.1)),
    ("summary.json/paper_gaps/*/checks/*/probability*", _chance(0.1)),
    ("summary.json/paper_gaps/*/checks/*/in_90_band", _chance(1.0)),
    ("summary.json/paper_gaps/*/checks/*/*", Tolerance("diagnosis", 0.2)),
    ("summary.json/paper_gaps/*/probability/*", _chance(0.05)),
    ("summary.json/paper_gaps/*/open_sd_rms", Tolerance("diagnosis", 0.05)),
    # A hundredth of a posterior sd, of coordinates of the order of one.
    ("gaps/*/corrected.json/lab_mode/*/*", Tolerance("optimum", 1e-3, floor=1e-3)),
    ("gaps/*/diagnosis.json/effects/*/probability", _chance(0.05)),
    ("gaps/*/diagnosis.json/inclusion/*/probability", _chance(0.05)),
    ("gaps/*/diagnosis.json/remainder/probability", _chance(0.05)),
    # Of 800 draws; the sd of a share is 0.35 at the most.
    ("gaps/*/diagnosis.json/{inclusion/*,remainder}/share", _chance(0.12)),
    ("gaps/*/diagnosis.json/{inclusion/*,remainder}/share_interval/*", _chance(0.25)),
    ("{summary.json/paper_gaps/*/parameters,gaps/*/diagnosis.json/effects/*/parameters}/*/mean",
     Tolerance("diagnosis", 0.1, Of.ITS_SD)),
    ("{summary.json/paper_gaps/*/parameters,gaps/*/diagnosis.json/effects/*/parameters}/*/sd",
     Tolerance("diagnosis", 0.1)),
    ("gaps/*/diagnosis.json/where/*/gap", Tolerance("diagnosis", 0.3, Of.ITS_SD)),
    ("gaps/*/diagnosis.json/where/*/gap_sd", Tolerance("diagnosis", 0.25)),
    ("gaps/*/diagnosis.json/where/*/probability", _chance(0.15)),
    ("gaps/*/diagnosis.json/{regions,next_measurement,remainder/where}*", _JUMPS),
    ("gaps/*/fresh_prediction.csv/*/*_{before,after,after_lower,after_upper}",
     Tolerance("diagnosis", 0.2, Of.BAND)),
    # The audit: least costs of searches from many starts; two findings rest on posterior draws.
    ("audit.json/findings/genetic_joint/found*", _JUMPS),
    ("audit.json/findings/{table6_likelihood,table6_prediction_at_30}/found/*",
     Tolerance(MONTE_CARLO, 0.15, Of.INTERVAL)),
    ("audit.json/findings/*/found/*", Tolerance("random search", 1e-3)),
    ("audit.json/findings/*/evidence", _WORDS),
)  # fmt: skip

# Parameters of hypotheses less probable than this are not judged: they may be at another mode.
_COUNTS = 0.2
_SIBLINGS = {"mean": "sd", "gap": "gap_sd"}


def tolerance_of(place: Place, entries: Entries) -> Tolerance:
    """Return the tolerance of an entry, by its path, the file first, among all of its document."""
    found = _row("/".join(place))
    if found is _READ_OFF:
        return _SIDES if _near_threshold(place, entries) else ARITHMETIC
    if found.of is Of.ITS_SD and "effects" in place:
        hypothesis = place[: place.index("effects") + 2]
        if (entries.get((*hypothesis, "probability")) or 0.0) < _COUNTS:
            return replace(found, judged=False)
    return found


def _near_threshold(place: Place, entries: Entries) -> bool:
    """Whether a number that a reading is read off is near its threshold."""
    criteria = (*place[:-3], "criteria")
    for name, threshold in (
        ("contraction", "contraction_at_least"),
        ("prior", "power_scaling_threshold"),
        ("likelihood", "power_scaling_threshold"),
    ):
        at = (*place[:-1], name)
        value, limit = entries.get(at), entries.get((*criteria, threshold))
        if not isinstance(value, float) or not isinstance(limit, float):
            return True
        row = _row("/".join(at))
        scale = natural_scale(row.of, at, entries, {}) or 0.0
        # Other seeds moved it by no more than half of its tolerance.
        if abs(value - limit) <= 0.5 * (row.part * scale + row.floor):
            return True
    return False


@cache
def _row(path: str) -> Tolerance:
    return next((t for pattern, t in _PATTERNS if pattern.fullmatch(path)), ARITHMETIC)


def _compiled(pattern: str) -> re.Pattern[str]:
    signs = {"*": r".*", "{": "(?:", "}": ")", ",": "|"}
    return re.compile("".join(signs.get(c, re.escape(c)) for c in pattern))


_PATTERNS = tuple((_compiled(pattern), tolerance) for pattern, tolerance in TABLE)


def natural_scale(
    of: Of, place: Place, entries: Entries, errors: Mapping[Place, float | None]
) -> float | None:
    """Return the natural scale of a number, by its path among entries computed again, or None.

    `errors` is what Monte Carlo error allows, by paths; None where a tail is too heavy for one.
    """
    value = entries.get(place)
    size = abs(value) if isinstance(value, int | float) else 0.0
    if of is Of.ONE:
        return 1.0
    if of is Of.ERROR:
        return errors.get(place, 0.0)
    if of is Of.REST:
        return 1.0 - size
    if of is Of.UNEXPLAINED:
        return size / max(1.0 - (entries.get((*place[:-1], "r_squared")) or 0.0), 1e-9)
    if of is Of.RATIO and place[-1].startswith("mcse_"):
        heavy = errors.get((*place[:-1], "sd"), 0.0) is None
        return None if heavy else size
    if of is Of.POSTERIOR:
        return _posterior_sd(place, entries, errors) or size
    if of is Of.ITS_SD:
        return entries.get((*place[:-1], _SIBLINGS[place[-1]]))
    if of is Of.BAND:
        stem = re.sub(r"_(before|after|after_lower|after_upper)$", "_after_", place[-1])
        return _between((*place[:-1], f"{stem}lower"), (*place[:-1], f"{stem}upper"), entries)
    if of is Of.INTERVAL:
        return _between((*place[:-1], "lower"), (*place[:-1], "upper"), entries)
    return size


def _posterior_sd(place: Place, entries: Entries, errors: Mapping[Place, float | None]) -> float:
    """A quarter of the 95 % interval of the parameter, from the posterior in the same document."""
    if place in errors:
        return errors[place] or 0.0
    for end in range(len(place) - 1, 0, -1):
        posterior = (*place[:end], "posterior", place[-1])
        if (*posterior, "hdi_lower") in entries:
            ends = (*posterior, "hdi_lower"), (*posterior, "hdi_upper")
            return 0.25 * (_between(*ends, entries) or 0.0)
    return 0.0


def _between(low: Place, high: Place, entries: Entries) -> float | None:
    a, b = entries.get(low), entries.get(high)
    if isinstance(a, int | float) and isinstance(b, int | float):
        return float(abs(b - a))
    return None
