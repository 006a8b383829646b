"""The files of a diagnosis that programs read: written, and checked against each other."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.files import inside, table_csv
from calib.errors import FAULTS, CalibError
from calib.gap.case import words_of
from calib.gap.corrected import load_corrected, save_corrected
from calib.gap.describe import gap_document
from calib.gap.diagnose import Diagnosis
from calib.gap.document import BENCH, Cause, Explanation, GapDocument
from calib.gap.document import FILE as DOCUMENT
from calib.gap.effects import EFFECTS, Effect
from calib.gap.mixture import Region, row_gaps

SCHEMA = "calib/diagnosis/1"


def document(found: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis as the contract's JSON document."""
    return contract(gap_document(found))


def contract(d: GapDocument) -> dict[str, Any]:
    """Return the content of ``diagnosis.json``."""
    record = d.track_record
    return {
        "schema": SCHEMA,
        **({"data_label": d.label} if d.label else {}),
        "verdict": d.verdict,
        **({"warnings": list(d.warnings)} if d.warnings else {}),
        "effects": [
            {"name": e.name, "probability": e.probability, "parameters": _parameters(e)}
            for e in d.explanations
        ],
        "track_record": {
            "stated": [record.low, record.high],
            "cases": record.cases,
            "right": record.right,
            "share": record.share,
            "interval": list(record.interval),
            "of": BENCH,
        },
        "inclusion": {cause.name: _included(cause) for cause in d.causes},
        "remainder": _included(d.remainder) | {"where": [_place(d, r) for r in d.remainder_where]},
        "not_testable": [{"name": n, "reason": r} for n, r in d.not_testable.items()],
        "where": _rows(d),
        "regions": [_place(d, r) | {"gap": r.gap, "probability": r.probability} for r in d.regions],
        "shrink": {
            name: asdict(s) | {"interval": list(s.interval)} for name, s in d.shrink.items()
        },
        "next_measurement": [
            {
                "separates": list(m.separates),
                "conditions": {
                    name: words_of(d.covariates, name, value, value) or value
                    for name, value in m.conditions.items()
                },
                "gain_nats": m.gain_nats,
            }
            for m in d.next_measurements
        ],
    }


def answer(told: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is repeated elsewhere of ``diagnosis.json``; its first effect is the best."""
    best = told["effects"][0]
    return {
        "verdict": told["verdict"],
        "probability": {e["name"]: e["probability"] for e in told["effects"]},
        "best": best["name"],
        "parameters": best["parameters"],
        "shrink": told["shrink"],
    }


def write_diagnosis(found: Diagnosis, folder: Path, d: GapDocument | None = None) -> None:
    """Write what programs read, and the document, into an existing folder.

    Parameters
    ----------
    found : Diagnosis
    folder : Path
    d : GapDocument, optional
        Of the diagnosis, if it was computed before.
    """
    save_corrected(found.corrected, folder)
    for name, content in program_files(d or gap_document(found)).items():
        (folder / name).write_bytes(content)


def program_files(d: GapDocument) -> dict[str, bytes]:
    """Return the files that programs read of a diagnosis by name, from its document alone."""
    made = {name: make(d) for name, make in FILES.items()}
    return {name: text.encode() for name, text in made.items() if text}


def _prediction(d: GapDocument) -> str:
    columns = d.prediction.items()
    return table_csv({n: [*v] if isinstance(v[0], str) else np.array(v) for n, v in columns})


FILES: Mapping[str, Callable[[GapDocument], str]] = {
    DOCUMENT: lambda d: d.json().decode(),
    "diagnosis.json": lambda d: json.dumps(contract(d), indent=1) + "\n",
    "fresh_prediction.csv": lambda d: _prediction(d) if d.prediction else "",
}
"""How each file for programs follows from the document; one without content is not written."""


def _parameters(explanation: Explanation) -> dict[str, dict[str, float]]:
    """Effect parameters with their sds, prefixed with the effect where there are several."""
    several = len({p.effect for p in explanation.parameters}) > 1
    return {
        f"{p.effect}.{p.name}" if several else p.name: {"mean": p.mean, "sd": p.sd}
        for p in explanation.parameters
    }


def _included(cause: Cause) -> dict[str, Any]:
    return {
        "probability": cause.probability,
        "share": cause.share,
        "share_interval": list(cause.share_interval),
    }


def _place(d: GapDocument, region: Region) -> dict[str, Any]:
    """Return a region's output and its ends, or the value of a category that it is."""
    ends = {
        name: [words_of(d.covariates, name, *ends)] if d.covariates.get(name) else list(ends)
        for name, ends in region.conditions.items()
    }
    return {"output": region.output, "conditions": ends}


def _rows(d: GapDocument) -> list[dict[str, Any]]:
    """Return an entry for every field row and output; rows that were not judged by say why."""
    entries = []
    for o in d.outputs:
        own: dict[int, dict[str, Any]] = {
            row: {"gap": gap, "gap_sd": sd, "probability": p}
            for row, gap, sd, p in zip(o.rows, o.gap, o.gap_sd, o.probability, strict=True)
        }
        for u in d.unused:
            if u.output == o.name:
                own[u.row] = {
                    "gap": u.gap, "gap_sd": u.gap_sd, "probability": u.probability, "used": False,
                    "reason": u.reason,
                }  # fmt: skip
        entries += [{"output": o.name, "row": row, **own[row]} for row in sorted(own)]
    return entries


def misquoted(said: Any, folder: Path) -> str:
    """Say which entries of an `answer` are not those of a diagnosis folder; nothing if all are."""
    try:
        stated = answer(_diagnosis(folder))
    except FAULTS:
        return "the diagnosis is not a whole one"
    apart = [key for key, value in stated.items() if inside(said).get(key) != value]
    return f"not the same: {', '.join(apart)}" if apart else ""


def mispredicted(folder: Path, effects: Mapping[str, Effect] = EFFECTS) -> str:
    """Say what is wrong with a corrected model that does not predict the gaps of its diagnosis.

    It is drawn from, and a normal may be drawn otherwise by another processor: the means of
    hundreds of draws agree within a third of their sd.
    """
    try:
        corrected = load_corrected(folder, effects)
        where = _diagnosis(folder)["where"]
        stated = {(e["output"], e["row"]): (e["gap"], e["gap_sd"]) for e in where}
        for g in row_gaps(corrected.data, corrected.mixture.at(corrected.data.view)):
            pairs = np.array([stated[g.output, int(row)] for row in g.rows], dtype=np.float64)
            apart = np.abs(np.stack([g.gap, g.sd], axis=1) - pairs)
            if (apart > 0.3 * pairs[:, 1:] + 1e-6).any():
                return "it does not predict the gaps that diagnosis.json states"
    except (CalibError, *FAULTS) as error:
        return f"it cannot be held against its diagnosis ({type(error).__name__}: {error})"
    return ""


def _diagnosis(folder: Path) -> Any:
    return json.loads((folder / "diagnosis.json").read_bytes())
