"""Check what is written from the numbers beside it, without computing any of them again.

Tables, methods and references follow from `summary.json` and `manifest.json`, the audit as CSV
from `audit.json`, and what the summary says of the source's gaps from their diagnoses.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from calib.audit import audit_csv
from calib.audit.files import read_findings
from calib.publish import publication
from calib.reproduce.items import Item, Status
from calib.reproduce.numbers import flatten, read_json
from calib.reproduce.text import GROUP as TEXT
from calib.reproduce.text import differing_lines

__all__ = ["AUDIT_CSV", "AUDIT_JSON", "derived_files", "verify_derived", "verify_gap_summaries"]

AUDIT_JSON, AUDIT_CSV = "audit.json", "audit.csv"
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

    Parameters
    ----------
    folder : Path
    files : mapping of str to str
        The files that are listed.
    manifest, summary : mapping
        As recorded.
    same_code : bool
        Whether this version wrote the report: another one may word it otherwise.
    """
    expected: dict[str, str] = {}
    failed = []
    writers: dict[str, Callable[[], Mapping[str, str]]] = {
        _SOURCES: lambda: publication(manifest, summary).files,
        AUDIT_JSON: lambda: _audit_csv(folder, files),
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


def _audit_csv(folder: Path, files: Mapping[str, str]) -> dict[str, str]:
    if AUDIT_JSON not in files or not (folder / AUDIT_JSON).is_file():
        return {}
    return {AUDIT_CSV: audit_csv(read_findings(read_json(folder / AUDIT_JSON)))}


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


def verify_gap_summaries(folder: Path, summary: Mapping[str, Any]) -> list[Item]:
    """Hold what a summary says of the source's gaps against the diagnoses beside it."""
    gaps = summary.get("paper_gaps")
    if not isinstance(gaps, Mapping):
        return []
    return [item for name, said in gaps.items() if (item := _gap(folder, str(name), said))]


def _gap(folder: Path, name: str, said: Any) -> Item | None:
    path = folder / "gaps" / name / "diagnosis.json"
    both = f"summary.json and gaps/{name}/diagnosis.json"
    if not path.is_file() or not isinstance(said, Mapping):
        return None
    found = read_json(path)
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
    new = dict(flatten(json.loads(json.dumps(stated))))
    for place in {**old, **new}:
        if old.get(place) != new.get(place):
            note = f"{'.'.join(place)} is not the same"
            return Item(TEXT, both, Status.DIFFERENT, old.get(place), new.get(place), note=note)
    return Item(TEXT, both, Status.IDENTICAL, note="they say the same")
