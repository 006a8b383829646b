"""The pages of the files name every key: of the committed results, and of a simulator file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from calib.check.schema import RunRecord
from calib.models.simulators.files import SimulatorFile
from tests.docs.pages import DOCS, ROOT

REPORTS = ROOT / "reports"
RESULTS = (DOCS / "formats" / "results.md").read_text(encoding="utf-8")
# Below these keys, how many levels of keys are names of one's own: outputs, methods, parameters.
NAMES = {"models": 1, "estimates": 2, "fit": 1, "priors": 1, "posterior": 1, "parameters": 1,
         "shrink": 1, "quantities": 1, "inclusion": 1}  # fmt: skip
# Told in words, or of other programs.
WHOLE = {"ranges", "references", "mode", "coverage", "coverage_interval", "by_pressure", "criteria",
         "gate", "conditions", "paper_gaps", "audit", "tasks", "files", "left_out", "versions",
         "machine", "seconds", "settings", "genetic_algorithm"}  # fmt: skip


def keys(value: Any, names: int = 0) -> Iterator[str]:
    """Yield the keys of a document that are the format's own."""
    for inside in value if isinstance(value, list) else ():
        yield from keys(inside)
    for key, inside in value.items() if isinstance(value, dict) else ():
        if names:
            yield from keys(inside, names - 1)
            continue
        yield key
        if key not in WHOLE:
            yield from keys(inside, NAMES.get(key, 0))


@pytest.mark.parametrize(
    "file",
    [
        "he2019/summary.json", "he2019/manifest.json", "he2019/gaps/nominal_slip/diagnosis.json",
        "he2019/gaps/held_out_pull/diagnosis.json", "sbc/sbc.json",
    ],
)  # fmt: skip
def test_every_key_is_told(file: str) -> None:
    document = json.loads((REPORTS / file).read_text(encoding="utf-8"))
    told = set(re.findall(r"`(\w+)`", RESULTS))
    assert {key for key in keys(document) if key not in told} == set()


def test_the_keys_of_a_run_are_told() -> None:
    of_run = RESULTS.partition("`run.json`, schema")[2].partition("## Report folder")[0]
    fields = {f.alias or name for name, f in RunRecord.model_fields.items()} - {
        "document",
        "schema",
    }
    assert fields <= set(re.findall(r"`(\w+)`", of_run))


def of_simulators() -> dict[str, str]:
    """Return what the table of a simulator file's keys says of each: its default."""
    page = (DOCS / "simulators.md").read_text(encoding="utf-8")
    found: dict[str, str] = {}
    for line in page.partition("## Every key of the file")[2].splitlines():
        if line.startswith("| `"):
            keys, _, default = line.split(" | ")[:3]
            names = re.findall(r"`\[?(\w+(?:\.[a-z]+)?)", keys)
            found |= dict.fromkeys(names, default.strip("` "))
    return found


def test_every_key_of_a_simulator_file_is_told_with_its_default() -> None:
    told = of_simulators()
    fields = dict(SimulatorFile.model_fields)
    budget = fields["emulator"].annotation.model_fields
    fields |= {f"emulator.{name}": field for name, field in budget.items()}
    assert set(told) == set(fields)
    plain = {
        name: json.dumps(field.default)
        for name, field in fields.items()
        if isinstance(field.default, (str, int, float, bool)) and name != "cache"
    }
    assert {name: told[name] for name in plain} == plain
