"""Whose diagnoses these are: their ``inputs.json`` held against the files of the cases."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calib.errors import CalibError
from challenge.seal import sha256

INPUTS = "inputs.json"
_TABLES = ("calibration", "field", "predict")
_SHOWN = 5


def check_results(cases_dir: Path, results_dir: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Refuse diagnoses that are of other cases; return what cannot be made sure of.

    Parameters
    ----------
    cases_dir, results_dir : Path
        With a folder for each case, and for each diagnosis.
    names : sequence of str
        Of the cases.

    Raises
    ------
    CalibError
        If there is no diagnosis, or some are of other cases.
    """
    there = [name for name in names if (results_dir / name / "diagnosis.json").is_file()]
    if not there:
        raise CalibError(
            "there is no diagnosis of these cases", where=str(results_dir),
            expected="a folder that `calib challenge run` wrote",
            hint=f"correct --results, or run `calib challenge run {cases_dir} --out {results_dir}`",
        )  # fmt: skip
    foreign, untold = [], []
    for name in there:
        said = _recorded(results_dir / name / INPUTS)
        if said is None or not (cases_dir / name / "case.toml").is_file():
            untold.append(name)
        elif any(said.get(key) != value for key, value in found_in(cases_dir / name).items()):
            foreign.append(name)
    if foreign:
        raise CalibError(
            f"{len(foreign)} of {len(there)} diagnoses are of other cases, or of these before "
            f"their files were changed: {_listed(foreign)}",
            where=str(results_dir), expected=f"diagnoses of the cases in {cases_dir}",
            hint="point to their diagnoses, or diagnose these cases again, into another folder",
        )  # fmt: skip
    if not untold:
        return ()
    return (
        f"{len(untold)} of {len(there)} diagnoses cannot be held against the files of their "
        f"case: {_listed(untold)}; they are taken to be of these cases",
    )


def _recorded(path: Path) -> dict[str, Any] | None:
    """Return what a diagnosis says it is of; None where it does not say."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def found_in(folder: Path) -> dict[str, Any]:
    """Return models and hashes of a case folder, as ``inputs.json`` has them."""
    try:
        content = tomllib.loads((folder / "case.toml").read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        content = {}
    named = {key: content.get(key) for key in _TABLES}
    files = {key: folder / name for key, name in named.items() if isinstance(name, str)}
    hashes = {key: sha256(path.read_bytes()) for key, path in files.items() if path.is_file()}
    return {"models": content.get("models"), "sha256": hashes}


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
