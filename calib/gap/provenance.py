"""What a diagnosis is of: recorded beside it, so that one of another case is never taken for it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from calib.batch.environment import code_sha256, sha256
from calib.errors import CalibError
from calib.gap.case import Case, case_files
from calib.gap.context import read_context
from calib.gap.declared import NUMBER

INPUTS = "inputs.json"
_SHOWN = 5


def inputs_record(case: Case, seed: int, effects: Mapping[str, bytes] | None = None) -> bytes:
    """Return the content of a diagnosis' ``inputs.json``.

    Parameters
    ----------
    case : Case
        As it was diagnosed.
    effects : mapping of str to bytes, optional
        Files of the user's own effects, by name: code and priors.
    """
    tables = {"calibration": case.lab, "field": case.field, "predict": case.new_conditions}
    content = _made_by(seed) | {
        "models": dict(case.models),
        "sha256": {key: table.sha256 for key, table in tables.items() if table is not None},
    }
    if case.label:
        content["data_label"] = case.label
    if case.context:
        content["context"] = case.context.words()
    if case.covariates:
        content["covariates"] = _kinds(case.covariates)
    if case.priors:
        content["priors"] = {name: sha256(p.read_bytes()) for name, p in case.priors.items()}
    if effects:
        content["effects"] = {name: sha256(found) for name, found in effects.items()}
    return (json.dumps(content, indent=1) + "\n").encode()


def recorded_inputs(folder: Path) -> dict[str, Any] | None:
    """Return what a diagnosis says it is of; None where it does not say.

    Parameters
    ----------
    folder : Path
        Of one diagnosis.
    """
    try:
        found = json.loads((folder / INPUTS).read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def case_hashes(folder: Path) -> dict[str, Any]:
    """Return models and hashes of a case folder as they are now, as ``inputs.json`` has them.

    Parameters
    ----------
    folder : Path
        Of the case. Files that cannot be read have no hash.
    """
    content, files = case_files(folder)
    hashes = {
        key: sha256(path.read_bytes())
        for key, path in files.items()
        if key != "case.toml" and path.is_file()
    }
    priors = {
        key.removeprefix("priors."): hashes.pop(key) for key in list(hashes) if "." in key
    } or None
    try:
        context = read_context(content.get("context"), str(folder)).words() or None
    except CalibError:
        context = ["it cannot be read"]
    own = content.get("covariates")
    return {
        "models": content.get("models"), "sha256": hashes, "context": context, "priors": priors,
        "covariates": (_kinds(own) if isinstance(own, dict) else own) or None,
    }  # fmt: skip


def _kinds(covariates: Mapping[str, object]) -> dict[str, str]:
    """Say of declared columns which hold numbers; the values of a category are in the files."""
    return {
        name: "number" if kind in ("number", NUMBER) else "category"
        for name, kind in covariates.items()
    }


def check_resumable(cases: Sequence[Path], out: Path, seed: int) -> None:
    """Check that diagnoses which are there are of these cases, with this seed and version.

    Raises
    ------
    CalibError
        Saying which are not, and why.
    """
    found = _foreign(cases, out, seed)
    if found:
        reason, names = next(iter(found.items()))
        raise CalibError(
            f"{len(names)} of the diagnoses that are there {reason}: {_listed(names)}",
            where=str(out), expected="an empty folder, or earlier diagnoses of the same cases",
            hint="choose another --out, or delete this folder",
        )  # fmt: skip


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")


def _foreign(cases: Sequence[Path], out: Path, seed: int) -> Mapping[str, list[str]]:
    found: dict[str, list[str]] = {}
    made_by = _made_by(seed)
    for case in cases:
        if not (out / case.name).exists():
            continue
        said = recorded_inputs(out / case.name)
        if said is None:
            reason = "do not say which cases they are of"
        elif any(said.get(key) != value for key, value in case_hashes(case).items()):
            reason = "are of other cases, or of these before their files were changed"
        elif said.get("seed") != seed:
            reason = f"were made with --seed {said.get('seed')}, not {seed}"
        elif said.get("version") != made_by["version"]:
            reason = f"were made by version {said.get('version')}, not {made_by['version']}"
        elif said.get("code_sha256") != made_by["code_sha256"]:
            reason = f"were made by other code or priors of version {made_by['version']}"
        elif "effects" in said:
            reason = "were made with effects of one's own"
        else:
            continue
        found.setdefault(reason, []).append(case.name)
    return found


def _made_by(seed: int) -> dict[str, Any]:
    return {"seed": seed, "version": version("terracalib"), "code_sha256": code_sha256()}
