"""The withheld answers: written outside the cases, the hash of each in its case.

A diagnosis never takes an answer's path, and nothing in a case folder leads to one. Whoever holds
the answers later proves with the hashes that they were not changed after the fact.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from calib.batch.folders import alone, check_room, writing
from calib.errors import CalibError
from challenge.format import Answer, read_document

ANSWER, ANSWER_SCHEMA = "answer.json", "calib/answer/1"


def sha256(data: bytes) -> str:
    """Return the SHA-256 of some bytes as hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def check_new(cases_dir: Path, answers_dir: Path) -> None:
    """Check where cases and their answers are to be written.

    Raises
    ------
    CalibError
        If the answers would lie with the cases, or something is there already.
    """
    if answers_dir.resolve().is_relative_to(cases_dir.resolve()):
        raise CalibError(
            "the answers must not lie with the cases",
            where=str(answers_dir),
            expected=f"a path outside {cases_dir}",
            hint="choose another path for the answers",
        )
    for path in (cases_dir, answers_dir):
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise CalibError(
                "the folder is not empty",
                where=str(path),
                hint="choose a new folder, so that cases of two tests cannot mix",
            )
        check_room(path)


@contextmanager
def new_folder(cases_dir: Path) -> Iterator[None]:
    """Make the folder of cases, and keep other processes from writing theirs there."""
    with writing(cases_dir):
        cases_dir.mkdir(parents=True, exist_ok=True)
    with alone(cases_dir):
        yield


def write_case(
    folder: Path, files: Mapping[str, str], answers_dir: Path, answer: Mapping[str, Any]
) -> None:
    """Write a case, and its answer, readable by its owner only, into a folder of its name.

    Parameters
    ----------
    folder : Path
        Of the case.
    files : mapping of str to str
        Name to text; ``case.toml`` without the hash, or with that of another answer.
    answers_dir : Path
        Of the answers of all cases.
    answer : mapping
        Content without ``schema``.
    """
    content = {"schema": ANSWER_SCHEMA, **answer}
    data = (json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()
    path = answers_dir / folder.name / ANSWER
    with writing(folder), writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        path.chmod(0o600)
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            if name == "case.toml":
                text = re.sub("^answer_sha256 = .*\n", "", text, flags=re.M)
                text = f'answer_sha256 = "{sha256(data)}"\n{text}'
            (folder / name).write_text(text, encoding="utf-8")


def open_answers(cases_dir: Path, answers_dir: Path) -> dict[str, Answer]:
    """Return answers by the names of their cases, checked against the hashes in these.

    Raises
    ------
    CalibError
        If there are none, or one cannot be read, was changed or is of another case.
    """
    found: dict[str, Answer] = {}
    for where in sorted(answers_dir.glob(f"*/{ANSWER}")):
        path = cases_dir / where.parent.name / "case.toml"
        found[where.parent.name], digest = read_document(where, Answer)
        if (said := _published(path)) != digest:
            raise CalibError(
                f"the answer's SHA-256 is {digest}",
                where=str(where),
                expected=f"the published answer_sha256, {said}, of {path}",
                hint="use the answers that were written together with these cases, unchanged",
            )
    if not found:
        raise CalibError(
            "there are no answers",
            where=str(answers_dir),
            expected=f"a folder with an {ANSWER} in a folder for each case",
            hint="point to the answers that `calib challenge make` wrote",
        )
    return found


def _published(path: Path) -> str | None:
    try:
        said: str | None = tomllib.loads(path.read_text(encoding="utf-8-sig")).get("answer_sha256")
    except (OSError, ValueError):
        return None
    return said
