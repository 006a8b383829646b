"""Compare a folder with the same made again, file by file, by what each is.

Documents entry by entry, each within its own tolerance; posteriors by what is beside their draws;
figures by their bytes; pages and other texts by their bytes, or by their words where numbers moved.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.environment import Environment
from calib.batch.pool import HERE
from calib.check.outcome import ROUNDED, Item, Status, claim
from calib.check.tolerances import (
    ARITHMETIC,
    MONTE_CARLO,
    ORDER_OF_MAGNITUDE,
    Entries,
    Tolerance,
    is_drawn,
    natural_scale,
    tolerance_of,
)
from calib.check.verify import (
    AUDIT,
    INPUTS,
    MANIFEST,
    SUMMARY,
    TEXT,
    differing_lines,
    named_pictures,
    own_pictures,
    read_text,
)
from calib.data import files
from calib.data.files import inside
from calib.errors import FAULTS, CalibError
from calib.inference.calibration import moments
from calib.inference.io import DRAWN, POSTERIOR, RUN, DrawsFile, read_draws, read_netcdf
from calib.inference.problem import Problem
from calib.models.base import Array
from calib.report.comparison import FILE as COMPARISON
from calib.report.study import Progress
from calib.validation.validate import Errors, Place

# What a record has about its own folder: durations, and hashes that are verified as such.
_OWN, _OF_FILES = ("seconds", "views", "files", "left_out", "sha256"), ("sha256", "shipped")
_POINTS = ("estimates", "fit", "by_pressure")
# Posterior, scores and sampling figures come of the same draws.
_CHAIN = ("posterior", "prior_sensitivity", "validation", "sampling", "gate", "mode",
          "log_evidence", "efficiency", "acceptance", "evaluations")  # fmt: skip
FIGURES, POSTERIORS, SAME_WORDS = "figures", "posteriors", "the same words"
# What is computed from the same draws in another order of summation agrees to this part.
_ROUNDED_PART = 1e-6
# Of the sd of what goes with draws: chains of the shortest run that passes the gate agree so far.
_OF_SD = 0.5
# Part of the draws that may fall on the wrong side of a bound when they are transformed back.
_AT_BOUNDS = 1e-3
_NUMBER = re.compile(
    r"[-+\u2212]?\d+(?:[.,]\d+)*(?:[eE][-+]?\d+|\u00d710[\u2070-\u2079\u00b2\u00b3\u00b9\u207b]+)?"
)
_PICTURE = re.compile(r"\[picture [^\]]*\]")
# Most entries by far; to ask whether they are an abstract collection takes longer than the rest.
_PLAIN = (float, str, int, type(None))
_ABSENT = object()


@dataclass(frozen=True)
class Job:
    """A folder to be checked, where it is made again (not there yet), and how."""

    folder: Path
    made: Path
    progress: Progress
    here: Environment
    quick: bool = False
    pool: Executor = HERE
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


def flatten(document: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield path and value of every entry of a JSON document.

    Those of a list are known by their ``name`` or ``key`` where each has its own, or by position.
    """
    if isinstance(document, _PLAIN):
        yield place, document
    elif isinstance(document, Mapping | list | tuple):
        named = document if isinstance(document, Mapping) else _named(document)
        for key, value in named.items():
            yield from flatten(value, (*place, str(key)))
    else:
        yield place, document


def _named(entries: Sequence[Any]) -> Mapping[Any, Any]:
    for key in ("name", "key") if entries and isinstance(entries[0], Mapping) else ():
        names = [inside(entry).get(key) for entry in entries]
        if None not in names and len(set(map(str, names))) == len(entries):
            return dict(zip(map(str, names), entries, strict=True))
    return dict(enumerate(entries))


