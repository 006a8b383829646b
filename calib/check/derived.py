"""Check what follows from other files of a report, without computing any of these again.

Tables, methods and references follow from `summary.json` and `manifest.json`, the audit as CSV
from `audit.json`, what the summary says of the source's gaps from their diagnoses, and the gap at
each row of a diagnosis from the corrected model saved with it. Documents for machines are written
in one form only.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.check.numbers import flatten, read_json
from calib.check.outcome import Item, Status
from calib.check.text import GROUP as TEXT
from calib.check.text import differing_lines
from calib.errors import CalibError
from calib.gap.corrected import load_corrected
from calib.gap.where import row_gaps
from calib.report.publish import publication
from calib.report.sections import SECTIONS

AUDIT_JSON, AUDIT_CSV = "audit.json", "audit.csv"
_INDENTED = ("summary.json", "manifest.json", AUDIT_JSON)
# Of the sd of a gap; and a gap that is nil, in kN, mm or g/cm^3.
_OF_SD, _ROUNDING = 0.3, 1e-6
_SOURCES = "summary.json and manifest.json"


def derived_files(names: Mapping[str, str]) -> set[str]:
    """Return those of a report's files that this module knows how to make from others."""
    tables = {name for name in names if name.startswith(("tables/", "methods."))}
    return tables | ({"references.bib", AUDIT_CSV} & set(names))


def verify_derived(
    folder: Path,
    files: Mapping[str, str],
    manifest: Mapping[str, Any],
    summary: Mapping[str, Any],
    *,
    same_code: bool,
) -> list[Item]:
    """Write the derived files of a report again from what it records, and compare the bytes.

    Another version than the one that wrote the report may word it otherwise.
    """
    expected: dict[str, str] = {}
    failed = []
    writers: dict[str, Callable[[], Mapping[str, str]]] = {
        _SOURCES: lambda: publication(manifest, summary).files,
        **{kind.name: partial(kind.derived, folder, files) for kind in SECTIONS.values()},
    }
    for source, write in writers.items():
        try:
            expected |= write()
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            note = f"what follows from it cannot be written ({type(error).__name__}: {error})"
            status = Status.DIFFERENT if same_code else Status.UNJUDGED
            failed.append(Item(TEXT, source, status, note=note))
    items = []
    listed = derived_files(files)
    for name in sorted(listed | set(expected)):
        if name in expected:
            items.append(_written(folder, name, expected[name], same_code=same_code))
        elif not failed:
            note = "it follows from nothing here"
            items.append(_different(name, note, same_code=same_code))
    return failed + items


def _written(folder: Path, name: str, text: str, *, same_code: bool) -> Item:
    source = AUDIT_JSON if name == AUDIT_CSV else _SOURCES
    path = folder / name
    if not path.is_file():
        return _different(name, f"missing, though {source} give it", same_code=same_code)
    if path.read_bytes() == text.encode():
        return Item(TEXT, name, Status.IDENTICAL, note=f"it follows from {source}")
    found = path.read_text(encoding="utf-8", errors="replace").splitlines()
    note = f"it does not follow from {source}: {differing_lines(found, text.splitlines())}"
    return _different(name, note, same_code=same_code)


def _different(name: str, note: str, *, same_code: bool) -> Item:
    if same_code:
        return Item(TEXT, name, Status.DIFFERENT, note=note)
    return Item(TEXT, name, Status.UNJUDGED, note=f"another version wrote it; {note}")


def verify_form(folder: Path) -> list[Item]:
    """Check that documents are in the form they are written in.

    Of two equal keys a machine reads the last, and a person may see the first.
    """
    found = []
    for path in sorted(folder.rglob("*.json")):
        name = path.relative_to(folder).as_posix()
        try:
            text = path.read_text(encoding="utf-8")
            content = json.loads(text)
        except (OSError, ValueError, RecursionError):
            continue  # which is said where its entries are compared
        forms = (1, None) if name in _INDENTED else (None, 1)
        if not any(text == f"{json.dumps(content, indent=n)}\n" for n in forms):
            note = "not in the form it is written in: repeated keys, or edited by hand"
            found.append(Item(TEXT, name, Status.DIFFERENT, note=note))
    return found


def verify_gaps(folder: Path, summary: Mapping[str, Any], *, same_code: bool) -> list[Item]:
    """Hold what a summary says of the source's gaps, and their corrected models, against diagnoses.

    Another version than the one that wrote the report may predict otherwise.
    """
    gaps = summary.get("paper_gaps")
    if not isinstance(gaps, Mapping):
        return []
    items = []
    for name, said in gaps.items():
        inner = folder / "gaps" / str(name)
        if (inner / "diagnosis.json").is_file() and isinstance(said, Mapping):
            diagnosis = read_json(inner / "diagnosis.json")
            items.append(_said_alike(str(name), said, diagnosis))
            items.append(_corrected(str(name), inner, diagnosis, same_code=same_code))
    return items


def _said_alike(name: str, said: Mapping[str, Any], found: Mapping[str, Any]) -> Item:
    both = f"summary.json and gaps/{name}/diagnosis.json"
    try:
        effects = found["effects"]
        stated = {
            "verdict": found["verdict"],
            "probability": {e["name"]: e["probability"] for e in effects},
            "best": effects[0]["name"],
            "parameters": effects[0]["parameters"],
            "shrink": found["shrink"],
        }
    except (KeyError, TypeError, IndexError):
        return Item(TEXT, both, Status.DIFFERENT, note="the diagnosis is not a whole one")
    old = dict(flatten({key: said.get(key) for key in stated}))
    new = dict(flatten(stated))
    for place in {**old, **new}:
        if old.get(place) != new.get(place):
            note = f"{'.'.join(place)} is not the same"
            return Item(TEXT, both, Status.DIFFERENT, old.get(place), new.get(place), note=note)
    return Item(TEXT, both, Status.IDENTICAL, note="they say the same")


def _corrected(gap: str, folder: Path, diagnosis: Mapping[str, Any], *, same_code: bool) -> Item:
    """Check that a corrected model predicts the gaps that its diagnosis states.

    It is drawn from, and a normal may be drawn otherwise by another processor: the means of
    hundreds of draws agree within a third of their sd.
    """
    name = f"gaps/{gap}/corrected.json"
    try:
        corrected = load_corrected(folder)
        gaps = row_gaps(corrected.data, corrected.mixture.at(corrected.data.view))
        stated = {(e["output"], e["row"]): (e["gap"], e["gap_sd"]) for e in diagnosis["where"]}
        for g in gaps:
            pairs = np.array([stated[g.output, int(row)] for row in g.rows], dtype=np.float64)
            apart = np.abs(np.stack([g.gap, g.sd], axis=1) - pairs)
            if (apart > _OF_SD * pairs[:, 1:] + _ROUNDING).any():
                note = "it does not predict the gaps that diagnosis.json states"
                return _different(name, note, same_code=same_code)
    except CalibError as error:
        return _different(name, error.message, same_code=same_code)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        note = f"it cannot be held against its diagnosis ({type(error).__name__})"
        return _different(name, note, same_code=same_code)
    return Item(TEXT, name, Status.IDENTICAL, note="it predicts the gaps of diagnosis.json")
