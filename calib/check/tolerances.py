"""What is taken for the same: one table.

Every entry of a document has one tolerance, that of the first row whose pattern fits its path. It
follows from what the entry is, never from how others compare; what no row names is arithmetic, and
text, flags and counts must be equal where no row says otherwise.

arithmetic
    follows by sums and closed forms, which processors round otherwise in the last bits.
optimum
    where a deterministic search stopped: off by its stopping rule, a small part of a posterior sd.
random search
    one comparison of nearly equal costs that falls the other way sends it along another path.
Monte Carlo
    follows from posterior draws, which may be others (`calib.check.montecarlo.multiple`).
diagnosis
    follows from evidence and importance sampling with recorded seeds: rounding moves it only where
    a draw changes sides of a threshold; a part of its own sd, or of one in probability.
order of magnitude
    tells how the work went, not what was found.
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
_JUMPS = Tolerance("one of several nearly equal modes", judged=False)
_READ_OFF = Tolerance("read off numbers against thresholds")
_SIDES = Tolerance("which side of a threshold a number is on", judged=False)


def _chance(part: float) -> Tolerance:
    return Tolerance("diagnosis", part, Of.ONE)


_M, _GAP, _FOUND = "summary.json/models/*", "summary.json/paper_gaps/*", "gaps/*/diagnosis.json"
_SEARCHES = "(genetic|differential_evolution)"
_PARAMETERS = f"({_GAP}|{_FOUND}/effects/*)/parameters/*"
_COMPARED = "comparison.json/models/*"

# Pattern: parts of a path, * for any; the file first. (a|b) stands for either.
TABLE: tuple[tuple[str, Tolerance], ...] = (
    # How the work went. Of a posterior with many steps, some are kept: as many as there are steps.
    (f"({_M}/fit/*/evaluations|{_M}/sampling/gate/smallest_*|run.json/shape/*|"
     f"({_M}/posterior/*|run.json/gate)/(ess_bulk|ess_tail)(|/*)|"
     f"({_M}/sampling|run.json|run.json/gate)/(steps|tau|evaluations|efficiency)(|/*))",
     Tolerance(ORDER_OF_MAGNITUDE, 10.0, Of.RATIO)),
    (f"{_M}/posterior/*/mcse_*", Tolerance(ORDER_OF_MAGNITUDE, 5.0, Of.RATIO)),
    (f"({_M}/posterior/*/rhat|{_M}/sampling/gate/largest_rhat|run.json/gate/rhat/*)",
     Tolerance(ORDER_OF_MAGNITUDE, 0.01, Of.ONE)),
    (f"({_M}/sampling|run.json)/acceptance", Tolerance(ORDER_OF_MAGNITUDE, 0.1, Of.ONE)),
    (f"({_M}/fit/*/note|audit.json/findings/*/evidence)", Tolerance("words", words=True)),
    # Some from the mode, which stops a little elsewhere.
    (f"(({_M}/sampling|run.json/gate)/reasons|{_M}/warnings|{_M}/noise/against_normal/sentence)"
     "(|/*)", Tolerance("words", words=True, judged=False)),
    # Point estimates
    (f"{_M}/estimates/{_SEARCHES}/*", Tolerance("random search", 1.0, Of.POSTERIOR)),
    (f"({_M}/(estimates/*|sampling/mode)|run.json/(estimates/*/reported|mode))/*",
     Tolerance("optimum", 0.005, Of.POSTERIOR)),
    (f"{_M}/(fit|by_pressure/*)/{_SEARCHES}/(cost|rmse|r_squared)",
     Tolerance("random search", 1e-3)),
    (f"{_M}/fit/*/(cost|rmse)", Tolerance("arithmetic", 1e-6, Of.UNEXPLAINED)),
    (f"{_M}/by_pressure/*/*/cost", ARITHMETIC),
    (f"{_M}/by_pressure/*/{_SEARCHES}/*", Tolerance("random search", 0.05)),
    (f"{_M}/by_pressure/*/*/*", Tolerance("optimum", 1e-4)),
    ("run.json/estimates/*/(cost|rmse)", Tolerance("arithmetic", 1e-6, floor=1e-12)),
    ("run.json/estimates/*/theta/*", Tolerance("optimum", 0.01, floor=1e-6)),
    (f"{_M}/sampling/log_posterior_at_mode", Tolerance("optimum", 1e-5, Of.ONE)),
    # What is drawn from posteriors
    (f"({_M}|run.json)/posterior/*/(mean|sd|median|hdi_lower|hdi_upper|posterior_to_prior_sd)",
     _DRAWN),
    (f"({_M}/sampling|run.json)/log_evidence", _DRAWN),
    (f"{_M}/validation/(rmse|crps|max_relative_error|elpd|elpd_se|n_relative_error_above_6_percent|"
     "(pit|coverage|coverage_interval)/*)", _DRAWN),
    (f"{_COMPARED}/(elpd|elpd_rows/*|elpd_se|below_best|below_best_se|rmse|crps|coverage_90|"
     "log_evidence)", _DRAWN),
    # Fitted to the 190 largest of 4000 weights, k has an sd of (1 + k)/sqrt(190), which is 0.1.
    (f"({_M}/validation/largest_pareto_k|{_COMPARED}/pareto_k_max)",
     Tolerance(MONTE_CARLO, 1.0, Of.ONE)),
    # Smoothed importance sampling of two posteriors: three seeds moved the sum of 24 rows by 0.08,
    # and by half of it where it was that of one row off by a hundred times.
    (f"{_M}/noise/against_normal/(elpd_difference|se)", Tolerance(MONTE_CARLO, 0.7, floor=1.0)),
    # Eight seeds moved it by no more than half of this.
    (f"{_M}/prior_sensitivity/parameters/*/(prior|likelihood)",
     Tolerance(MONTE_CARLO, 1.0, floor=0.04)),
    (f"{_M}/prior_sensitivity/parameters/*/contraction", Tolerance(MONTE_CARLO, 0.7, Of.REST)),
    (f"{_M}/prior_sensitivity/parameters/*/(identified|reading)", _READ_OFF),
    # What is read off differences of models is held against their rows (check_comparison); of two
    # models much alike either may take all the weight.
    (f"({_M}/(validation/(refitted|refits_not_converged)|noise/against_normal/preferred)|"
     f"comparison.json/verdict|{_COMPARED}/(told_apart|refitted_rows|refits_not_converged))"
     "(|/*)", _SIDES),
    (f"({_COMPARED}/weight|{_FOUND}/(regions|next_measurement|remainder/where)*|"
     "audit.json/findings/genetic_joint/found*)", _JUMPS),
    # Gaps. What is drawn there rests on 1200 draws, and has seven Monte Carlo errors of a
    # difference: of an end of a 90 % band 0.2 of its width, of a gap 0.3 of its sd. Eight seeds
    # moved probabilities by 0.025 at the most, rounding by 0.002.
    (f"({_GAP}/(variants/*/probability/*|checks/*/probability*)|({_GAP}|{_FOUND})/shrink/*/"
     "fraction)", _chance(0.1)),
    (f"{_GAP}/variants/*", _JUMPS),
    # Ends are quantiles over all hypotheses. Where a few per cent of probability belong to those
    # that explain much less, 0.01 more of it moves the lower end by 0.05 (eight seeds: by 0.11 at
    # the most). A share is one of 800 draws; its sd is 0.35 at the most.
    (f"(({_GAP}|{_FOUND})/shrink/*/interval|{_FOUND}/(inclusion/*|remainder)/share_interval)/*",
     _chance(0.25)),
    (f"{_FOUND}/(inclusion/*|remainder)/share", _chance(0.12)),
    (f"({_GAP}|{_FOUND})/shrink/*/*", Tolerance("diagnosis", 0.1)),
    (f"{_GAP}/checks/*/in_90_band", _chance(1.0)),
    (f"{_GAP}/checks/*/*", Tolerance("diagnosis", 0.2)),
    (f"({_GAP}/probability/*|{_FOUND}/(effects/*|inclusion/*|remainder)/probability)",
     _chance(0.05)),
    (f"{_GAP}/open_sd_rms", Tolerance("diagnosis", 0.05)),
    (f"{_PARAMETERS}/mean", Tolerance("diagnosis", 0.1, Of.ITS_SD)),
    (f"{_PARAMETERS}/sd", Tolerance("diagnosis", 0.1)),
    (f"{_FOUND}/where/*/gap", Tolerance("diagnosis", 0.3, Of.ITS_SD)),
    (f"{_FOUND}/where/*/gap_sd", Tolerance("diagnosis", 0.25)),
    (f"{_FOUND}/where/*/probability", _chance(0.15)),
    ("gaps/*/fresh_prediction.csv/*/*_(before|after|after_lower|after_upper)",
     Tolerance("diagnosis", 0.2, Of.BAND)),
    # A hundredth of a posterior sd, of coordinates of the order of one.
    ("gaps/*/corrected.json/lab_mode/*/*", Tolerance("optimum", 1e-3, floor=1e-3)),
    # The audit: least costs of searches from many starts; two findings rest on posterior draws.
    ("audit.json/findings/(table6_likelihood|table6_prediction_at_30)/found/*",
     Tolerance(MONTE_CARLO, 0.15, Of.INTERVAL)),
    ("audit.json/findings/*/found/*", Tolerance("random search", 1e-3)),
)  # fmt: skip

# Parameters of hypotheses less probable than this are not judged: they may be at another mode.
_COUNTS = 0.2


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


def is_drawn(place: Place) -> bool:
    """Whether an entry has a Monte Carlo error of its own."""
    return _row("/".join(place)) is _DRAWN


def _near_threshold(place: Place, entries: Entries) -> bool:
    """Whether a number that a reading is read off is near its threshold."""
    for name, threshold in (
        ("contraction", "contraction_at_least"),
        ("prior", "power_scaling_threshold"),
        ("likelihood", "power_scaling_threshold"),
    ):
        at = (*place[:-1], name)
        value, limit = entries.get(at), entries.get((*place[:-3], "criteria", threshold))
        if not isinstance(value, float) or not isinstance(limit, float):
            return True
        row = _row("/".join(at))
        # Other seeds moved it by no more than half of its tolerance.
        scale = natural_scale(row.of, at, entries, {}) or 0.0
        if abs(value - limit) <= 0.5 * (row.part * scale + row.floor):
            return True
    return False


@cache
def _row(path: str) -> Tolerance:
    return next((t for pattern, t in _PATTERNS if pattern.fullmatch(path)), ARITHMETIC)


_SIGNS = {"*": ".*", "(": "(?:", ")": ")", "|": "|"}
_PATTERNS = tuple(
    (re.compile("".join(_SIGNS.get(c, re.escape(c)) for c in pattern)), tolerance)
    for pattern, tolerance in TABLE
)


def natural_scale(
    of: Of, place: Place, entries: Entries, errors: Mapping[Place, float | None]
) -> float | None:
    """Return the natural scale of a number, by its path among entries computed again, or None.

    `errors` is what Monte Carlo error allows, by paths; None where a tail is too heavy for one.
    """
    *above, last = place
    value = entries.get(place)
    size = abs(value) if isinstance(value, int | float) else 0.0
    match of:
        case Of.ONE:
            return 1.0
        case Of.ERROR:
            return errors.get(place, 0.0)
        case Of.REST:
            return 1.0 - size
        case Of.UNEXPLAINED:
            return size / max(1.0 - (entries.get((*above, "r_squared")) or 0.0), 1e-9)
        case Of.RATIO if last.startswith("mcse_") and errors.get((*above, "sd"), 0.0) is None:
            return None
        case Of.POSTERIOR:
            return _posterior_sd(place, entries, errors) or size
        case Of.ITS_SD:
            return entries.get((*above, {"mean": "sd", "gap": "gap_sd"}[last]))
        case Of.BAND:
            stem = re.sub(r"_(before|after|after_lower|after_upper)$", "_after_", last)
            return _between((*above, stem), entries)
        case Of.INTERVAL:
            return _between((*above, ""), entries)
    return size


def _posterior_sd(place: Place, entries: Entries, errors: Mapping[Place, float | None]) -> float:
    """A quarter of the 95 % interval of the parameter, from the posterior in the same document."""
    if place in errors:
        return errors[place] or 0.0
    for end in range(len(place) - 1, 0, -1):
        ends = (*place[:end], "posterior", place[-1], "hdi_")
        if (*ends[:-1], "hdi_lower") in entries:
            return 0.25 * (_between(ends, entries) or 0.0)
    return 0.0


def _between(ends: Place, entries: Entries) -> float | None:
    """Width of an interval, by the path of both ends without lower or upper."""
    low, high = (entries.get((*ends[:-1], f"{ends[-1]}{end}")) for end in ("lower", "upper"))
    if isinstance(low, int | float) and isinstance(high, int | float):
        return float(abs(high - low))
    return None
