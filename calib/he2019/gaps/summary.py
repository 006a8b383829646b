"""The gaps' part of `summary.json`: every number that the page shows of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from calib.gap.diagnose import Diagnosis
from calib.gap.files import document
from calib.he2019.gaps.checks import checks
from calib.he2019.gaps.find import FoundGap


def summarise_gaps(results: Sequence[FoundGap]) -> dict[str, Any]:
    """Return plain dictionaries by the names of the gaps.

    Each holds ``verdict``, ``probability`` by hypothesis, ``parameters`` of the most probable one,
    ``shrink``, ``rows``, ``withheld``, ``checks`` by name and ``variants`` by name.
    """
    return {result.gap.name: _one(result) for result in results}


def _one(result: FoundGap) -> dict[str, Any]:
    found = result.found
    written = document(found)
    return {
        "models": dict(found.data.case.models),
        "rows": {"calibration": len(found.data.case.lab), "field": len(found.data.case.field)},
        "withheld": result.gap.withheld,
        **_answer(found),
        "best": found.ranking.order[0],
        "parameters": written["effects"][0]["parameters"],
        "shrink": written["shrink"],
        "open_sd_rms": float((result.open_sd**2).mean() ** 0.5),
        "checks": {check.name: dict(check.values) for check in checks(result)},
        "variants": {name: _answer(other) for name, other in result.variants.items()},
        "warnings": list(found.warnings),
    }


def _answer(found: Diagnosis) -> dict[str, Any]:
    p = found.ranking.probability
    return {"verdict": found.verdict, "probability": {n: float(p[n]) for n in found.ranking.order}}
