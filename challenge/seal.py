"""The sealed key: written outside the cases, its hash published with them.

A diagnosis never takes a key's path, and nothing in a case folder leads to one. Whoever holds
the key later proves with the published hash that it was not changed after the fact.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from calib.batch.folders import alone, check_room, writing
from calib.errors import CalibError

KEY_SCHEMA = "calib/challenge-key/1"
MANIFEST_SCHEMA = "calib/challenge/1"
MANIFEST_NAME, HASH_NAME = "manifest.json", "HASH"


def sha256(data: bytes) -> str:
    """Return the SHA-256 of some bytes as hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def commitment(seed: int, salt: str) -> str:
    """Return a commitment to a seed that does not give it away."""
    return sha256(f"{salt}:{seed}".encode())


def check_new(cases_dir: Path, key_path: Path) -> None:
    """Check where cases and their key are to be written.

    Raises
    ------
    CalibError
        If the key would lie with the cases, or something is there already.
    """
    if key_path.resolve().is_relative_to(cases_dir.resolve()):
        raise CalibError(
            "the key must not lie with the cases that it answers",
            where=str(key_path),
            expected=f"a path outside {cases_dir}",
            hint="choose another path for the key",
        )
    if cases_dir.exists() and any(cases_dir.iterdir()):
        raise CalibError(
            "the folder is not empty",
            where=str(cases_dir),
            hint="choose a new folder, so that cases of two tests cannot mix",
        )
    for path in (cases_dir, key_path):
        check_room(path)
    if key_path.exists():
        raise CalibError(
            "a key is there already",
            where=str(key_path),
            hint="choose another path; without its key a test cannot be scored",
        )


@contextmanager
def new_folder(cases_dir: Path) -> Iterator[None]:
    """Make the folder of cases, and keep other processes from writing theirs there."""
    with writing(cases_dir):
        cases_dir.mkdir(parents=True, exist_ok=True)
    with alone(cases_dir):
        yield


def seal(key: dict[str, Any], key_path: Path) -> str:
    """Write a key and return its SHA-256.

    Parameters
    ----------
    key : dict
        Content with ``seed`` and ``salt``.
    key_path : Path
        Where to write; readable by its owner only.
    """
    data = (json.dumps(key, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()
    with writing(key_path):
        key_path.parent.mkdir(parents=True, exist_ok=True)
        key_path.write_bytes(data)
        key_path.chmod(0o600)
    return sha256(data)


def publish(cases_dir: Path, key: dict[str, Any], digest: str, tiers: tuple[str, ...]) -> None:
    """Write what everybody may know: number of cases, tiers, the key's hash, a seed commitment."""
    manifest = {
        "schema": MANIFEST_SCHEMA,
        "n_cases": len(key["cases"]),
        "tiers": list(tiers),
        "key_sha256": digest,
        "seed_commitment": commitment(key["seed"], key["salt"]),
    }
    text = json.dumps(manifest, indent=1, sort_keys=True) + "\n"
    (cases_dir / MANIFEST_NAME).write_text(text, encoding="utf-8")
    (cases_dir / HASH_NAME).write_text(digest + "\n", encoding="utf-8")


def published_hash(cases_dir: Path) -> str:
    """Return the hash that was published with the cases.

    Raises
    ------
    CalibError
        If there is none.
    """
    try:
        manifest = json.loads((cases_dir / MANIFEST_NAME).read_bytes())
        return str(manifest["key_sha256"])
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise CalibError(
            f"no published key hash can be read ({type(problem).__name__})",
            where=str(cases_dir / MANIFEST_NAME),
            expected="the manifest that was written with the cases",
            hint="point to the folder that `calib challenge make` wrote",
        ) from problem


def open_key(cases_dir: Path, key_path: Path) -> dict[str, Any]:
    """Return the key's content after checking it against the published hash.

    Raises
    ------
    CalibError
        If the key cannot be read, was changed or belongs to other cases.
    """
    expected = published_hash(cases_dir)
    try:
        data = key_path.read_bytes()
    except OSError as problem:
        raise CalibError(
            f"the key cannot be read ({problem.strerror})", where=str(key_path)
        ) from problem
    if sha256(data) != expected:
        raise CalibError(
            f"the key's SHA-256 is {sha256(data)}",
            where=str(key_path),
            expected=f"the published {expected}",
            hint="use the key that was written together with these cases, unchanged",
        )
    key: dict[str, Any] = json.loads(data)
    if key.get("schema") != KEY_SCHEMA:
        raise CalibError(
            f"the key has the schema {key.get('schema')!r}",
            where=str(key_path),
            expected=KEY_SCHEMA,
        )
    return key
