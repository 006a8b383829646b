"""What each result was made from, so that a campaign goes on only where nothing has changed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from calib.batch.campaign.kinds import Task
from calib.batch.environment import sha256, versions
from calib.errors import CalibError

RECORD = "task.json"
SCHEMA = "calib/task/1"


def describe(tasks: Iterable[Task]) -> dict[str, dict[str, Any]]:
    """Return for every task all that its result depends on, hashes of its inputs among it."""
    with_versions = versions()
    hashes: dict[Path, str | None] = {}
    return {
        task.name: {
            "schema": SCHEMA, "task": task.name, "kind": task.kind, "seed": task.seed,
            "settings": dict(task.settings),
            "inputs": {label: _hash(path, hashes) for label, path in task.inputs.items()},
            "versions": with_versions,
        }
        for task in tasks
    }  # fmt: skip


def _hash(path: Path, known: dict[Path, str | None]) -> str | None:
    """Return a file's hash; None for one that cannot be read, which fails when it is loaded."""
    if path not in known:
        try:
            known[path] = sha256(path.read_bytes())
        except OSError:
            known[path] = None
    return known[path]


def discard_changed(
    records: Mapping[str, Mapping[str, Any]], results: Path, *, overwrite: bool
) -> None:
    """Remove results that were made from something else than their task now says.

    Raises
    ------
    CalibError
        If there are any and they may not be removed.
    """
    changed = {}
    for name, record in records.items():
        if (results / name).exists():
            what = _difference(record, results / name / RECORD)
            if what:
                changed[name] = what
    if changed and not overwrite:
        name, what = next(iter(changed.items()))
        raise CalibError(
            f"{len(changed)} of the results there {'was' if len(changed) == 1 else 'were'} made "
            f"from something else than the plan now says: {name} differs in {what}",
            where=str(results),
            allowed="the plan, the data and the versions that the results there were made from",
            mend="choose another --out, or pass --overwrite to do these tasks again",
        )
    for name in changed:
        # Without its record, a folder that a kill leaves half removed is not taken for a result.
        (results / name / RECORD).unlink(missing_ok=True)
        shutil.rmtree(results / name)


def _difference(record: Mapping[str, Any], path: Path) -> str:
    """Name what differs from the record of a result; empty if nothing does."""
    try:
        there = json.loads(path.read_bytes())
        parts = ("settings", "inputs", "versions")
        for part in parts:
            for key in {**record[part], **there[part]}:
                if record[part].get(key) != there[part].get(key):
                    return f"{key} ({part})"
        others = [key for key in record if key not in parts and record[key] != there[key]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return RECORD
    return ", ".join(others)
