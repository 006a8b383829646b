"""Compare a folder with the same made again, file by file, by what each is.

Documents entry by entry, each within its own tolerance; posteriors by what is beside their draws;
figures by their bytes; pages and other texts by their bytes, or by their words where numbers moved.
"""

from __future__ import annotations

import base64
import binascii
import csv
import difflib
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.environment import Environment, sha256, unix_lines
from calib.batch.pool import HERE
from calib.checking.tolerances import (
    MONTE_CARLO,
    ORDER_OF_MAGNITUDE,
    Entries,
    allowed_difference,
    is_drawn,
    tolerance_of,
)
from calib.data import files
from calib.data.files import decoded, inside
from calib.errors import FAULTS, CalibError
from calib.gap.document import FILE as GAP_DOCUMENT
from calib.inference.calibration import moments
from calib.inference.io import DRAWN, POSTERIOR, RUN, DrawsFile, read_draws, read_netcdf
from calib.inference.joint_files import JOINT, read_joint_draws
from calib.inference.problem import Problem
from calib.models.base import Array
from calib.report.comparison import FILE as COMPARISON
from calib.report.comparison import FOLDER as COMPARED
from calib.report.study import Progress
from calib.validation.validate import Errors, Place

MANIFEST, SUMMARY, AUDIT, PAGE = "manifest.json", "summary.json", "audit.json", "index.html"
# Groups of items.
TEXT, FIGURES, POSTERIORS, INPUTS = "page and tables", "figures", "posteriors", "data and priors"
LINE_ENDS = "the same but for its line ends"
# The same draws, summed in another order, agree to this part.
_ROUNDED = 1e-6
_ABSENT = object()
_NUMBER = re.compile(
    r"[-+\u2212]?\d+(?:[.,]\d+)*(?:[eE][-+]?\d+|\u00d710[\u2070-\u2079\u00b2\u00b3\u00b9\u207b]+)?"
)


class Status(StrEnum):
    """How something recorded compares with the same computed again."""

    IDENTICAL = "identical"
    WITHIN = "within tolerance"
    DIFFERENT = "different"
    UNJUDGED = "not judged"


@dataclass(frozen=True)
class Item:
    """One thing that was compared: a file, the path of a number in it, or a claim.

    `allowed` is the largest difference allowed. None stands where there is no number to show.
    """

    group: str
    name: str
    status: Status
    recorded: Any = None
    found: Any = None
    allowed: float | None = None
    note: str = ""

    @property
    def share(self) -> float | None:
        """Difference over the allowed one; None where either is missing."""
        numbers = all(isinstance(v, int | float) for v in (self.recorded, self.found))
        return abs(self.recorded - self.found) / self.allowed if self.allowed and numbers else None

    @property
    def other_draws(self) -> bool:
        """Whether it follows from other random draws than those recorded: not only rounding."""
        return self.note == MONTE_CARLO and self.share is not None and self.share > 1e-3


def claim(group: str, name: str, wrong: str, right: str = "", *, sure: bool = True) -> Item:
    """Return an item for what is `wrong`, if that is `sure`; if nothing is, for what is `right`."""
    if not wrong:
        return Item(group, name, Status.IDENTICAL, note=right)
    return Item(group, name, Status.DIFFERENT if sure else Status.UNJUDGED, note=wrong)


def within(folder: str, group: str, items: Iterable[Item]) -> list[Item]:
    """Name items after the folder, inside the one that is checked, in which they were found."""
    return [replace(i, name=f"{folder}/{i.name}", group=f"{group}: {i.group}") for i in items]


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
    effects: Path | None = None

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


# Documents


def is_document(name: str) -> bool:
    """Whether a file is compared entry by entry."""
    if name.startswith("gaps/"):
        return name.endswith((".json", ".csv")) and not name.endswith(f"/{GAP_DOCUMENT}")
    return name in (SUMMARY, MANIFEST, AUDIT, COMPARISON, RUN, JOINT)


