"""Stated allowances: of figures whose Monte Carlo error is known from repeats with other seeds.

Diagnoses of the source's gaps, the audit and prior sensitivities were repeated with eight seeds,
which moves them more than rounding does: no number that is judged here moved by more than half of
what is allowed. Numbers that may jump, where a search finds one of several nearly equal modes, are
not judged once they differ by more than rounding.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from calib.reproduce.allowances import Allowance
from calib.reproduce.montecarlo import Place
from calib.sensitivity import CONTRACTION_MIN, SENSITIVITY_MIN

__all__ = [
    "audit_allowances", "corrected_allowances", "gap_allowances", "prediction_allowances",
    "sensitivity_allowances",
]  # fmt: skip

type Entries = Mapping[Place, Any]

_WHY = "stated"
_JUMPS = Allowance(why="a search among nearly equal modes may end elsewhere")
_SAME = Allowance(0.0, why="nothing moves it")
_WORDS = Allowance(words=True, why="words")

# Prior sensitivity: a part of the sensitivity and something on top; a part of what is left of the
# prior's variance.
_PARAMETERS = ("prior_sensitivity", "parameters")
_SENSITIVITY, _SENSITIVITY_FLOOR, _LEFT = 1.0, 0.04, 0.7

# Gaps: probabilities, and those of a question asked otherwise; parameters of the best hypothesis.
_PROBABILITY, _VARIANT = 0.05, 0.4
_PARAMETER, _PARAMETER_FLOOR = 0.02, 1e-6
_SHRINK, _ERROR, _CHECK, _OPEN = 0.25, 2.0, 0.8, 0.2
_GAP, _GAP_SD, _WHERE, _ROWS = 3.0, 2.0, 0.3, 3.0
_BAND, _TABLE = 0.25, 1e-9

# Audit: least costs of multi-start searches; posterior and simulated figures, as parts of their
# intervals. Final costs of genetic searches in bad coordinates are anywhere.
_COST, _INTERVAL = 1e-3, 0.15
_SEARCHED, _DRAWN = "genetic_joint", ("table6_likelihood", "table6_prediction_at_30")


def sensitivity_allowances(found: Entries) -> dict[Place, Allowance]:
    """Return the allowances of ``prior_sensitivity`` of an output, computed again as `found`."""
    rules: dict[Place, Allowance] = {}
    for path, value in found.items():
        if path[:2] != _PARAMETERS or not isinstance(value, float):
            continue
        if path[-1] in ("prior", "likelihood"):
            rules[path] = Allowance(_SENSITIVITY * value + _SENSITIVITY_FLOOR, why=_WHY)
        elif path[-1] == "contraction":
            rules[path] = Allowance(_LEFT * (1.0 - value), why=_WHY)
    for path in found:
        if path[:2] == _PARAMETERS and path not in rules:
            rules[path] = _of_thresholds(path[:-1], found, rules)
    return rules


def _of_thresholds(place: Place, found: Entries, rules: Mapping[Place, Allowance]) -> Allowance:
    """What is read off numbers stays where none of them is near its threshold."""
    for name, threshold in (
        ("contraction", CONTRACTION_MIN),
        ("prior", SENSITIVITY_MIN),
        ("likelihood", SENSITIVITY_MIN),
    ):
        value = found.get((*place, name))
        # Repeats moved it by no more than half of what is allowed.
        if value is None or abs(value - threshold) <= 0.5 * (rules[*place, name].size or 0.0):
            return Allowance(why="a number that it is read off is near its threshold")
    return Allowance(0.0, why=_WHY)


def gap_allowances(entries: Entries, best: str) -> dict[Place, Allowance]:
    """Return the allowances of a gap, in ``summary.json`` or in its ``diagnosis.json``.

    Parameters
    ----------
    entries : mapping
        Computed again.
    best : str
        The most probable hypothesis.
    """
    found = {path: _gap_rule(path, value, best, entries) for path, value in entries.items()}
    return {path: rule for path, rule in found.items() if rule is not None}


def _gap_rule(path: Place, value: Any, best: str, entries: Entries) -> Allowance | None:
    top, last = path[0], path[-1]
    if top in ("regions", "next_measurement") or "interval" in path:
        return _JUMPS
    if top == "variants":
        return Allowance(_VARIANT, why=_WHY) if path[2] == "probability" else _JUMPS
    if top == "probability" or path[:1] + path[2:] == ("effects", "probability"):
        return Allowance(_PROBABILITY, why=_WHY)
    if top == "effects" and path[1] != best:
        return _JUMPS
    if not isinstance(value, int | float):
        return None
    if top in ("parameters", "effects"):
        return Allowance(_PARAMETER * abs(value) + _PARAMETER_FLOOR, why=_WHY)
    if top == "shrink":
        absolute = last == "fraction"
        return Allowance(_SHRINK if absolute else _ERROR * abs(value), why=_WHY)
    if top == "checks":
        # These are of the question asked otherwise, and name what is found there.
        return _JUMPS if path[1].startswith("field_begins") else _check_rule(last, value)
    if top == "where":
        return _where_rule(path, entries)
    return Allowance(_OPEN * abs(value), why=_WHY) if top == "open_sd_rms" else _SAME


def _check_rule(name: str, value: float) -> Allowance:
    if name.startswith("probability"):
        return Allowance(_VARIANT, why=_WHY)
    if name == "in_90_band":
        return Allowance(_ROWS, why=_WHY)
    return Allowance(_CHECK * abs(value), why=_WHY)


def _where_rule(path: Place, entries: Entries) -> Allowance | None:
    sd = entries.get((*path[:-1], "gap_sd"), 0.0)
    sizes = {"gap": _GAP * sd, "gap_sd": _GAP_SD * sd, "probability": _WHERE}
    return Allowance(sizes[path[-1]], why=_WHY) if path[-1] in sizes else _SAME


def corrected_allowances(paths: Iterable[Place]) -> dict[Place, Allowance]:
    """Return the allowances of ``corrected.json``: its modes follow those of the diagnosis."""
    return {path: _JUMPS for path in paths if path[0] in ("fits", "lab_mode")}


def prediction_allowances(entries: Entries) -> dict[Place, Allowance]:
    """Return the allowances of ``fresh_prediction.csv``: a part of the width of each band."""
    found: dict[Place, Allowance] = {}
    for path, value in entries.items():
        row, column = path
        stem = column.partition("_before")[0].partition("_after")[0]
        low, high = (entries.get((row, f"{stem}_after_{end}")) for end in ("lower", "upper"))
        if stem == column or not isinstance(low, float) or not isinstance(high, float):
            if isinstance(value, float):
                found[path] = Allowance(_TABLE * abs(value), why="data")
        else:
            found[path] = Allowance(_BAND * (high - low), why=_WHY)
    return found


def audit_allowances(entries: Entries) -> dict[Place, Allowance]:
    """Return the allowances of ``audit.json``, computed again as `entries`."""
    found = {path: _audit_rule(path, value, entries) for path, value in entries.items()}
    return {path: rule for path, rule in found.items() if rule is not None}


def _audit_rule(path: Place, value: Any, entries: Entries) -> Allowance | None:
    if path[0] != "findings" or len(path) < 3:
        return None if isinstance(value, str) else _SAME
    key, part = path[1], path[2]
    if part == "evidence":
        return _WORDS
    if part != "found":
        return None
    if key == _SEARCHED:
        return _JUMPS
    if isinstance(value, str):
        return None
    number = abs(value) if isinstance(value, int | float) else 0.0
    if key in _DRAWN:
        ends = (entries.get((*path[:-1], end)) for end in ("lower", "upper"))
        low, high = (end if isinstance(end, int | float) else 0.0 for end in ends)
        return Allowance(max(_INTERVAL * (high - low), _COST * number), why=_WHY)
    return Allowance(_COST * number, why=_WHY)
