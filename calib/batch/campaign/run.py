"""Run a campaign: what is missing of it, here or on a Dask cluster, and summarise it.

The summary has every task, its state and its key numbers, as JSON and CSV. Nothing in it depends on
how long the work took or where it was done: two campaigns of one plan give the same bytes.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from calib.batch.campaign.kind import Kind, Place, Section, Task
from calib.batch.campaign.kinds import KINDS
from calib.batch.environment import sha256, versions
from calib.batch.folders import REPLACE, check_folder, check_room, write_whole, writing
from calib.batch.tasks import check_names, failed_tasks, run_tasks
from calib.data.files import TOML_HINT, decoded
from calib.errors import CalibError
from calib.inference.random import stream
from calib.report.numbers import finite

_NUMBERS, _RECORD, _PLAN = "numbers.json", "task.json", "plan.toml"

# Kind, seed, record and content of a task: all that a worker needs of it.
type _Item = tuple[str, int, Mapping[str, Any], Any]


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

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> plan = calib.read_plan(Path("plan.toml"))  # doctest: +SKIP
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
        raise CalibError(f"not valid TOML: {error}", where=str(path), hint=TOML_HINT) from None


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


@dataclass(frozen=True)
class Summary:
    """What came of a campaign.

    Parameters
    ----------
    kinds : mapping of str to str
        The kind of every task, in the order of the plan.
    numbers : mapping of str to mapping
        The key numbers of every task that is done.
    failed : mapping of str to str
        The error of every task that failed.
    """

    kinds: Mapping[str, str]
    numbers: Mapping[str, Mapping[str, Any]]
    failed: Mapping[str, str]

    def state(self, name: str) -> Literal["done", "failed", "missing"]:
        """Whether a task is done, failed, or has not come to its end."""
        return "done" if name in self.numbers else "failed" if name in self.failed else "missing"

    @property
    def counts(self) -> dict[str, int]:
        """Tasks by state."""
        found = Counter(self.state(name) for name in self.kinds)
        return {state: found[state] for state in ("done", "failed", "missing")}

    @property
    def unconverged(self) -> tuple[str, ...]:
        """Tasks whose posterior did not pass the gate."""
        return tuple(n for n, numbers in self.numbers.items() if numbers.get("converged") is False)


def _summarise(plan: Plan, results: Path) -> Summary:
    numbers = {
        name: json.loads(path.read_bytes())
        for name in plan.tasks
        if (path := results / name / _NUMBERS).exists()
    }
    failed = {n: e for n, e in failed_tasks(results).items() if n in plan.tasks}
    return Summary({n: task.kind for n, task in plan.tasks.items()}, numbers, failed)


def _write_summary(summary: Summary, folder: Path) -> None:
    """Write ``summary.json``, and for every kind of task a CSV of its name with a row for each."""
    tasks: dict[str, dict[str, Any]] = {}
    for name, kind in summary.kinds.items():
        tasks[name] = {"kind": kind, "state": summary.state(name)}
        if name in summary.failed:
            tasks[name]["error"] = summary.failed[name]
        if name in summary.numbers:
            tasks[name]["numbers"] = summary.numbers[name]
    document = {"schema": "calib/campaign/1", "counts": summary.counts, "tasks": tasks}
    write_whole(folder / "summary.json", json.dumps(document, indent=1) + "\n")
    for kind in dict.fromkeys(summary.kinds.values()):
        names = [name for name, its in summary.kinds.items() if its == kind]
        write_whole(folder / f"{kind}.csv", _table(summary, names))


def _table(summary: Summary, names: list[str]) -> str:
    rows = []
    for name in names:
        error = summary.failed.get(name, "").partition("\n")[0]
        flat = dict(_flat(summary.numbers.get(name, {})))
        rows.append({"task": name, "state": summary.state(name), **flat, "error": error})
    columns = dict.fromkeys(key for row in rows for key in row if key != "error")
    text = io.StringIO()
    writer = csv.DictWriter(text, [*columns, "error"], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _flat(numbers: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in numbers.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _records(tasks: Iterable[Task]) -> dict[str, dict[str, Any]]:
    """Return for every task all that its result depends on, hashes of its inputs among it."""
    made_with, digest = versions(), cache(_digest)
    return {
        task.name: {
            "schema": "calib/task/1",
            "task": task.name,
            "kind": task.kind,
            "seed": task.seed,
            "settings": dict(task.settings),
            "inputs": {label: digest(path) for label, path in task.inputs.items()},
            "versions": made_with,
        }
        for task in tasks
    }


def _digest(path: Path) -> str | None:
    """Return a file's hash; None for one that cannot be read, which fails when it is loaded."""
    try:
        return sha256(path.read_bytes())
    except OSError:
        return None


