"""Compare a report folder with the one that was made again from it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from calib.reproduce.allowances import (
    Allowance,
    count_drawn,
    estimate_allowances,
    output_allowances,
)
from calib.reproduce.compare_documents import gap_group
from calib.reproduce.compare_files import RECORD, SUMMARY, Again, compare_files
from calib.reproduce.inputs import GROUP as INPUTS
from calib.reproduce.items import Item, Status
from calib.reproduce.montecarlo import Place
from calib.reproduce.numbers import Section, compare_section, flatten, read_json
from calib.reproduce.schema import Manifest
from calib.reproduce.stated import gap_allowances, sensitivity_allowances
from calib.study import OutputResult, Progress, Study, estimate_task
from calib.study_tasks import Task
from calib.summary import summarise_estimates

__all__ = [
    "compare_estimates", "compare_report", "count_numbers", "entry",
]  # fmt: skip

# What a manifest has about itself: durations, and hashes that are verified as such.
_NOT_COMPARED = ("seconds", "files", "left_out")
_VERIFIED = ("sha256", "shipped")
_POINTS = ("estimates", "fit", "by_pressure")
_CHAIN = ("posterior", "prior_sensitivity", "validation", "sampling")
_HEAD = ("schema", "seed")
_SET_UP = ("model", "output", "data", "references", "priors", "error")
_KNOWN = (*_POINTS, *_CHAIN, *_SET_UP)
_GAPS = "paper_gaps"
# Of what is set up, only the last bits may differ.
_SET_UP_PART = 1e-9
_NO_RULE = Allowance(why="no allowance is stated for it")
_SEARCHES = ("genetic", "differential_evolution")


def count_numbers(study: Study) -> int:
    """Return how many numbers of a study follow from posterior draws."""
    results = study.successes.values()
    return sum(count_drawn(r.calibration, r.validation.scores.n) for r in results)


def compare_report(again: Again, summary: Mapping[str, Any]) -> list[Item]:
    """Return an item for each number and file that could be compared.

    Parameters
    ----------
    again : Again
    summary : mapping
        The recorded `summary.json`.
    """
    made = read_json(again.made / SUMMARY)
    exact: dict[str, bool] = {}
    items = []
    for key, part in _outputs(made).items():
        section = _section(("models", key), entry(summary, key), part)
        exact[key] = section.exact
        numbers = compare_section(
            section, _allowances(again.study, key, section), group_of=_grouped(key)
        )
        items += numbers + _blame(again.manifest, key, numbers)
    for name in _gaps(made):
        numbers, exact[gap_group(name)] = _compare_gap(summary, made, name)
        items += numbers
    for key in dict.fromkeys([*summary, *made]):
        if key not in ("models", _GAPS):
            section = _section((key,), summary.get(key), made.get(key))
            exact[key] = section.exact
            head = key in _HEAD
            items += compare_section(
                section, _no_rules(section, ()), group_of=_always(SUMMARY if head else key),
                exact=head or None,
            )  # fmt: skip
    if summary and set(_outputs(summary)) != set(_outputs(made)):
        items.append(Item(SUMMARY, SUMMARY, Status.DIFFERENT, note="it has other outputs"))
    if summary and set(_gaps(summary)) != set(_gaps(made)):
        items.append(Item(SUMMARY, SUMMARY, Status.DIFFERENT, note="it has other gaps"))
    items += _record(again)
    alone = all(item.status is Status.IDENTICAL for item in items)
    if alone and _bytes(again.folder / SUMMARY) != _bytes(again.made / SUMMARY):
        note = "the same numbers in another form than it is written in"
        items.append(Item(SUMMARY, SUMMARY, Status.DIFFERENT, note=note))
    best = {name: str(gap["best"]) for name, gap in _gaps(made).items()}
    return items + compare_files(again, exact, best)


def compare_estimates(
    tasks: Iterable[Task], seed: int, summary: Mapping[str, Any], progress: Progress
) -> list[Item]:
    """Compare the point estimates alone, computed again without sampling."""
    items = []
    for task in tasks:
        key = task.output
        recorded = entry(summary, key)
        if "error" in recorded:
            note = "it failed; to see whether it does again, check without --quick"
            items.append(Item(f"{key}: error", f"{SUMMARY}: models.{key}", Status.UNJUDGED,
                              note=note))  # fmt: skip
            continue
        estimates, by_pressure = estimate_task(task, seed, progress=progress)
        found = json.loads(json.dumps(summarise_estimates(estimates, by_pressure)))
        section = _section(
            ("models", key), {name: recorded.get(name, {}) for name in _POINTS}, found
        )
        allowances = estimate_allowances(estimates, by_pressure, None)
        items += compare_section(section, allowances, group_of=_grouped(key))
    return items


def _compare_gap(
    summary: Mapping[str, Any], made: Mapping[str, Any], name: str
) -> tuple[list[Item], bool]:
    new = _gaps(made)[name]
    section = _section((_GAPS, name), _gaps(summary).get(name), new)
    allowances = gap_allowances({**section.recorded, **section.found}, str(new["best"]))
    items = compare_section(section, allowances, group_of=_always(gap_group(name)))
    return items, section.exact


def _gaps(summary: Mapping[str, Any]) -> Mapping[str, Any]:
    gaps = summary.get(_GAPS)
    return gaps if isinstance(gaps, Mapping) else {}


def _outputs(summary: Mapping[str, Any]) -> Mapping[str, Any]:
    models = summary.get("models")
    return models if isinstance(models, Mapping) else {}


def entry(summary: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return what a summary says of an output; empty where it says nothing."""
    found = _outputs(summary).get(key)
    return found if isinstance(found, Mapping) else {}


