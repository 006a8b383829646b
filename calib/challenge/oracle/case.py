"""One case before the oracle: what it is given, and what it finds."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.challenge.files import OUTPUT_COLUMNS
from calib.challenge.mechanism import Readings
from calib.challenge.oracle.designs import log_design, plan_shares
from calib.challenge.oracle.finding import Finding
from calib.challenge.oracle.lab import after_lab, known_soil
from calib.challenge.oracle.search import Search
from calib.challenge.record import read_stage
from calib.challenge.stage import Stage
from calib.errors import CalibError
from calib.inference.random import generator

type Array = NDArray[np.float64]

_SAME = 1e-6


@dataclass(frozen=True)
class CaseItem:
    """A case and its entry in the key.

    Attributes
    ----------
    name : str
        The case.
    entry : dict
        Its entry in the key.
    lab, field : dict
        The noisy readings that were written, ``(N,)`` per output.
    """

    name: str
    entry: dict[str, Any]
    lab: Readings
    field: Readings


def read_item(folder: Path, entry: dict[str, Any]) -> CaseItem:
    """Return a case with the readings of its folder.

    Parameters
    ----------
    folder : Path
        The case folder.
    entry : dict
        Its entry in the key.

    Raises
    ------
    CalibError
        If the key does not hold the stage, or a table is not that of the key's case.
    """
    if "stage" not in entry:
        raise CalibError(
            "the key does not say on what its cases were made",
            where=folder.name,
            mend="make the cases again with the same seed: the same cases, and a key that does",
        )
    outputs = [str(name) for name, _ in entry["stage"]["design"]["models"]]
    lab, field = (_readings(folder / f"{part}.csv", outputs) for part in ("lab", "field"))
    return CaseItem(folder.name, entry, lab, field)


def _readings(path: Path, outputs: list[str]) -> Readings:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        return {
            name: np.array([float(row[OUTPUT_COLUMNS[name]]) for row in rows]) for name in outputs
        }
    except (OSError, KeyError, ValueError) as problem:
        raise CalibError(
            f"the readings cannot be read ({type(problem).__name__}: {problem})",
            where=str(path),
            mend="use the folder that was written together with the key",
        ) from problem


def examine(item: CaseItem, seed: int, effort: int = 1) -> dict[str, Any]:
    """Return what the field says of every state that the design allows.

    Parameters
    ----------
    item : CaseItem
        The case.
    seed : int
        Of the places where the search looks; the case's name is a part of it.
    effort : int
        Multiplies their number.

    Returns
    -------
    dict
        ``tier``, ``truth``, ``outputs`` and, per state, the numbers of a `Finding` and
        ``log_design``.

    Raises
    ------
    CalibError
        If the mechanics no longer give what the key says.
    """
    stage = read_stage(item.entry["stage"])
    _check(item, stage)
    tier = stage.design.tier
    prior, shown = {}, {}
    for state, share in plan_shares(tier).items():
        told = log_design(stage.design, state)
        if np.isfinite(told):
            prior[state], shown[state] = float(np.log(share)) + told, told
    residual = stage.gap(item.field)
    search = Search(
        stage, after_lab(stage, item.lab, residual), known_soil(residual), prior,
        generator(seed, "oracle", item.name), effort,
    )  # fmt: skip
    found = search.findings()
    states = {state: _plain(one, shown[state]) for state, one in found.items() if state in shown}
    return {
        "tier": tier,
        "truth": item.entry["truth"],
        "outputs": list(stage.design.outputs),
        "states": states,
    }


def _plain(finding: Finding, told: float) -> dict[str, float]:
    return {
        "log_evidence": finding.log_evidence,
        "known_soil": finding.known_soil,
        "error": finding.error,
        "kept": finding.kept,
        "log_design": told,
    }


def _check(item: CaseItem, stage: Stage) -> None:
    for name, values in item.entry["field_without"].items():
        sizes = {len(values), item.field[name].size, stage.field.size}
        same = len(sizes) == 1 and np.allclose(
            stage.field_without[name], values, rtol=_SAME, atol=0.0
        )
        if not same or item.lab[name].size != stage.lab.size:
            raise CalibError(
                f"the mechanics give another {name} than the key holds",
                where=item.name,
                allowed="a key and cases that this version of calib made",
                mend="make the cases again with the same seed",
            )