def compare_entries(
    recorded: Entries, found: Entries, group_of: Callable[[Place], str],
    drawn: Errors | None = None,
) -> list[Item]:  # fmt: skip
    """Return one item for each entry, by path, the file first, of a document or a part of one.

    `drawn` is what Monte Carlo error allows, by path; None where there is no such error.
    """
    items = []
    for path in [*recorded, *(path for path in found if path not in recorded)]:
        name, group = f"{path[0]}: {'.'.join(path[1:])}", group_of(path)
        old, new = recorded.get(path, _ABSENT), found.get(path, _ABSENT)
        if _equal(old, new):
            items.append(Item(group, name, Status.IDENTICAL, old, new))
            continue
        tolerance = tolerance_of(path, found)
        beyond = Status.DIFFERENT if tolerance.judged else Status.UNJUDGED
        if old is _ABSENT:
            items.append(Item(group, name, beyond, found=new, note="missing"))
        elif new is _ABSENT:
            items.append(Item(group, name, beyond, old, note="not computed by this version"))
        elif _is_number(old) and type(old) is type(new):
            size = _size(tolerance, path, old, found, drawn or {})
            items.append(_number(Item(group, name, beyond, old, new, size, tolerance.kind)))
        elif tolerance.words and without_numbers(str(old)) == without_numbers(str(new)):
            items.append(Item(group, name, Status.WITHIN, old, new, note=SAME_WORDS))
        else:
            items.append(Item(group, name, beyond, old, new, note=tolerance.kind))
    return items


def _size(
    tolerance: Tolerance, path: Place, old: float, entries: Entries, errors: Errors
) -> float | None:
    """Largest difference that is taken for the same; None where none can be stated."""
    new = entries[path]
    if tolerance == ARITHMETIC and isinstance(new, int):
        return 0.0  # a count, or a seed
    scale = natural_scale(tolerance.of, path, entries, errors)
    if scale is not None and tolerance.of == "ratio":
        return float((tolerance.part - 1.0) * min(abs(old), abs(new)))
    return None if scale is None else tolerance.part * scale + tolerance.floor


def _number(item: Item) -> Item:
    """Judge two numbers that are not equal, given how they are judged beyond what is allowed."""
    old, new = item.recorded, item.found
    if math.isnan(old) or math.isnan(new):
        return replace(item, status=Status.DIFFERENT, allowed=None, note="not a number")
    rounded = 1e-6 * max(abs(old), abs(new)) if isinstance(old, float) else 0.0
    if abs(old - new) <= max(item.allowed or 0.0, rounded):
        return replace(item, status=Status.WITHIN)
    heavy = replace(item, status=Status.UNJUDGED, note="tail too heavy for a Monte Carlo error")
    return heavy if item.allowed is None else item


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _equal(old: Any, new: Any) -> bool:
    if isinstance(old, float) and isinstance(new, float) and math.isnan(old) and math.isnan(new):
        return True
    # 1 and True, or 1 and 1.0, are not the same entry.
    return type(old) is type(new) and bool(old == new)


def without_numbers(text: str) -> str:
    """Return a text with a sign in the place of each number."""
    return _NUMBER.sub("#", text)


def file(
    name: str, job: Job, *, sure: bool = True, same_draws: bool = True, exact: bool = True
) -> list[Item]:
    """Compare another file with the one made again.

    What differs is DIFFERENT if it is `sure` that the program is the same, and the draws are the
    same; of a figure, if all numbers are, to the last bit (`exact`).
    """
    old, new = job.folder / name, job.made / name
    if not old.is_file():
        return [claim(TEXT, name, "missing", sure=sure)]
    if name.endswith(".nc"):
        return [_posterior(name, old, new)]
    if name.endswith((".png", ".pdf")):
        return [_figure(name, old.read_bytes(), new.read_bytes(), sure=sure and exact)]
    item = _text(name, job, sure=sure, same_draws=same_draws, exact=exact)
    if item.status is Status.IDENTICAL:
        return [item]
    # The pictures that a page alone has, in their order.
    recorded, again = (own_pictures(read_text(f / name), f) for f in (job.folder, job.made))
    if len(recorded) != len(again):
        wrong = f"it has {len(recorded)} pictures of its own, not {len(again)}"
        return [item, claim(FIGURES, name, wrong, sure=sure)]
    pairs = enumerate(zip(recorded, again, strict=True), 1)
    pictures = [_figure(f"{name}: picture {i}", *pair, sure=sure and exact) for i, pair in pairs]
    return [item, *pictures]


