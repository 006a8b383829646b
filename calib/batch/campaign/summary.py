"""The summary of a campaign: every task, its state and its key numbers, as JSON and CSV.

Nothing in it depends on how long the work took or where it was done: two campaigns of one plan
give the same bytes. How long each task took is in ``results/seconds.csv``.
"""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from calib.batch.campaign.plan import Plan
from calib.batch.folders import write_whole
from calib.batch.tasks import failed_tasks

NUMBERS = "numbers.json"
SCHEMA = "calib/campaign/1"

type State = Literal["done", "failed", "missing"]


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

    def state(self, name: str) -> State:
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


def summarise(plan: Plan, results: Path) -> Summary:
    """Read what there is of a campaign."""
    numbers = {}
    for name in plan.tasks:
        path = results / name / NUMBERS
        if path.exists():
            numbers[name] = json.loads(path.read_bytes())
    failed = {n: e for n, e in failed_tasks(results).items() if n in plan.tasks}
    return Summary({n: task.kind for n, task in plan.tasks.items()}, numbers, failed)


def write_summary(summary: Summary, folder: Path) -> None:
    """Write ``summary.json``, and for every kind of task a CSV of its name with a row for each."""
    document = {
        "schema": SCHEMA,
        "counts": summary.counts,
        "tasks": {name: _entry(summary, name) for name in summary.kinds},
    }
    write_whole(folder / "summary.json", json.dumps(document, indent=1) + "\n")
    for kind in dict.fromkeys(summary.kinds.values()):
        names = [name for name, its in summary.kinds.items() if its == kind]
        write_whole(folder / f"{kind}.csv", _table(summary, names))


def _entry(summary: Summary, name: str) -> dict[str, Any]:
    entry: dict[str, Any] = {"kind": summary.kinds[name], "state": summary.state(name)}
    if name in summary.failed:
        entry["error"] = summary.failed[name]
    return entry | {"numbers": summary.numbers[name]} if name in summary.numbers else entry


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