def _section(place: Place, recorded: Any, found: Any) -> Section:
    old, new = ({} if part is None else dict(flatten(part)) for part in (recorded, found))
    return Section(SUMMARY, place, old, new)


def _allowances(study: Study, key: str, section: Section) -> dict[Place, Allowance]:
    result = study.results[key]
    rules = _no_rules(section, _KNOWN)
    rules |= {
        path: Allowance(_SET_UP_PART * abs(value), why="it follows from the data")
        for path, value in section.found.items()
        if path[:1] and path[0] in _SET_UP and isinstance(value, int | float)
    }
    if isinstance(result, OutputResult):
        paths = {**section.recorded, **section.found}
        rules |= output_allowances(result, count_numbers(study), section.recorded, paths)
        rules |= sensitivity_allowances(section.found)
    return rules


def _no_rules(section: Section, known: tuple[str, ...]) -> dict[Place, Allowance]:
    """Text of sections that other parts of the package add may depend on draws."""
    every = {**section.recorded, **section.found}
    return {
        path: _NO_RULE
        for path, value in every.items()
        if path[:1] not in {(name,) for name in known} and not isinstance(value, int | float)
    }


def _always(group: str) -> Callable[[Place], str]:
    return lambda _: group


def _grouped(key: str) -> Callable[[Place], str]:
    def group(path: Place) -> str:
        if not path or path[0] in _SET_UP:
            return f"{key}: what was computed"
        if path[0] not in (*_POINTS, *_CHAIN):
            return f"{key}: {path[0]}"
        if path[0] == "by_pressure":
            return f"{key}: estimates ({' '.join(path[1:3])})"
        # Posterior, scores and sampling figures come of the same draws.
        return f"{key}: estimates ({path[1]})" if path[0] in _POINTS else f"{key}: posterior"

    return group


def _blame(manifest: Manifest, key: str, items: list[Item]) -> list[Item]:
    """Name the input that the recorded numbers cannot have been computed from."""
    task = manifest.tasks[key]
    strict = [
        item
        for item in items
        if item.group.startswith(f"{key}: estimates")
        and not any(search in item.group for search in _SEARCHES)
    ]
    if _mostly_different(strict):
        note = "most estimates in summary.json do not follow from these rows"
        return [Item(INPUTS, task.data.file, Status.DIFFERENT, note=note)]
    if _mostly_different([item for item in items if ".sampling.mode." in item.name]):
        note = "the posterior mode in summary.json does not follow from these priors and the data"
        return [Item(INPUTS, task.priors.file, Status.DIFFERENT, note=note)]
    return []


def _mostly_different(items: list[Item]) -> bool:
    numbers = [item for item in items if isinstance(item.recorded, float)]
    different = sum(item.status is Status.DIFFERENT for item in numbers)
    return different > 0.5 * len(numbers)


def _record(again: Again) -> list[Item]:
    """Compare what the manifests say, beyond what was taken over from the first."""
    recorded, made = (_comparable(read_json(f / RECORD)) for f in (again.folder, again.made))
    section = Section(RECORD, (), dict(flatten(recorded)), dict(flatten(made)))
    return compare_section(section, {}, exact=again.same_program, group_of=_always(RECORD))


def _comparable(manifest: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in manifest.items() if key not in _NOT_COMPARED}
    for task in kept.get("tasks", {}).values():
        for file in ("data", "priors"):
            task[file] = {k: v for k, v in task[file].items() if k not in _VERIFIED}
    return kept


def _bytes(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""
