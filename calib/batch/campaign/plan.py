"""A plan: a TOML file that says which tasks a campaign has."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calib.batch.campaign.kind import Kind, Place, Section, Task
from calib.batch.campaign.kinds import KINDS
from calib.data.files import MEND_TOML, decoded
from calib.errors import CalibError
from calib.inference.random import stream


@dataclass(frozen=True)
class Plan:
    """A plan that has been checked.

    Parameters
    ----------
    text : bytes
        As it was read.
    tasks : mapping of str to Task
        By name, in the order of the plan.
    """

    path: Path
    text: bytes
    tasks: Mapping[str, Task]


def read_plan(path: Path) -> Plan:
    """Read and check a plan.

    Parameters
    ----------
    path : Path
        TOML with an optional ``seed`` and tables ``[[fit]]``, ``[[diagnose]]``, ... (see
        `calib.batch.campaign.kinds`). Files are named relative to its folder.

    Raises
    ------
    CalibError
        Naming table and key, what is expected there and how to fix it.
    """
    path = Path(path)
    text, content = _read(path)
    seed = content.pop("seed", 2019)
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise CalibError(
            f"the seed is {seed!r}",
            where=f"{path}, seed",
            expected="0 or a positive whole number",
            hint="correct it, or leave it out",
        )
    unknown = [key for key in content if key not in KINDS]
    if unknown or not content:
        raise CalibError(
            f"unknown table {', '.join(unknown)}" if unknown else "the plan has no tasks",
            where=str(path),
            expected="seed, " + ", ".join(f"[[{kind}]]" for kind in KINDS),
            hint="correct the name" if unknown else "add a table",
        )
    tasks: dict[str, Task] = {}
    sections: dict[str, str] = {}
    for name, kind in KINDS.items():
        for i, table in enumerate(_tables(content.get(name, []), name, path)):
            where = f"{path}, [[{name}]]" + (f" number {i + 1}" if i else "")
            section = _section(kind, table, where)
            if section.name in sections:
                raise CalibError(
                    f"the name {section.name!r} is that of {sections[section.name]} too",
                    where=where,
                    hint="give each table a name of its own",
                )
            sections[section.name] = where
            for label, settings, inputs in kind.plan(section, Place(path.parent, where)):
                task = f"{section.name}.{label}"
                if task in tasks:
                    raise CalibError(
                        f"two tasks would be called {task}",
                        where=where,
                        hint="rename a file, or put its task into a table of another name",
                    )
                own = stream(seed if section.seed is None else section.seed, "campaign", task)
                tasks[task] = Task(task, name, int(own.generate_state(1)[0]), settings, inputs)
    return Plan(path, text, tasks)


def _read(path: Path) -> tuple[bytes, dict[str, Any]]:
    try:
        text = path.read_bytes()
        return text, tomllib.loads(decoded(text))
    except OSError as error:
        raise CalibError(
            f"the plan cannot be read ({error.strerror})",
            where=str(path),
            hint="give the path of a TOML file",
        ) from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CalibError(f"not valid TOML: {error}", where=str(path), hint=MEND_TOML) from None


def _tables(found: Any, name: str, path: Path) -> list[Any]:
    if not isinstance(found, list) or not all(isinstance(table, dict) for table in found):
        raise CalibError(
            f"{name} is not a list of tables",
            where=str(path),
            expected=f"[[{name}]]",
            hint="write two brackets",
        )
    return found


def _section(kind: Kind, table: dict[str, Any], where: str) -> Section:
    """Check a table, and say what is wrong with it: a misspelt key before a missing one."""
    try:
        return kind.section.model_validate(table)
    except ValidationError as error:
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    key, fields = str(first["loc"][0]), kind.section.model_fields
    if first["type"] == "extra_forbidden":
        raise CalibError(
            f"unknown key {key}", where=where, expected=", ".join(fields), hint="correct its name"
        )
    expected = f"{key} = {fields[key].description}"
    if first["type"] == "missing":
        raise CalibError(f"{key} is missing", where=where, expected=expected, hint="add it")
    raise CalibError(
        f"{first['input']!r} will not do",
        where=f"{where}, {key}",
        expected=expected,
        hint="correct it",
    )
