"""The manifest: what a result was made from, so that it can be made again and compared."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from calib.estimators import GeneticSettings
from calib.sampling.sampler import SamplerSettings
from calib.study import Study, Task

__all__ = ["SCHEMA", "build_manifest", "file_hashes", "sha256", "versions"]

SCHEMA = "calib/manifest/1"
_PACKAGES = ("terracalib", "numpy", "scipy", "emcee", "arviz", "arviz-stats", "matplotlib",
             "corner", "h5netcdf", "h5py")  # fmt: skip


def sha256(content: bytes) -> str:
    """Return the SHA-256 of bytes in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that numbers depend on."""
    return {"python": sys.version.split()[0], **{name: version(name) for name in _PACKAGES}}


def file_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a folder but the manifest, by relative path."""
    return {
        path.relative_to(folder).as_posix(): sha256(path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "manifest.json"
    }


def build_manifest(
    study: Study,
    settings: SamplerSettings,
    command: Sequence[str],
    inputs: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the manifest of a study, its file hashes still to be added.

    Parameters
    ----------
    study : Study
    settings : SamplerSettings
    command : sequence of str
        The command line, program first.
    inputs : mapping
        For every output: the files its data and priors were copied to, and their hashes.
    """
    return {
        "schema": SCHEMA,
        "command": list(command),
        "seed": study.seed,
        "versions": versions(),
        "settings": json.loads(json.dumps(asdict(settings))),
        "genetic_algorithm": asdict(GeneticSettings()),
        "tasks": {k: _task(r.task, inputs[k]) for k, r in study.results.items()},
    }


def _task(task: Task, inputs: Mapping[str, Any]) -> dict[str, Any]:
    held = task.held_out
    return {
        "model": task.model,
        "held_out": None if held is None else {"column": held.column, "value": held.value},
        "label": task.table.label,
        **inputs,
    }
