"""Rows of the part `emulator`: runs of a slow simulator against accuracy of its posterior."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from shared.measure import spread

__all__ = ["emulator_lines"]

# Asked of the sequential design with 200 runs, and of a diagnosis.
_MEANS, _SDS, _MORE = 0.05, 0.1, 100.0
_ASKED = ("sequential", 200)

type Line = tuple[str, str, Mapping[str, float], float | None]


def emulator_lines(m: Mapping[str, Any]) -> Iterator[Line]:
    """Yield subject, quantity, spread over the data sets and the most that is asked."""
    cases = dict.fromkeys((row["way"], row["budget"]) for row in m["rows"])
    for way, budget in cases:
        rows = [r for r in m["rows"] if (r["way"], r["budget"]) == (way, budget)]
        asked = (way, budget) == _ASKED
        subject = f"{way}, {budget} runs at most"
        for key, what, most in (
            ("runs", "runs made", None),
            ("mean_off", "posterior mean off, in its sd, worst parameter", _MEANS),
            ("sd_off", "posterior sd off, relative, worst parameter", _SDS),
        ):
            yield subject, what, spread([float(r[key]) for r in rows]), most if asked else None
    found = m["diagnoses"]
    subject = "diagnosis by the emulator"
    yield subject, "runs beyond the calibration's", spread([float(d["more"]) for d in found]), _MORE
    off = [abs(d["probability"] - d["exact_probability"]) for d in found]
    yield subject, "probability off the simulator's own", spread(off), None
