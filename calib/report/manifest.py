"""The manifest: what a result was made from, so that it can be made again and compared."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calib.batch.environment import Environment, sha256
from calib.inference.estimators import GeneticSettings
from calib.inference.sampling.sampler import SamplerSettings
from calib.report.study import Study
from calib.report.study_tasks import Task

SCHEMA = "calib/manifest/2"


def file_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a folder but the manifest, by relative path."""
    return {
        path.relative_to(folder).as_posix(): sha256(path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).as_posix() != "manifest.json"
    }


def build_manifest(
    study: Study,
    settings: SamplerSettings,
    command: Sequence[str],
    inputs: Mapping[str, Mapping[str, Any]],
    *,
    title: str = "",
    environment: Environment | None = None,
) -> dict[str, Any]:
    """Return the manifest of a study, its file hashes still to be added.

    `inputs` are for every output the files its data and priors were copied to, and their hashes.
    ``seconds`` is the one place of a report that holds durations, which no two runs share.
    """
    return {
        "schema": SCHEMA,
        "title": title,
        "command": list(command),
        "seed": study.seed,
        **(environment or Environment.here()).document(),
        "settings": json.loads(json.dumps(asdict(settings))),
        "genetic_algorithm": asdict(GeneticSettings()),
        "tasks": {k: _task(r.task, inputs[k]) for k, r in study.results.items()},
        "seconds": {
            "study": study.seconds,
            **{
                key: {**r.seconds, "methods": {e.method: e.seconds for e in r.estimates}}
                for key, r in study.successes.items()
            },
        },
    }


def _task(task: Task, inputs: Mapping[str, Any]) -> dict[str, Any]:
    held = task.held_out
    return {
        "model": task.model,
        "held_out": None if held is None else {"column": held.column, "value": held.value},
        "label": task.table.label,
        **inputs,
    }