def _figure(name: str, recorded: bytes, drawn: bytes, *, sure: bool) -> Item:
    wrong = "" if recorded == drawn else "it is not, byte for byte, the one drawn again"
    return claim(FIGURES, name, wrong, sure=sure)


def _text(name: str, job: Job, *, sure: bool, same_draws: bool, exact: bool) -> Item:
    """Compare a page or another text: by its bytes, or where numbers moved by its words."""
    if (job.folder / name).read_bytes() == (job.made / name).read_bytes():
        return Item(TEXT, name, Status.IDENTICAL)
    old, new = (named_pictures(folder, name) for folder in (job.folder, job.made))
    if old.splitlines() == new.splitlines():
        note = "the same but for its pictures, which are compared as figures, or its line ends"
        return Item(TEXT, name, Status.WITHIN, note=note)
    if _PICTURE.findall(old) != _PICTURE.findall(new):
        return claim(TEXT, name, "it shows other pictures, or in another order", sure=sure)
    if not exact and without_numbers(old).splitlines() == without_numbers(new).splitlines():
        return Item(TEXT, name, Status.WITHIN, note=SAME_WORDS)
    excuse = "" if same_draws else "its numbers moved within their tolerance: "
    excuse = excuse if sure else "another version wrote it: "
    said = differing_lines(old.splitlines(), new.splitlines())
    return claim(TEXT, name, f"{excuse}{said}", sure=sure and same_draws)


def exact(items: Iterable[Item]) -> bool:
    """Whether all numbers that are not different are the same to the last bit."""
    return not any(item.status in (Status.WITHIN, Status.UNJUDGED) for item in items)


def moved_parts(items: Iterable[Item]) -> set[str]:
    """Return the parts of a report with entries that moved by more than rounding."""
    counts = (i for i in items if i.note not in (ORDER_OF_MAGNITUDE, SAME_WORDS))
    return {part_of(item.group) for item in counts if _moved(item)}


def _moved(item: Item) -> bool:
    if item.status in (Status.IDENTICAL, Status.DIFFERENT):
        return False
    if not isinstance(item.recorded, float) or not isinstance(item.found, float):
        return True
    if abs(item.recorded - item.found) <= _ROUNDED_PART * abs(item.found):
        return False
    return item.note != MONTE_CARLO or item.share is None or item.share > ROUNDED


def summary_of(file: DrawsFile) -> dict[str, dict[str, float]]:
    """Return mean, sd, median and 95 % highest-density interval of each parameter."""
    return {name: moments(values.reshape(-1)) for name, values in file.draws.items()}


def verify_posterior(
    path: Path, problem: Callable[[], Problem], stated: Mapping[str, Any] | None = None
) -> list[Item]:
    """Hold a file of draws, if it is there, against its summary if stated, data and priors."""
    if not path.is_file():
        return []
    items = []
    try:
        file = read_draws(path)
        items += [] if stated is None else [_verify_summary(path.name, file, stated)]
        items.append(_verify_density(path.name, file, problem()))
    except CalibError as error:
        items.append(claim(POSTERIORS, path.name, error.message))
    except FAULTS as error:
        items.append(_unread(path.name, error))
    return items


def _unread(name: str, error: Exception) -> Item:
    return claim(POSTERIORS, name, f"the file cannot be read ({type(error).__name__}: {error})")