def _discard_changed(
    records: Mapping[str, Mapping[str, Any]], results: Path, *, overwrite: bool
) -> None:
    """Remove results that were made from something else than their task now says, if allowed."""
    changed = {
        name: what
        for name, record in records.items()
        if (results / name).exists() and (what := _difference(record, results / name / _RECORD))
    }
    if changed and not overwrite:
        name, what = next(iter(changed.items()))
        raise CalibError(
            f"{len(changed)} of the results there {'was' if len(changed) == 1 else 'were'} made "
            f"from something else than the plan now says: {name} differs in {what}",
            where=str(results),
            expected="the plan, the data and the versions that the results there were made from",
            hint=f"{REPLACE}; these tasks are then done again",
        )
    for name in changed:
        # Without its record, a folder that a kill leaves half removed is not taken for a result.
        (results / name / _RECORD).unlink(missing_ok=True)
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
        return _RECORD
    return ", ".join(others)


def run_campaign(
    plan: Plan,
    out: Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> Summary:
    """Do every task of a plan that has no result yet.

    Parameters
    ----------
    out : Path
        Gets ``results/<task>/`` with ``numbers.json``, ``task.json`` (what it was made from) and
        the files of its kind; ``results/failed.json`` and ``results/seconds.csv``; a
        ``summary.json`` and for each kind of task a CSV; and a copy of the plan.
    workers, scheduler, progress, announce
        As for `calib.batch.tasks.run_tasks`. The results do not depend on them.
    overwrite : bool
        Do again what was made from other data, another plan or other versions.

    Returns
    -------
    Summary

    Raises
    ------
    CalibError
        If the folder is not one of a campaign, holds results of something else, or there is no
        such cluster.

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> plan = calib.read_plan(Path("plan.toml"))  # doctest: +SKIP
    >>> calib.run_campaign(plan, Path("results"), workers=2)  # doctest: +SKIP
    """
    out, results = Path(out), Path(out) / "results"
    check_names(plan.tasks)
    if (out / _PLAN).exists():
        check_room(out)
    else:
        check_folder(out)
    records = _records(plan.tasks.values())
    _discard_changed(records, results, overwrite=overwrite)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        (out / _PLAN).write_bytes(plan.text)

    def load(task: Task) -> _Item:
        return task.kind, task.seed, records[task.name], KINDS[task.kind].load(task)

    try:
        run_tasks(
            _work, plan.tasks, results, read=load, folders=True,
            workers=workers, scheduler=scheduler, progress=progress, announce=announce,
        )  # fmt: skip
    finally:
        # An interrupted campaign has a summary too.
        summary = _summarise(plan, results)
        _write_summary(summary, out)
    return summary


def _work(item: _Item) -> dict[str, str | bytes]:
    kind, seed, record, content = item
    found, files = KINDS[kind].work(content, seed)
    numbers = json.dumps(finite(found), indent=1, allow_nan=False) + "\n"
    return {**files, _NUMBERS: numbers, _RECORD: json.dumps(record, indent=1) + "\n"}
