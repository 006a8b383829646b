"""The table of a run: where calib loses first, then every data set and method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

type Marks = Sequence[Mapping[str, Any]]

CALIB, ALL = "calib", "all data sets"
NAMELESS = ("koh", "sgasp", "ogp", "sindy")  # they name no cause
# What is compared, in words; whether more is better, or 0.9 is best.
MEASURES = {
    "named": ("names the causes", 1.0),
    "wrong": ("a wrong cause at 0.9", -1.0),
    "silent": ("nulls silent", 1.0),
    "seen": ("gaps seen", 1.0),
    "auc": ("localisation AUC", 1.0),
    "after": ("error after, noise sds", -1.0),
    "covered": ("readings in the 90 % band", 0.0),
}
COUNTS = ("named", "wrong", "silent", "seen")


def values(marks: Marks, group: str, method: str, measure: str) -> dict[str, float]:
    """By case, what a method has; errors as logarithms, which are averaged."""
    if measure == "named" and method in NAMELESS:
        return {}
    found = {
        m["case"]: float(m[measure])
        for m in marks
        if m["method"] == method and group in (m["group"], ALL) and m.get(measure) is not None
    }
    if measure in ("before", "after"):
        found = {case: float(np.log(max(v, 1e-9))) for case, v in found.items()}
    return found


def groups(marks: Marks) -> list[str]:
    """Data sets, and all of them."""
    return [ALL, *dict.fromkeys(m["group"] for m in marks)]


def average(marks: Marks, group: str, method: str, measure: str) -> float | None:
    """Mean, of errors the geometric one; None without a value."""
    found = [*values(marks, group, method, measure).values()]
    if not found:
        return None
    mean = float(np.mean(found))
    return float(np.exp(mean)) if measure in ("before", "after") else mean


def lead(marks: Marks, group: str, method: str, measure: str) -> tuple[float, str]:
    """By how much a rival is better on the cases that both have, and that in words."""
    mine, other = (values(marks, group, m, measure) for m in (CALIB, method))
    both = [case for case in mine if case in other]
    if not both:
        return 0.0, ""
    a, b = (np.array([v[case] for case in both]) for v in (mine, other))
    sign = MEASURES[measure][1]
    ahead = sign * (b - a).mean() if sign else abs(a.mean() - 0.9) - abs(b.mean() - 0.9)
    if measure in COUNTS:
        return float(ahead), f"{b.sum():.0f} and {a.sum():.0f} of {len(both)}"
    error = float((b - a).std(ddof=1) / len(both) ** 0.5) if len(both) > 1 else float("nan")
    what = f"ratio {np.exp((b - a).mean()):.2f}" if measure == "after" else f"{b.mean():.2f}"
    rest = "" if measure == "after" else f" and {a.mean():.2f}"
    return float(ahead), f"{what}{rest}, difference ± {error:.2f}, {len(both)} cases"


def markdown(marks: Marks, lacking: Sequence[str] = ()) -> str:
    """Return the page."""
    rivals = [m for m in dict.fromkeys(m["method"] for m in marks) if m != CALIB]
    lines = ["# calib and its rivals", "", "Where a rival is better, its figure and calib's:", ""]
    sets = groups(marks)
    for group in sets:
        for measure, (words, _) in MEASURES.items():
            for method in rivals:
                ahead, said = lead(marks, group, method, measure)
                if ahead > 1e-9:
                    lines.append(f"- {group}: {words}: {method}: {said}")
    lines += ["", "Data sets on which no rival is better, and on which all are worse:", ""]
    for measure in ("named", "silent", "after"):
        told = []
        for group in sets[1:]:
            ahead = [lead(marks, group, method, measure) for method in rivals]
            told += [max(gain for gain, said in ahead if said)] if any(s for _, s in ahead) else []
        level, first = sum(t <= 1e-9 for t in told), sum(t < -1e-9 for t in told)
        lines.append(f"- {MEASURES[measure][0]}: {level} and {first} of {len(told)}")
    lines += [f"- not run, its package being absent: {name}" for name in lacking]
    for group in sets:
        cases = len({m["case"] for m in marks if group in (m["group"], ALL)})
        words = " | ".join(words for words, _ in MEASURES.values())
        lines += ["", f"## {group}, {cases} cases", ""]
        lines += [f"| | {words} | error before | seconds | failed |", "|---" * 11 + "|"]
        for method in [CALIB, *rivals]:
            cells = [_cell(marks, group, method, m) for m in (*MEASURES, "before", "seconds")]
            own = [m for m in marks if m["method"] == method and group in (m["group"], ALL)]
            failed = sum("failed" in m for m in own)
            lines.append(f"| {method} | {' | '.join(cells)} | {failed} |")
    return "\n".join(lines) + "\n"


def _cell(marks: Marks, group: str, method: str, measure: str) -> str:
    found = [*values(marks, group, method, measure).values()]
    if measure in COUNTS and found:
        return f"{sum(found):.0f}/{len(found)}"
    mean = average(marks, group, method, measure)
    return "-" if mean is None else f"{mean:.2f}"