def _verify_summary(name: str, file: DrawsFile, stated: Mapping[str, Any]) -> Item:
    """Check that a file's draws have the summary that is stated of them."""
    for parameter, values in summary_of(file).items():
        for key, value in values.items():
            given = inside(stated, parameter).get(key)
            if not isinstance(given, int | float) or not math.isclose(
                given, value, rel_tol=_ROUNDED_PART, abs_tol=_ROUNDED_PART * values["sd"]
            ):
                # Which of the two is wrong is for the sampling to say.
                both, note = f"summary.json and {name}", f"{key} of {parameter} is not the same"
                return Item(POSTERIORS, both, Status.DIFFERENT, given, value, note=note)
    return claim(POSTERIORS, name, "", "its draws have the summary that is stated")


def _verify_density(name: str, file: DrawsFile, problem: Problem) -> Item:
    """Check that draws have the density of data and priors, and derived ones follow from them."""
    stated = file.log_prob.reshape(-1)
    natural = problem.priors.stack(file.draws, stated.shape)
    with np.errstate(all="ignore"):
        t = problem.priors.to_internal(natural, margin=0.0)
        derived = problem.bound.report(problem.of_model(natural))
    for key, values in derived.items():
        said = file.draws.get(key, values)
        if not np.allclose(said.reshape(-1), values, rtol=_ROUNDED_PART, atol=0.0, equal_nan=True):
            return claim(POSTERIORS, name, f"{key} does not follow from the other parameters")
    computed = problem.log_prob(t)
    close = np.abs(computed - stated) <= _ROUNDED_PART * (1.0 + np.abs(stated))
    if np.mean(close) < 1.0 - _AT_BOUNDS:
        pair = float(stated[close.argmin()]), float(computed[close.argmin()])
        note = "the log density of its draws is not what data and priors give"
        return Item(POSTERIORS, name, Status.DIFFERENT, *pair, note=note)
    return claim(POSTERIORS, name, "", "its draws have the density of data and priors")


def _posterior(name: str, recorded: Path, drawn: Path) -> Item:
    """Compare what is beside the posterior draws in a file with the same written again.

    It may be apart by a part of its own sd. Draws are held against their summary and density.
    """
    if recorded.read_bytes() == drawn.read_bytes():
        return Item(POSTERIORS, name, Status.IDENTICAL)
    try:
        old, new = (_groups(path) for path in (recorded, drawn))
    except FAULTS as error:
        return _unread(name, error)
    apart = [key for key in {**old, **new} if not _same_values(old.get(key), new.get(key))]
    if apart:
        wrong = f"{', '.join(sorted(apart)[:3])} in it: not what is written again"
        return claim(POSTERIORS, name, wrong)
    return Item(POSTERIORS, name, Status.WITHIN, note="its draws are compared by their summary")


def _groups(path: Path) -> dict[str, Array]:
    """Read every variable of a file by its path; of drawn ones, median and sd by row."""
    found: dict[str, Array] = {}
    for node in read_netcdf(path).leaves:
        for name, variable in node.data_vars.items():
            x = variable.to_numpy().astype(np.float64)
            if variable.dims[:2] == DRAWN:
                draws = x.reshape(x.shape[0] * x.shape[1], -1)
                # Whatever their tails.
                low, median, high = np.quantile(draws, [0.16, 0.5, 0.84], axis=0)
                x = np.stack([median, 0.5 * (high - low)])
            found[f"{node.name}/{name}"] = x
    return found


def _same_values(old: Array | None, new: Array | None) -> bool:
    if old is None or new is None or old.shape != new.shape:
        return False
    if old.ndim == 2 and old.shape[0] == 2:
        return bool(
            (np.abs(old - new) <= _OF_SD * np.maximum(new[1], old[1]) + _ROUNDED_PART).all()
        )
    scale = max(float(np.abs(new).max(initial=0.0)), 1e-300)
    return bool(
        np.allclose(old, new, rtol=_ROUNDED_PART, atol=_ROUNDED_PART * scale, equal_nan=True)
    )
