"""Compare a report folder with the one that was made again from it: numbers, then files."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

from calib.batch.environment import Environment, sha256
from calib.check.derived import AUDIT_JSON, derived_files
from calib.check.figures import compare_figure, compare_pictures, compare_prints, thumbnails
from calib.check.inputs import GROUP as INPUTS
from calib.check.montecarlo import MONTE_CARLO, Place, count_drawn, drawn_in_output
from calib.check.numbers import SAME_WORDS, compare_entries, flatten, read_json
from calib.check.outcome import ROUNDED, Item, Status, mostly_different
from calib.check.posteriors import GROUP as POSTERIORS
from calib.check.posteriors import compare_posterior
from calib.check.schema import Manifest
from calib.check.text import GROUP as TEXT
from calib.check.text import compare_page, own_pictures
from calib.check.tolerances import ORDER_OF_MAGNITUDE
from calib.report.compared import FOLDER as COMPARED
from calib.report.study import Progress, Study, estimate_task
from calib.report.study_tasks import Task
from calib.report.summary import summarise_estimates

RECORD, SUMMARY = "manifest.json", "summary.json"
# What a manifest has about itself: durations, and hashes that are verified as such.
_NOT_COMPARED = ("seconds", "files", "left_out")
_VERIFIED = ("sha256", "shipped")
_POINTS = ("estimates", "fit", "by_pressure")
_CHAIN = ("posterior", "prior_sensitivity", "validation", "sampling")
_SEARCHES = ("(genetic", "(differential_evolution")
# Below this part of itself a number has only been rounded otherwise.
_ROUNDED_PART = 1e-6
_INPUTS = ("data/", "priors/")


@dataclass(frozen=True)
class Again:
    """A report folder and the same `made` again, which shows `study`."""

    manifest: Manifest
    folder: Path
    made: Path
    study: Study
    here: Environment

    @cached_property
    def same_program(self) -> bool:
        """Whether equal numbers must give equal words."""
        return self.manifest.environment.same_program(self.here)


def part_of(group: str) -> str:
    """Return the part of a report that a group of items belongs to: output, gap, or audit."""
    return group if group.startswith("gap: ") else group.partition(":")[0]


def is_document(name: str) -> bool:
    """Whether a file of a report is compared entry by entry, beside its summary."""
    diagnosed = name.startswith("gaps/") and name.endswith((".json", ".csv"))
    # What a corrected model predicts is held against its diagnosis (`derived`), and the mode of the
    # laboratory's rows, by which it predicts what was before, against that found again.
    return name == AUDIT_JSON or (diagnosed and not name.endswith("corrected.json"))


def count_numbers(study: Study) -> int:
    """Return how many numbers of a study follow from posterior draws."""
    results = study.successes.values()
    return sum(count_drawn(r.calibration, r.validation.scores.n) for r in results)


def compare_numbers(again: Again) -> list[Item]:
    """Return an item for each number of the summary, the manifest and the other documents."""
    recorded, made = (read_json(f / SUMMARY) for f in (again.folder, again.made))
    old, new = ({} if d is None else _entries(SUMMARY, d) for d in (recorded, made))
    items = compare_entries(old, new, _summary_group, _drawn(again.study, old))
    for key in again.manifest.tasks:
        items += _blame(again.manifest, key, items)
    items += _record(again)
    names = {p.relative_to(again.made).as_posix() for p in again.made.rglob("*") if p.is_file()}
    for name in sorted(filter(is_document, names)):
        items += _document(name, again)
    for name in sorted(n for n in names if n.endswith("/corrected.json")):
        items += _document(name, again, "lab_mode")
    return items


def compare_estimates(
    tasks: Iterable[Task], seed: int, summary: Mapping[str, Any], progress: Progress
) -> list[Item]:
    """Compare the point estimates alone, computed again without sampling."""
    items = []
    for task in tasks:
        place, recorded = (SUMMARY, "models", task.output), output_entry(summary, task.output)
        if "error" in recorded:
            note = "it failed; to see whether it does again, check without --quick"
            name = f"{SUMMARY}: {'.'.join(place[1:])}"
            items.append(Item(f"{task.output}: error", name, Status.UNJUDGED, note=note))
            continue
        estimates, by_pressure = estimate_task(task, seed, progress=progress)
        again = json.loads(json.dumps(summarise_estimates(estimates, by_pressure)))
        # The recorded posterior says how wide a parameter's scale is.
        scale = _entries(place, {"posterior": recorded.get("posterior", {})})
        points = {key: recorded.get(key, {}) for key in _POINTS}
        found = {**_entries(place, again), **scale}
        compared = compare_entries({**_entries(place, points), **scale}, found, _summary_group)
        items += [item for item in compared if ": posterior" not in item.group]
    return items


def output_entry(summary: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return what a summary says of an output; empty where it says nothing."""
    models = summary.get("models")
    found = models.get(key) if isinstance(models, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _entries(place: str | Place, document: Any) -> dict[Place, Any]:
    return dict(flatten(document, (place,) if isinstance(place, str) else place))


def _drawn(study: Study, recorded: Mapping[Place, Any]) -> dict[Place, float | None]:
    """What Monte Carlo error allows, by path in the summary."""
    n = count_numbers(study)
    found: dict[Place, float | None] = {}
    for key, result in study.successes.items():
        place = (SUMMARY, "models", key)
        steps = recorded.get((*place, "sampling", "steps"))
        sizes = drawn_in_output(result.calibration, result.validation, n, steps)
        found |= {(*place, *path): size for path, size in sizes.items()}
    return found


def _summary_group(path: Place) -> str:
    if path[1:2] == ("paper_gaps",):
        return f"gap: {path[2]}"
    if path[1:2] != ("models",):
        return SUMMARY
    key, *rest = path[2:]
    what = rest[0] if rest else ""
    if what == "by_pressure":
        return f"{key}: estimates ({' '.join(rest[1:3])})"
    if what in _POINTS:
        return f"{key}: estimates ({rest[1]})"
    # Posterior, scores and sampling figures come of the same draws.
    return f"{key}: posterior" if what in _CHAIN else f"{key}: what was computed"


def _blame(manifest: Manifest, key: str, items: list[Item]) -> list[Item]:
    """Name the input that the recorded numbers cannot have been computed from."""
    task = manifest.tasks[key]
    own = [item for item in items if part_of(item.group) == key]
    points = [item for item in own if ": estimates" in item.group]
    strict = [item for item in points if not any(search in item.group for search in _SEARCHES)]
    if mostly_different(strict):
        note = "most estimates in summary.json do not follow from these rows"
        return [Item(INPUTS, task.data.file, Status.DIFFERENT, note=note)]
    if mostly_different([item for item in own if ".sampling.mode." in item.name]):
        note = "the posterior mode in summary.json does not follow from these priors and the data"
        return [Item(INPUTS, task.priors.file, Status.DIFFERENT, note=note)]
    return []


def _record(again: Again) -> list[Item]:
    """Compare what the manifests say, beyond what was taken over from the first."""
    old, new = (_comparable(read_json(f / RECORD)) for f in (again.folder, again.made))
    return compare_entries(_entries(RECORD, old), _entries(RECORD, new), lambda _: RECORD)


def _comparable(manifest: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in manifest.items() if key not in _NOT_COMPARED}
    for task in kept.get("tasks", {}).values():
        for file in ("data", "priors"):
            task[file] = {k: v for k, v in task[file].items() if k not in _VERIFIED}
    return kept


def _document(name: str, again: Again, only: str = "") -> list[Item]:
    """Compare a document entry by entry, or what it has below one of its keys."""
    group = "audit" if name == AUDIT_JSON else f"gap: {name.split('/')[1]}"
    path = again.folder / name
    if not path.is_file():
        return [Item(group, name, Status.DIFFERENT, note="missing")]
    try:
        old = _entries(name, _part(_read(path), only))
    except (OSError, ValueError, RecursionError) as error:
        note = f"it cannot be read ({type(error).__name__})"
        return [Item(group, name, Status.DIFFERENT, note=note)]
    new = _entries(name, _part(_read(again.made / name), only))
    return compare_entries(old, new, lambda _: group)


def _part(document: Any, only: str) -> Any:
    if not only:
        return document
    return {only: document[only]} if isinstance(document, dict) and only in document else {}


def _read(path: Path) -> Any:
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".csv":
        return json.loads(text)
    rows = csv.DictReader(text.splitlines())
    return [{str(k): _cell(v) for k, v in row.items()} for row in rows]


def _cell(text: Any) -> Any:
    try:
        return float(text)
    except (TypeError, ValueError):
        return text


@dataclass(frozen=True)
class Moved:
    """Parts of a report with entries that moved by more than rounding.

    Those in which words may turn on what moved; and those with other numbers: these, and where the
    work merely took other steps.
    """

    readings: frozenset[str]
    numbers: frozenset[str]


def moved_parts(items: list[Item]) -> Moved:
    """Return the parts of a report with entries that moved by more than rounding."""
    moved = [item for item in items if _moved(item)]
    steps = [item for item in moved if item.note in (ORDER_OF_MAGNITUDE, SAME_WORDS)]
    return Moved(
        frozenset(part_of(item.group) for item in moved if item not in steps),
        frozenset(part_of(item.group) for item in moved),
    )


def _moved(item: Item) -> bool:
    if item.status is Status.IDENTICAL:
        return False
    if not isinstance(item.recorded, float) or not isinstance(item.found, float):
        return True
    if abs(item.recorded - item.found) <= _ROUNDED_PART * abs(item.found):
        return False
    drawn = item.note == MONTE_CARLO
    return not drawn or item.share is None or item.share > ROUNDED


def compare_files(again: Again, moved: Moved) -> list[Item]:
    """Return an item for each file but the manifest, the summary and what follows from them."""
    made = {p.relative_to(again.made).as_posix() for p in again.made.rglob("*") if p.is_file()}
    own = {RECORD, SUMMARY, *derived_files(dict.fromkeys(made, ""))}
    made = {n for n in made - own if not is_document(n) and not n.endswith("corrected.json")}
    pictures = cache(partial(thumbnails, again.made))
    prints = sorted(n for n in made if n.endswith(".pdf"))
    items = []
    for name in sorted(made - set(prints)):
        if name in again.manifest.left_out:
            items.append(_left_out_file(again.manifest.left_out[name], again, name))
        elif not (again.folder / name).is_file():
            items.append(_absent(again, name, "missing"))
        elif name.endswith(".nc"):
            items += compare_posterior(name, again.folder / name, again.made / name)
        elif name.endswith(".png"):
            old, new = ((folder / name).read_bytes() for folder in (again.folder, again.made))
            items.append(compare_figure(name, old, new, pictures))
        else:
            items += _text(again, name, moved)
    items += [_absent(again, n, "missing") for n in prints if not (again.folder / n).is_file()]
    there = [name for name in prints if (again.folder / name).is_file()]
    items += compare_prints(
        *({n: (folder / n).read_bytes() for n in there} for folder in (again.folder, again.made))
    )
    listed = set(again.manifest.files) - {SUMMARY, *derived_files(again.manifest.files)}
    if "comparison" in again.manifest.sections:
        # Checked as a folder of `calib compare`.
        listed = {name for name in listed if not name.startswith(f"{COMPARED}/")}
    strangers = sorted(n for n in listed - made if not (again.made / n).is_file())
    return items + [_absent(again, n, "this version makes no such file") for n in strangers]


def _absent(again: Again, name: str, note: str) -> Item:
    status = Status.DIFFERENT if again.same_program else Status.UNJUDGED
    return Item(TEXT, name, status, note=note)


def _text(again: Again, name: str, moved: Moved) -> list[Item]:
    def judged(section: str) -> tuple[str | None, bool]:
        if name.startswith(_INPUTS) or "/case/" in name:
            return None, True
        if not again.same_program:
            return "another version wrote it", False
        about = _about(again, name, section)
        why = "its numbers moved within their tolerance" if about & moved.readings else None
        return why, not about & moved.numbers

    items = [compare_page(name, again.folder, again.made, judged)]
    if name.endswith(".html") and items[0].status is not Status.IDENTICAL:
        folders = (again.folder, again.made)
        texts = [(f / name).read_text(encoding="utf-8", errors="replace") for f in folders]
        items += compare_pictures(name, *map(own_pictures, texts, folders))
    return items


def _about(again: Again, name: str, section: str) -> set[str]:
    """Return the parts of a report that a section of a page is about."""
    if name.startswith("gaps/"):
        return {f"gap: {name.split('/')[1]}"}
    tasks = set(again.manifest.tasks)
    gaps = {f"gap: {gap}" for gap in _names(again.manifest.sections.get("paper_gaps"))}
    parts: Mapping[str, set[str]] = {
        # A comparison's words are those of the manifest's own numbers.
        "paper-gaps": gaps, "audit": {"audit"}, "comparison": set(),
    }  # fmt: skip
    return parts.get(section, {section} & tasks or tasks)


def _left_out_file(recorded: str, again: Again, name: str) -> Item:
    if sha256((again.made / name).read_bytes()) == recorded:
        note = "left out on purpose; made again, it has the recorded hash"
        return Item(POSTERIORS, name, Status.IDENTICAL, note=note)
    note = "left out on purpose; its summary is compared"
    return Item(POSTERIORS, name, Status.UNJUDGED, note=note)


def _names(record: object) -> list[str]:
    return list(record) if isinstance(record, dict) else []
