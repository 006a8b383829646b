"""Compare a folder with the same made again, file by file, by what each is."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calib.batch.environment import Environment
from calib.batch.pool import HERE, Pool
from calib.check.figures import GROUP as FIGURES
from calib.check.figures import compare_figure
from calib.check.outcome import ROUNDED, Item, Status, claim
from calib.check.posteriors import compare_posterior, summary_of
from calib.check.text import GROUP as TEXT
from calib.check.text import (
    NUMBER,
    SAME_WORDS,
    Judged,
    Judgement,
    compare_entries,
    compare_page,
    flatten,
    own_pictures,
    parsed,
    read_text,
)
from calib.check.tolerances import MONTE_CARLO, ORDER_OF_MAGNITUDE, is_drawn
from calib.check.verify import AUDIT, INPUTS, MANIFEST, SUMMARY
from calib.data import files
from calib.data.files import inside
from calib.errors import FAULTS, CalibError
from calib.inference.io import read_draws
from calib.inference.record import POSTERIOR, RUN
from calib.report.comparison import FILE as COMPARISON
from calib.report.study import Progress
from calib.validation.validate import Errors, Place

# What a record has about its own folder: durations, and hashes that are verified as such.
_OWN, _OF_FILES = ("seconds", "views", "files", "left_out", "sha256"), ("sha256", "shipped")
_POINTS = ("estimates", "fit", "by_pressure")
# Posterior, scores and sampling figures come of the same draws.
_CHAIN = ("posterior", "prior_sensitivity", "validation", "sampling", "gate", "mode",
          "log_evidence", "efficiency", "acceptance", "evaluations")  # fmt: skip
# Below this part of itself a number has only been rounded otherwise.
_ROUNDED_PART = 1e-6


@dataclass(frozen=True)
class Job:
    """A folder to be checked, where it is made again (not there yet), and how."""

    folder: Path
    made: Path
    progress: Progress
    here: Environment
    quick: bool = False
    pool: Pool = HERE
    workers: int = 1

    def inside(self, name: str) -> Job:
        """Return the job of a folder in it."""
        return replace(self, folder=self.folder / name, made=self.made / name)


@contextmanager
def not_computed(items: list[Item], folder: Path, record: str) -> Iterator[None]:
    """Turn whatever stops the work into one more item.

    The record is somebody else's: what it makes fail is a finding, with what was found before.
    """
    try:
        yield
    except Exception as error:
        where, why = record, f"{type(error).__name__}: {error}"
        if isinstance(error, CalibError):
            path, why = Path((error.where or "").partition(",")[0]), error.message
            where = path.relative_to(folder).as_posix() if path.is_relative_to(folder) else record
        items.append(claim(INPUTS, where, f"not computed again: {why}"))


def within(folder: str, group: str, items: Iterable[Item]) -> list[Item]:
    """Name items after the folder, inside the one that is checked, in which they were found."""
    return [
        replace(item, name=f"{folder}/{item.name}", group=f"{group}: {item.group}")
        for item in items
    ]


def is_document(name: str) -> bool:
    """Whether a file is compared entry by entry."""
    of_gap = name.startswith("gaps/") and name.endswith((".json", ".csv"))
    return of_gap or name in (SUMMARY, MANIFEST, AUDIT, COMPARISON, RUN)


def group_of(place: Place) -> str:
    """Return what an entry belongs to, by its path, the file first."""
    file, *keys = place
    if file.startswith("gaps/"):
        return f"gap: {file.split('/')[1]}"
    if file == SUMMARY and keys[:1] == ["paper_gaps"]:
        return f"gap: {keys[1]}"
    owner = ""
    if file == SUMMARY and keys[:1] == ["models"]:
        owner, keys = f"{keys[1]}: ", keys[2:]
    elif file != RUN:
        return file.removesuffix(".json") if file in (AUDIT, COMPARISON) else file
    what = keys[0] if keys else ""
    if what in _POINTS:
        return f"{owner}estimates"
    return f"{owner}posterior" if what in _CHAIN else f"{owner}what was computed"


def part_of(group: str) -> str:
    """Return the part of a report that a group of items belongs to: output, gap, or audit."""
    return group if group.startswith("gap: ") else group.partition(":")[0]


def read_entries(folder: Path, name: str) -> dict[Place, Any]:
    """Return the entries of a document that are compared; with a run's the summary of its draws."""
    text = files.read_text(folder / name)
    if name.endswith(".csv"):
        rows = csv.DictReader(text.splitlines())
        document: Any = [{str(k): _cell(v) for k, v in row.items()} for row in rows]
    else:
        document = json.loads(text)
    if name.endswith("/corrected.json"):
        # Its predictions are held against its diagnosis; these by the laboratory's mode are not.
        document = {"lab_mode": inside(document, "lab_mode")}
    if name == RUN:
        with suppress(*FAULTS):
            document["posterior"] = summary_of(read_draws(folder / POSTERIOR))
    return {place: value for place, value in flatten(document, (name,)) if _compared(*place)}


