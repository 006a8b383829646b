"""Diagnose many cases, and record what each diagnosis is of."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from calib.batch.environment import code_sha256, sha256
from calib.batch.folders import read_folder
from calib.batch.tasks import run_tasks
from calib.errors import CalibError
from calib.gap.case import NUMBER, Case, case_files, read_case, read_context
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.files import write_diagnosis

INPUTS = "inputs.json"


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
    optional = {
        "data_label": case.label,
        "context": case.context.words(),
        "covariates": _kinds(case.covariates),
        "priors": {name: sha256(p.read_bytes()) for name, p in case.priors.items()},
        "effects": {name: sha256(found) for name, found in (effects or {}).items()},
    }
    content |= {key: value for key, value in optional.items() if value}
    return (json.dumps(content, indent=1) + "\n").encode()


def recorded_inputs(folder: Path) -> dict[str, Any] | None:
    """Return what a diagnosis says it is of; None where it does not say."""
    try:
        found = json.loads((folder / INPUTS).read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def case_hashes(folder: Path) -> dict[str, Any]:
    """Return models and hashes of a case folder as they are now, as ``inputs.json`` has them."""
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
        "models": content.get("models"),
        "sha256": hashes,
        "context": context,
        "priors": priors,
        "covariates": (_kinds(own) if isinstance(own, dict) else own) or None,
    }


def _kinds(covariates: Mapping[str, object]) -> dict[str, str]:
    """Say of declared columns which hold numbers; the values of a category are in the files."""
    return {
        name: "number" if kind in ("number", NUMBER) else "category"
        for name, kind in covariates.items()
    }


def check_resumable(cases: Sequence[Path], out: Path, seed: int) -> None:
    """Check that diagnoses which are there are of these cases, with this seed and version."""
    made_by = _made_by(seed)
    found: dict[str, list[str]] = {}
    for case in cases:
        if (out / case.name).exists() and (reason := _foreign(case, out / case.name, made_by)):
            found.setdefault(reason, []).append(case.name)
    for reason, names in found.items():
        listed = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        raise CalibError(
            f"{len(names)} of the diagnoses that are there {reason}: {listed}",
            where=str(out),
            expected="an empty folder, or earlier diagnoses of the same cases",
            hint="choose another folder, or delete this folder",
        )


def _foreign(case: Path, done: Path, made_by: Mapping[str, Any]) -> str:
    """Say why a diagnosis is not of a case as it would be made now; empty if it is."""
    said, version = recorded_inputs(done), made_by["version"]
    if said is None:
        return "do not say which cases they are of"
    if any(said.get(key) != value for key, value in case_hashes(case).items()):
        return "are of other cases, or of these before their files were changed"
    if said.get("seed") != made_by["seed"]:
        return f"were made with --seed {said.get('seed')}, not {made_by['seed']}"
    if said.get("version") != version:
        return f"were made by version {said.get('version')}, not {version}"
    if said.get("code_sha256") != made_by["code_sha256"]:
        return f"were made by other code or priors of version {version}"
    return "were made with effects of one's own" if "effects" in said else ""


def _made_by(seed: int) -> dict[str, Any]:
    return {"seed": seed, "version": version("terracalib"), "code_sha256": code_sha256()}


def case_folders(folder: Path) -> list[Path]:
    """Return the case folders in a folder, by name.

    Raises
    ------
    CalibError
        If there is none.
    """
    found = sorted(p.parent for p in Path(folder).glob("*/case.toml"))
    if not found:
        raise CalibError(
            "there are no cases",
            where=str(folder),
            expected="folders with a case.toml in them",
            hint="make some with `calib challenge make`",
        )
    return found


def diagnose_cases(
    cases: Sequence[Path],
    out: Path,
    seed: int,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> dict[str, str]:
    """Diagnose cases, each into a folder of its name that appears whole or not at all.

    Parameters
    ----------
    seed : int
        Results do not depend on the number of workers.
    workers, scheduler, progress, announce
        As for `calib.batch.tasks.run_tasks`.

    Returns
    -------
    dict of str to str
        Cases that failed, with their error.

    Raises
    ------
    CalibError
        If there are diagnoses of other cases, or with another seed.
    """
    check_resumable(cases, out, seed)
    outcome = run_tasks(
        partial(_diagnosed, seed=seed),
        {case.name: case for case in cases},
        out,
        read=read_case,
        folders=True,
        workers=workers,
        scheduler=scheduler,
        progress=progress,
        announce=announce,
    )
    return dict(outcome.failed)


def _diagnosed(case: Case, seed: int) -> dict[str, bytes]:
    return written(diagnose(case, seed))


def written(found: Diagnosis, effects: Mapping[str, bytes] | None = None) -> dict[str, bytes]:
    """Return the files of a diagnosis, by name, to be written elsewhere.

    Parameters
    ----------
    effects : mapping of str to bytes, optional
        Files of the user's own effects, by name.
    """
    with TemporaryDirectory() as scratch:
        write_diagnosis(found, Path(scratch))
        files = read_folder(Path(scratch))
    return files | {INPUTS: inputs_record(found.data.case, found.seed, effects)}
