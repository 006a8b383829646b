"""Whether the files of a diagnosis, and what somebody says of it, agree with each other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.files import inside
from calib.errors import FAULTS, CalibError
from calib.gap.corrected import load_corrected
from calib.gap.files import answer
from calib.gap.where import row_gaps

# Of the sd of a gap; and a gap that is nil, in kN, mm or g/cm^3.
_OF_SD, _ROUNDING = 0.3, 1e-6


def misquoted(said: Any, folder: Path) -> str:
    """Say which entries of an `answer` are not those of a diagnosis folder; nothing if all are."""
    try:
        stated = answer(_diagnosis(folder))
    except FAULTS:
        return "the diagnosis is not a whole one"
    apart = [key for key, value in stated.items() if inside(said).get(key) != value]
    return f"not the same: {', '.join(apart)}" if apart else ""


def mispredicted(folder: Path) -> str:
    """Say what is wrong with a corrected model that does not predict the gaps of its diagnosis.

    It is drawn from, and a normal may be drawn otherwise by another processor: the means of
    hundreds of draws agree within a third of their sd.
    """
    try:
        corrected = load_corrected(folder)
        where = _diagnosis(folder)["where"]
        stated = {(e["output"], e["row"]): (e["gap"], e["gap_sd"]) for e in where}
        for g in row_gaps(corrected.data, corrected.mixture.at(corrected.data.view)):
            pairs = np.array([stated[g.output, int(row)] for row in g.rows], dtype=np.float64)
            apart = np.abs(np.stack([g.gap, g.sd], axis=1) - pairs)
            if (apart > _OF_SD * pairs[:, 1:] + _ROUNDING).any():
                return "it does not predict the gaps that diagnosis.json states"
    except (CalibError, *FAULTS) as error:
        return f"it cannot be held against its diagnosis ({type(error).__name__}: {error})"
    return ""


def _diagnosis(folder: Path) -> Any:
    return json.loads((folder / "diagnosis.json").read_bytes())