def _cell(text: Any) -> Any:
    with suppress(TypeError, ValueError):
        return float(text)
    return text


def _compared(file: str, first: str = "", *more: str) -> bool:
    if file == MANIFEST and first == "tasks":
        return more[-1] not in _OF_FILES
    # A run's verdict is on rows that were held out as well, which it does not keep.
    own = (*_OWN, "verdict") if file == RUN else _OWN
    return file not in (MANIFEST, RUN, COMPARISON) or first not in own


def count_drawn(made: Path) -> int:
    """Return how many numbers of a folder made again follow from posterior draws."""
    there = [name for name in (SUMMARY, COMPARISON, RUN) if (made / name).is_file()]
    return sum(is_drawn(place) for name in there for place in read_entries(made, name))


def estimates(job: Job, place: Place, found: Mapping[str, Any]) -> list[Item]:
    """Compare point estimates alone, below a place of a document, within what is recorded there."""
    group, recorded = group_of((*place, "estimates")), read_entries(job.folder, place[0])
    others = {path: value for path, value in recorded.items() if group_of(path) != group}
    again = dict(flatten(json.loads(json.dumps(found)), place))
    items = compare_entries(recorded, others | again, group_of)
    return [item for item in items if item.group == group]


def document(name: str, job: Job, drawn: Errors | None = None) -> list[Item]:
    """Compare a document entry by entry; `drawn` is what Monte Carlo error allows."""
    try:
        old = read_entries(job.folder, name)
    except FAULTS as error:
        wrong = f"it cannot be read ({type(error).__name__})"
        return [claim(group_of((name,)), name, wrong)]
    return compare_entries(old, read_entries(job.made, name), group_of, drawn)


def file(
    name: str, job: Job, judged: Judged = lambda section: Judgement(), *, sure: bool = True
) -> list[Item]:
    """Compare another file with the one made again; a page is `judged` as by `compare_page`.

    Where it is missing, that is a difference if it is `sure` that it must be there.
    """
    old, new = job.folder / name, job.made / name
    if not old.is_file():
        return [claim(TEXT, name, "missing", sure=sure)]
    if name.endswith(".nc"):
        return [compare_posterior(name, old, new)]
    if name.endswith((".png", ".pdf")):
        drawn = {p.relative_to(job.made).as_posix(): p for p in job.made.rglob(f"*{new.suffix}")}
        return [compare_figure(name, old.read_bytes(), drawn)]
    items = [compare_page(name, job.folder, job.made, judged)]
    if items[0].status is Status.IDENTICAL:
        return items
    # The pictures that a page alone has, in their order.
    recorded, again = (own_pictures(read_text(f / name), f) for f in (job.folder, job.made))
    if len(recorded) != len(again):
        wrong = f"it has {len(recorded)} pictures of its own, not {len(again)}"
        return [*items, claim(FIGURES, name, wrong)]
    named = {f"{name}: picture {i + 1}": picture for i, picture in enumerate(again)}
    pairs = zip(named, recorded, strict=True)
    return items + [compare_figure(picture, shown, named) for picture, shown in pairs]


def moved_parts(items: Iterable[Item]) -> tuple[set[str], dict[str, float]]:
    """Return the parts of a report with entries that moved by more than rounding.

    Those in which words may turn on what moved; and by how much numbers did in any, also where the
    work merely took other steps.
    """
    moved = [item for item in items if _moved(item)]
    read = [item for item in moved if item.note not in (ORDER_OF_MAGNITUDE, SAME_WORDS)]
    sizes: dict[str, float] = {}
    for item in moved:
        part = part_of(item.group)
        sizes[part] = max(sizes.get(part, 0.0), _part_moved(item))
    return {part_of(item.group) for item in read}, sizes


def _part_moved(item: Item) -> float:
    """By what part of it the number in an item moved, or that of a text which did most."""
    old, new = (NUMBER.findall(str(value)) for value in (item.recorded, item.found))
    pairs = [(parsed(a)[0], parsed(b)[0]) for a, b in zip(old, new, strict=False) if a != b]
    parts = [abs(a - b) / max(abs(a), abs(b), 1e-300) for a, b in pairs]
    return max(parts, default=0.0) if len(old) == len(new) else math.inf


def _moved(item: Item) -> bool:
    if item.status is Status.IDENTICAL:
        return False
    if not isinstance(item.recorded, float) or not isinstance(item.found, float):
        return True
    if abs(item.recorded - item.found) <= _ROUNDED_PART * abs(item.found):
        return False
    return item.note != MONTE_CARLO or item.share is None or item.share > ROUNDED