def _group_of(place: Place) -> str:
    """Return what an entry belongs to, by its path, the file first."""
    file, *keys = place
    if file.startswith("gaps/"):
        return f"gap: {file.split('/')[1]}"
    if file == SUMMARY and keys[:1] == ["paper_gaps"]:
        return f"gap: {keys[1]}"
    owner = ""
    if file == SUMMARY and keys[:1] == ["models"]:
        owner, keys = f"{keys[1]}: ", keys[2:]
    elif file not in (RUN, JOINT):
        return file if file in (MANIFEST, SUMMARY) else file.partition(".")[0]
    drawn = {"posterior", "prior_sensitivity", "validation", "sampling", "gate", "mode"}
    drawn |= {"log_evidence", "efficiency", "acceptance", "evaluations"}
    if keys and keys[0] in ("estimates", "fit", "by_pressure"):
        return f"{owner}estimates"
    if keys and keys[0] in drawn:
        return f"{owner}posterior"
    return f"{owner}what was computed"


def read_entries(folder: Path, name: str) -> dict[Place, Any]:
    """Return the entries of a document that are compared; with a run's the summary of its draws."""
    text = files.read_text(folder / name)
    if name.endswith(".csv"):
        rows = csv.DictReader(text.splitlines())
        document: Any = [{str(k): _cell(v) for k, v in row.items()} for row in rows]
    else:
        document = json.loads(text)
    if name.endswith("corrected.json"):
        # Its predictions are held against its diagnosis; these by the laboratory's mode are not.
        document = {"lab_mode": inside(document, "lab_mode")}
    if name in (RUN, JOINT):
        read = read_draws if name == RUN else read_joint_draws
        with suppress(*FAULTS):
            document["posterior"] = summary_of(read(folder / POSTERIOR))
    return {place: value for place, value in flatten(document, (name,)) if _is_compared(*place)}


def _cell(text: Any) -> Any:
    with suppress(TypeError, ValueError):
        return float(text)
    return text


def _is_compared(file: str, first: str = "", *more: str) -> bool:
    """Whether an entry is not about the folder itself: durations, and hashes verified as such."""
    if file == MANIFEST and first == "tasks":
        return more[-1] not in ("sha256", "shipped")
    if "seconds" in (first, *more[-1:]):
        return False
    # A run's verdict is on rows that were held out as well, which it does not keep.
    own = ("views", "files", "left_out", "sha256")
    return file not in (MANIFEST, RUN, COMPARISON, JOINT) or not (
        first in own or (file in (RUN, JOINT) and first == "verdict")
    )


def count_drawn(made: Path) -> int:
    """Return how many numbers of a folder made again follow from posterior draws."""
    there = [name for name in (SUMMARY, COMPARISON, RUN, JOINT) if (made / name).is_file()]
    return sum(is_drawn(place) for name in there for place in read_entries(made, name))


