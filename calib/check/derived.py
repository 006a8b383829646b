"""Check what follows from other files of a folder, without computing any of these again.

Texts are written again, and documents for machines are in one form only; what a summary says of
gaps is held against their diagnoses, and these against the corrected models saved with them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib.check.numbers import flatten, inside, read_json
from calib.check.outcome import Item, Status, claim
from calib.check.text import GROUP, differing_lines, read_text
from calib.errors import CalibError
from calib.gap.corrected import load_corrected
from calib.gap.files import answer
from calib.gap.where import row_gaps

# Of the sd of a gap; and a gap that is nil, in kN, mm or g/cm^3.
_OF_SD, _ROUNDING = 0.3, 1e-6
# What somebody else's file makes the reading of it raise.
_FAULTS = (AttributeError, IndexError, KeyError, OSError, RecursionError, TypeError, ValueError)


def derived_files(names: Iterable[str]) -> set[str]:
    """Return those of a report's files that are made from others."""
    return {
        name for name in names
        if name.startswith(("tables/", "methods.")) or name in ("references.bib", "audit.csv")
    }  # fmt: skip


def verify_derived(
    folder: Path,
    files: Iterable[str],
    writers: Mapping[str, Callable[[], Mapping[str, str]]],
    *,
    sure: bool,
) -> list[Item]:
    """Write texts again from what they follow from, by the name of that, and compare the bytes.

    Another version than the one that wrote them may word them otherwise: then it is not `sure`.
    """
    failed, found = [], dict[str, Item]()
    for source, write in writers.items():
        try:
            for name, text in write().items():
                wrong = _wrong(folder / name, text, source)
                found[name] = claim(GROUP, name, wrong, f"it follows from {source}", sure=sure)
        except (CalibError, *_FAULTS) as error:
            wrong = f"what follows from it cannot be written ({type(error).__name__}: {error})"
            failed.append(claim(GROUP, source, wrong, sure=sure))
    for name in derived_files(files) - set(found) if not failed else ():
        found[name] = claim(GROUP, name, "it follows from nothing here", sure=sure)
    return failed + [found[name] for name in sorted(found)]


def _wrong(path: Path, text: str, source: str) -> str:
    """Say what is wrong with a file that must have some text; nothing where it has."""
    if not path.is_file():
        return f"missing, though {source} gives it"
    if path.read_bytes() == text.encode():
        return ""
    lines = differing_lines(read_text(path).splitlines(), text.splitlines())
    return f"it does not follow from {source}: {lines}"


def verify_form(folder: Path) -> list[Item]:
    """Check that documents are in the form they are written in.

    Of two equal keys a machine reads the last, and a person may see the first.
    """
    found = []
    for path in sorted(folder.rglob("*.json")):
        try:
            text = path.read_text(encoding="utf-8")
            indent = 1 if text.startswith("{\n") else None
            written = f"{json.dumps(json.loads(text), indent=indent)}\n"
        except (OSError, ValueError, RecursionError):
            continue  # which is said where its entries are compared
        if text != written:
            note = "not in the form it is written in: repeated keys, or edited by hand"
            found.append(claim(GROUP, path.relative_to(folder).as_posix(), note))
    return found


def verify_gaps(folder: Path, summary: Mapping[str, Any], *, same_code: bool) -> list[Item]:
    """Hold what a summary says of the source's gaps, and their corrected models, against diagnoses.

    Another version than the one that wrote the report may predict otherwise.
    """
    items = []
    for name, said in inside(summary, "paper_gaps").items():
        place = folder / "gaps" / name
        if (place / "diagnosis.json").is_file():
            diagnosis = read_json(place / "diagnosis.json")
            items.append(
                _said_alike(f"summary.json and gaps/{name}/diagnosis.json", said, diagnosis)
            )
            wrong = _mispredicted(place, diagnosis)
            right = "it predicts the gaps of diagnosis.json"
            items.append(claim(GROUP, f"gaps/{name}/corrected.json", wrong, right, sure=same_code))
    return items


def _said_alike(both: str, said: Any, diagnosis: Mapping[str, Any]) -> Item:
    try:
        stated = answer(diagnosis)
    except _FAULTS:
        return claim(GROUP, both, "the diagnosis is not a whole one")
    old, new = (dict(flatten({k: inside(d).get(k) for k in stated})) for d in (said, stated))
    for place in {**old, **new}:
        if old.get(place) != new.get(place):
            note = f"{'.'.join(place)} is not the same"
            pair = old.get(place), new.get(place)
            return Item(GROUP, both, Status.DIFFERENT, *pair, note=note)
    return claim(GROUP, both, "", "they say the same")


def _mispredicted(folder: Path, diagnosis: Mapping[str, Any]) -> str:
    """Say what is wrong with a corrected model that does not predict the gaps of its diagnosis.

    It is drawn from, and a normal may be drawn otherwise by another processor: the means of
    hundreds of draws agree within a third of their sd.
    """
    try:
        corrected = load_corrected(folder)
        stated = {(e["output"], e["row"]): (e["gap"], e["gap_sd"]) for e in diagnosis["where"]}
        for g in row_gaps(corrected.data, corrected.mixture.at(corrected.data.view)):
            pairs = np.array([stated[g.output, int(row)] for row in g.rows], dtype=np.float64)
            apart = np.abs(np.stack([g.gap, g.sd], axis=1) - pairs)
            if (apart > _OF_SD * pairs[:, 1:] + _ROUNDING).any():
                return "it does not predict the gaps that diagnosis.json states"
    except CalibError as error:
        return error.message
    except _FAULTS as error:
        return f"it cannot be held against its diagnosis ({type(error).__name__})"
    return ""
