"""The stored limit of seed 662607 is what the report's table says of it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

REPORT = Path(__file__).parents[2] / "reports" / "challenge"
ROWS = {
    "all cases with a gap": None,
    "pull and rut": {"drawbar_pull", "rut_depth"},
    "pull alone": {"drawbar_pull"},
    "rut alone": {"rut_depth"},
    "bulk density alone": {"bulk_density"},
}


@pytest.mark.parametrize("label", ROWS)
def test_the_table_follows_from_the_stored_probabilities(label: str) -> None:
    """How often the truth is first and among the first two, and its mean probability."""
    stored = json.loads((REPORT / "limit.json").read_text(encoding="utf-8"))["cases"].values()
    text = (REPORT / "README.md").read_text(encoding="utf-8").partition("| oracle, 662607")[2]
    (line,) = re.findall(rf"^\| {label} \|.*$", text, re.MULTILINE)
    cells = [cell.strip() for cell in line.strip("| ").split("|")][1:]
    for tier, said, count in (("easy", *cells[:2]), ("hard", *cells[2:])):
        cases = [c for c in stored if c["tier"] == tier and c["truth"] != "none"]
        cases = [c for c in cases if ROWS[label] is None or set(c["outputs"]) == ROWS[label]]
        assert len(cases) == int(count)
        ranked = [sorted(c["probabilities"], key=c["probabilities"].get)[::-1] for c in cases]
        pairs = list(zip(cases, ranked, strict=True))
        found = (
            np.mean([c["truth"] in names[:1] for c, names in pairs]),
            np.mean([c["truth"] in names[:2] for c, names in pairs]),
            np.mean([c["probabilities"].get(c["truth"], 0.0) for c in cases]),
        )
        for value, text_value in zip(found, said.split(" / "), strict=True):
            digits = len(text_value.partition(".")[2])
            assert value == pytest.approx(float(text_value), abs=0.5001 * 10**-digits)