def flatten(document: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield path and value of every entry of a JSON document.

    Those of a list are known by their ``name`` or ``key`` where each has its own, or by position.
    """
    if isinstance(document, list | tuple):
        document = _named(document)
    if isinstance(document, dict):
        for key, value in document.items():
            yield from flatten(value, (*place, str(key)))
    else:
        yield place, document


def _named(entries: Sequence[Any]) -> dict[Any, Any]:
    for key in ("name", "key"):
        names = [str(entry[key]) for entry in entries if isinstance(entry, dict) and key in entry]
        if entries and len(set(names)) == len(entries):
            return dict(zip(names, entries, strict=True))
    return dict(enumerate(entries))


def document(name: str, job: Job, errors: Errors | None = None) -> list[Item]:
    """Compare a document entry by entry; `errors` is what Monte Carlo error allows."""
    try:
        old = read_entries(job.folder, name)
    except FAULTS as error:
        wrong = f"it cannot be read ({type(error).__name__})"
        return [claim(_group_of((name,)), name, wrong)]
    if not (job.made / name).is_file():
        return [claim(_group_of((name,)), name, "not computed by this version")]
    return compare_entries(old, read_entries(job.made, name), errors)


def estimates(job: Job, place: Place, found: Mapping[str, Any]) -> list[Item]:
    """Compare point estimates alone, below a place of a document, within what is recorded there."""
    group, recorded = _group_of((*place, "estimates")), read_entries(job.folder, place[0])
    others = {path: value for path, value in recorded.items() if _group_of(path) != group}
    again = dict(flatten(json.loads(json.dumps(found)), place))
    return [item for item in compare_entries(recorded, others | again) if item.group == group]


def compare_entries(recorded: Entries, found: Entries, errors: Errors | None = None) -> list[Item]:
    """Return one item for each entry, by path, the file first, of a document or a part of one.

    `errors` is what Monte Carlo error allows, by path; None where there is no such error.
    """
    items = []
    for path in dict.fromkeys([*recorded, *found]):
        old, new = recorded.get(path, _ABSENT), found.get(path, _ABSENT)
        name = f"{path[0]}: {'.'.join(path[1:])}"
        item = Item(_group_of(path), name, Status.IDENTICAL, old, new)
        if not _equal(old, new):
            tolerance = tolerance_of(path, found)
            beyond = Status.DIFFERENT if tolerance.judged else Status.UNJUDGED
            item = replace(item, status=beyond, note=tolerance.kind)
            if old is _ABSENT:
                item = replace(item, recorded=None, note="missing")
            elif new is _ABSENT:
                item = replace(item, found=None, note="not computed by this version")
            elif isinstance(old, int | float) and type(old) is type(new) is not bool:
                allowed = allowed_difference(tolerance, path, old, found, errors or {})
                item = _judge(replace(item, allowed=allowed))
            elif tolerance.words and without_numbers(str(old)) == without_numbers(str(new)):
                item = replace(item, status=Status.WITHIN, note="the same words")
        items.append(item)
    return items


def _judge(item: Item) -> Item:
    """Judge two numbers that are not equal, given how they are judged beyond what is allowed."""
    old, new = item.recorded, item.found
    if math.isnan(old) or math.isnan(new):
        return replace(item, status=Status.DIFFERENT, allowed=None, note="not a number")
    rounded = _ROUNDED * max(abs(old), abs(new)) if isinstance(old, float) else 0.0
    if abs(old - new) <= max(item.allowed or 0.0, rounded):
        return replace(item, status=Status.WITHIN)
    if item.allowed is None:
        heavy = "tail too heavy for a Monte Carlo error"
        return replace(item, status=Status.UNJUDGED, note=heavy)
    return item


def _equal(old: Any, new: Any) -> bool:
    both_nan = isinstance(old, float) and isinstance(new, float) and old != old and new != new
    # 1 and True, or 1 and 1.0, are not the same entry.
    return both_nan or (type(old) is type(new) and bool(old == new))


def is_exact(items: Iterable[Item]) -> bool:
    """Whether all numbers that are not different are the same to the last bit."""
    return not any(item.status in (Status.WITHIN, Status.UNJUDGED) for item in items)


def have_moved(items: Iterable[Item]) -> bool:
    """Whether a number moved within its tolerance, and by more than rounding."""
    for item in items:
        if item.status in (Status.IDENTICAL, Status.DIFFERENT):
            continue
        if item.note in (ORDER_OF_MAGNITUDE, "the same words"):
            continue
        numbers = isinstance(item.recorded, float) and isinstance(item.found, float)
        if numbers and abs(item.recorded - item.found) <= _ROUNDED * abs(item.found):
            continue
        if item.note != MONTE_CARLO or item.share is None or item.other_draws:
            return True
    return False


# Pages, texts and figures


def without_numbers(text: str) -> str:
    """Return a text with a sign in the place of each number."""
    return _NUMBER.sub("#", text)


def differing_lines(old: str, new: str) -> str:
    """Return how many lines two texts do not share, and the first of them."""
    diff = difflib.unified_diff(old.splitlines(), new.splitlines(), n=0, lineterm="")
    changed = [line for line in list(diff)[2:] if not line.startswith("@@")]  # below the two names
    shown = "; ".join(f"{line[0]} {line[1:].strip()[:400]}" for line in changed[:4])
    return f"{len(changed)} lines differ: {shown}"


def named_pictures(folder: Path, name: str) -> str:
    """Return a page with the names of the folder's figures in the place of the pictures."""
    figures = {
        sha256(path.read_bytes()): path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*.png"))
        # A comparison in a report has its own page.
        if not path.is_relative_to(folder / COMPARED)
    }

    def named(match: re.Match[str]) -> str:
        try:
            content = base64.b64decode(match[1], validate=True)
        except binascii.Error:
            content = b""
        return f"[picture {figures.get(sha256(content), 'of its own')}]"

    text = decoded((folder / name).read_bytes(), "replace")
    return re.sub(r"data:image/png;base64,([A-Za-z0-9+/=]*)", named, text)


def view(
    name: str, job: Job, *, sure: bool = True, same_draws: bool = True, exact: bool = True
) -> Item:
    """Compare a figure, page or other text with the one made again.

    What differs is DIFFERENT if it is `sure` that the program is the same, and the draws are the
    same; of pictures and digits, if all numbers are, to the last bit (`exact`).
    """
    paths = job.folder / name, job.made / name
    if not paths[0].is_file():
        return claim(TEXT, name, "missing", sure=sure)
    old, new = (unix_lines(path.read_bytes()) for path in paths)
    of_figure = name.endswith((".png", ".pdf"))
    group = FIGURES if of_figure else TEXT
    if old == new:
        if paths[0].read_bytes() == paths[1].read_bytes():
            return Item(group, name, Status.IDENTICAL)
        return Item(group, name, Status.WITHIN, note=LINE_ENDS)
    if of_figure:
        wrong = "it is not, byte for byte, the one drawn again"
        return claim(FIGURES, name, wrong, sure=sure and exact)
    words = [named_pictures(folder, name) for folder in (job.folder, job.made)]
    if words[0].splitlines() == words[1].splitlines():
        if sure and exact:
            return claim(FIGURES, name, "its pictures are not, byte for byte, those drawn again")
        return Item(TEXT, name, Status.WITHIN, note="the same but for its pictures")
    pictures = [re.findall(r"\[picture [^\]]*\]", text) for text in words]
    if pictures[0] != pictures[1]:
        return claim(TEXT, name, "it shows other pictures, or in another order", sure=sure)
    plain = [without_numbers("\n".join(text.splitlines())) for text in words]
    if not exact and plain[0] == plain[1]:
        return Item(TEXT, name, Status.WITHIN, note="the same words")
    excuse = "" if same_draws else "its numbers moved within their tolerance: "
    excuse = excuse if sure else "another version wrote it: "
    return claim(TEXT, name, f"{excuse}{differing_lines(*words)}", sure=sure and same_draws)


# Posteriors


def summary_of(file: DrawsFile) -> dict[str, dict[str, float]]:
    """Return mean, sd, median and 95 % highest-density interval of each parameter."""
    return {name: moments(values.reshape(-1)) for name, values in file.draws.items()}


def verify_draws(
    path: Path, problem: Callable[[], Problem], stated: Mapping[str, Any] | None = None
) -> list[Item]:
    """Hold a file of draws, if it is there, against its summary if stated, data and priors."""
    if not path.is_file():
        return []
    items = []
    try:
        file = read_draws(path)
        if stated is not None:
            items.append(_verify_summary(path.name, file, stated))
        items.append(_verify_density(path.name, file, problem()))
    except CalibError as error:
        items.append(claim(POSTERIORS, path.name, error.message))
    except FAULTS as error:
        items.append(claim(POSTERIORS, path.name, f"the file cannot be read ({error!r})"))
    return items


def _verify_summary(name: str, file: DrawsFile, stated: Mapping[str, Any]) -> Item:
    """Check that the stated summary is that of the draws in the file."""
    for parameter, values in summary_of(file).items():
        for key, value in values.items():
            given, size = inside(stated, parameter).get(key), _ROUNDED * values["sd"]
            if not isinstance(given, int | float) or not math.isclose(
                given, value, rel_tol=_ROUNDED, abs_tol=size
            ):
                # Which of the two is wrong is for the sampling to say.
                both, note = f"{SUMMARY} and {name}", f"{key} of {parameter} is not the same"
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
        drawn = file.draws.get(key, values)
        if not np.allclose(drawn.reshape(-1), values, rtol=_ROUNDED, atol=0.0, equal_nan=True):
            return claim(POSTERIORS, name, f"{key} does not follow from the other parameters")
    computed = problem.log_prob(t)
    close = np.abs(computed - stated) <= _ROUNDED * (1.0 + np.abs(stated))
    # A few draws may fall on the wrong side of a bound when they are transformed back.
    if np.mean(close) < 0.999:
        pair = float(stated[close.argmin()]), float(computed[close.argmin()])
        note = "the log density of its draws is not what data and priors give"
        return Item(POSTERIORS, name, Status.DIFFERENT, *pair, note=note)
    return claim(POSTERIORS, name, "", "its draws have the density of data and priors")


def draws(name: str, job: Job) -> Item:
    """Compare what is beside the posterior draws in a file with the same written again.

    It may be apart by half of its own sd, as chains of the shortest run that passes the gate are.
    Draws are held against their summary and density.
    """
    paths = job.folder / name, job.made / name
    if not paths[0].is_file():
        return claim(TEXT, name, "missing")
    if paths[0].read_bytes() == paths[1].read_bytes():
        return Item(POSTERIORS, name, Status.IDENTICAL)
    try:
        old, new = map(_variables, paths)
    except FAULTS as error:
        return claim(POSTERIORS, name, f"the file cannot be read ({error!r})")
    apart = [key for key in {**old, **new} if not _alike(old.get(key), new.get(key))]
    if apart:
        wrong = f"{', '.join(sorted(apart)[:3])} in it: not what is written again"
        return claim(POSTERIORS, name, wrong)
    return Item(POSTERIORS, name, Status.WITHIN, note="its draws are compared by their summary")


def _variables(path: Path) -> dict[str, Array]:
    """Read every variable of a file by its path; of drawn ones, median and sd by row."""
    found: dict[str, Array] = {}
    for node in read_netcdf(path).leaves:
        for name, variable in node.data_vars.items():
            x = variable.to_numpy().astype(np.float64)
            if variable.dims[:2] == DRAWN:
                draws = x.reshape(x.shape[0] * x.shape[1], -1)
                # Quantiles, whatever the tails.
                low, median, high = np.quantile(draws, [0.16, 0.5, 0.84], axis=0)
                x = np.stack([median, 0.5 * (high - low)])
            found[f"{node.name}/{name}"] = x
    return found


def _alike(old: Array | None, new: Array | None) -> bool:
    if old is None or new is None or old.shape != new.shape:
        return False
    if old.ndim == 2 and old.shape[0] == 2:
        allowed = 0.5 * np.maximum(new[1], old[1]) + _ROUNDED
        return bool((np.abs(old - new) <= allowed).all())
    scale = _ROUNDED * max(float(np.abs(new).max(initial=0.0)), 1e-300)
    return bool(np.allclose(old, new, rtol=_ROUNDED, atol=scale, equal_nan=True))
