"""Check a report, a run, a comparison or a diagnosis: hashes first, then all is computed again."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from calib.batch.environment import Environment, sha256, unix_lines
from calib.batch.pool import HERE
from calib.checking import compare, folders
from calib.checking.compare import (
    INPUTS,
    LINE_ENDS,
    MANIFEST,
    POSTERIORS,
    SUMMARY,
    TEXT,
    Item,
    Job,
    Status,
    claim,
)
from calib.checking.folders import (
    DiagnosisRecord,
    check_comparison,
    check_diagnosis,
    check_joint,
    check_run,
)
from calib.checking.tolerances import describe, drawn_in_output
from calib.data import has_rows, read_table
from calib.data.files import inside, read_json
from calib.data.quantities import OUTPUTS
from calib.errors import FAULTS, CalibError
from calib.gap.files import mispredicted, misquoted
from calib.inference.io import (
    DATA,
    Entry,
    File,
    Hash,
    KnownModel,
    Name,
    Record,
    RunRecord,
    fault_of,
    read_record,
)
from calib.inference.joint_files import JointRecord
from calib.inference.prior_files import default_priors, inherited_otherwise
from calib.inference.problem import Problem, build_problem
from calib.models import get_model
from calib.report.comparison import FILE, HELD_OUT, ComparisonRecord
from calib.report.comparison import FOLDER as COMPARED
from calib.report.document import summarise_estimates
from calib.report.publish import publication
from calib.report.sections import SECTIONS, work_out
from calib.report.study import HoldOut, Progress, Study, Task, estimate_task, fitted_rows
from calib.report.writer import write_report
from calib.validation.validate import Place


def check(
    folder: Path, *, quick: bool = False, effects: Path | None = None,
    progress: Progress | None = None, pool: Executor = HERE, workers: int = 1,
) -> Outcome:  # fmt: skip
    """Compute a report, run, comparison or diagnosis again from its own folder and compare.

    Parameters
    ----------
    folder : Path
        Written by `calib report`, `fit`, `compare` or `diagnose`; nothing in it is changed.
    quick : bool
        Skip the sampling: hashes, data, priors and point estimates only.
    effects : Path, optional
        Python file with the effects of one's own that a diagnosis was made with.
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    pool : Pool, optional
        Where a report is made again; what is found does not depend on it.
    workers : int
        Processes that leave rows out of a comparison.

    Raises
    ------
    CalibError
        If it cannot be checked: the folder is none of ours, or does not say how it was made.

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> calib.check(Path("run")).exit_code  # doctest: +SKIP
    0
    """
    folder = Path(folder)
    record = read_folder(folder)
    tell = progress or (lambda what, done, planned: None)
    with tempfile.TemporaryDirectory(prefix="calib-check-") as scratch:
        made, here = Path(scratch) / "again", Environment.here()
        job = Job(folder, made, tell, here, quick, pool, workers, effects)
        items = _CHECKS[record.kind](record, job)
        allowed = (
            describe(compare.count_drawn(made))
            if made.is_dir() and record.kind != "diagnosis"
            else ""
        )
    differing = record.environment.differences(here)
    missed = _not_converged(record, folder)
    return Outcome(str(folder), record.kind, quick, tuple(items), differing, allowed, missed)


@dataclass(frozen=True)
class Outcome:
    """What a check found; `quick` where sampling was skipped.

    And what differs in the environment, there and here; what Monte Carlo error was allowed, in
    words; the models whose posterior did not pass the convergence gate, as recorded.
    """

    folder: str
    kind: Literal["report", "run", "comparison", "diagnosis", "joint"]
    quick: bool
    items: tuple[Item, ...]
    environment: Mapping[str, tuple[str, str]]
    allowed: str = ""
    not_converged: tuple[str, ...] = ()

    def __repr__(self) -> str:
        differ = len(self.of(Status.DIFFERENT))
        return f"<Outcome of {self.folder}: {differ} of {len(self.items)} items differ>"

    def of(self, *status: Status) -> tuple[Item, ...]:
        """Return the items of some status."""
        return tuple(item for item in self.items if item.status in status)

    @property
    def exit_code(self) -> int:
        """0 where everything is the same, 1 where something is different."""
        return 1 if self.of(Status.DIFFERENT) else 0

    @property
    def groups(self) -> dict[str, tuple[dict[Status, int], float]]:
        """How many items of each group have which status, and the largest difference of allowed."""
        groups: dict[str, list[Item]] = {}
        for item in self.items:
            groups.setdefault(item.group.partition(" (")[0], []).append(item)
        return {
            name: (
                {status: sum(item.status is status for item in items) for status in Status},
                max((item.share or 0.0 for item in items), default=0.0),
            )
            for name, items in groups.items()
        }

    @property
    def draws_differ(self) -> bool:
        """Whether the posterior was drawn by other random draws than those recorded."""
        return any(item.other_draws for item in self.of(Status.WITHIN))

    @property
    def verdict(self) -> str:
        """The verdict in one sentence."""
        different = list(dict.fromkeys(item.name for item in self.of(Status.DIFFERENT)))
        if different:
            return f"DIFFERENT: {', '.join(different[:4])}{', ...' if different[4:] else ''}"
        unjudged = [item.name for item in self.of(Status.UNJUDGED)]
        pages = ", ".join(name for name in unjudged if name.endswith(".html"))
        line_ends = len({item.name for item in self.items if item.note == LINE_ENDS})
        remarks = {
            f"{len(unjudged)} not judged{f', THE PAGE {pages} AMONG THEM' if pages else ''}":
                unjudged,
            f"{line_ends} files have other line ends, as git's autocrlf makes them": line_ends,
            f"NOT CONVERGED, not to be used: {', '.join(self.not_converged)}": self.not_converged,
        }  # fmt: skip
        rest = "".join(f"; {remark}" for remark, applies in remarks.items() if applies)
        if self.quick and self.kind == "diagnosis":
            return f"NOTHING DIFFERENT, BUT NOTHING WAS COMPUTED AGAIN (--quick){rest}"
        if self.quick:
            return f"NOTHING DIFFERENT, BUT ONLY ESTIMATES WERE COMPUTED AGAIN (--quick){rest}"
        if not self.of(Status.WITHIN):
            identical = len(self.of(Status.IDENTICAL))
            return f"SAME, bit for bit: {identical} numbers and files{rest}"
        if all(item.note == LINE_ENDS for item in self.of(Status.WITHIN)):
            return f"SAME but for line ends{rest}"
        how = "within Monte Carlo error" if self.draws_differ else "up to rounding"
        return f"SAME {how}, not bit for bit{rest}"

    def document(self) -> dict[str, Any]:
        """Return everything as plain dictionaries."""
        differing = {n: {"there": there, "here": h} for n, (there, h) in self.environment.items()}
        return {
            "schema": "calib/check/1", "folder": self.folder, "kind": self.kind,
            "quick": self.quick, "verdict": "different" if self.exit_code else "same",
            "headline": self.verdict, "exit_code": self.exit_code,
            "counts": {str(status): len(self.of(status)) for status in Status},
            "environment": differing, "allowed": self.allowed,
            "not_converged": list(self.not_converged),
            "items": [{**asdict(item), "status": str(item.status)} for item in self.items],
        }  # fmt: skip


def _not_converged(record: Record, folder: Path) -> tuple[str, ...]:
    """Models whose posterior is recorded as one that did not pass the gate.

    What is not as it should be in these records is found by comparing them.
    """
    if isinstance(record, ComparisonRecord):
        return record.unsound
    of = record.document.get("model") or ", ".join(inside(record.document, "outputs"))
    gates = {str(of): inside(record.document, "gate").get("passed")}
    for found in inside(read_json(folder / SUMMARY), "models").values():
        gates[str(inside(found).get("model"))] = inside(found, "sampling").get("converged")
    missed = [model for model, passed in gates.items() if passed is False]
    with suppress(CalibError):
        if record.kind == "report" and (folder / COMPARED).is_dir():
            missed += read_record(ComparisonRecord, folder / COMPARED).unsound
    return tuple(dict.fromkeys(missed))


def read_folder(folder: Path) -> Record:
    """Read what a folder says of itself; a CalibError if it is none that can be checked."""
    kinds: tuple[type[Record], ...] = (
        Manifest, RunRecord, ComparisonRecord, DiagnosisRecord, JointRecord,
    )  # fmt: skip
    why = f"no {', '.join(kind.FILE for kind in kinds)} in it"
    for kind in kinds:
        if (folder / kind.FILE).is_file():
            try:
                return read_record(kind, folder)
            except CalibError:
                # A folder of `calib sbc` has a run.json as well, which is no record of a run.
                why = "it is one of `calib sbc`"
                if not (folder / "sbc.json").is_file():
                    raise
    written_by = ", ".join(f"`{kind.WRITTEN_BY}`" for kind in kinds)
    raise CalibError(
        fault_of(folder, f"this is no folder that can be checked ({why})"),
        where=str(folder),
        expected=f"a folder written by one of {written_by}",
        hint="give such a folder; a diagnosis in a report is checked with the report",
    )


# Reports


class _Kept(Entry):
    file: File
    sha256: Hash


class _Data(_Kept):
    source: str
    source_sha256: Hash
    # Where it is not that of the file that is kept: messages and units of the page are by it.
    header: tuple[str, ...] = ()
    ignored: tuple[str, ...]


class _PriorFile(_Kept):
    source: Name
    shipped: bool


class TaskRecord(Entry):
    """One output of a report: model, rows held out, data and priors."""

    model: KnownModel
    held_out: HoldOut | None
    label: str
    data: _Data
    priors: _PriorFile


class Manifest(Record):
    """`manifest.json` of a report folder."""

    FILE, kind, WRITTEN_BY = MANIFEST, "report", "calib report"
    schema_: Literal["calib/manifest/2"] = Field(alias="schema")
    title: str
    command: tuple[str, ...]
    tasks: Annotated[dict[str, TaskRecord], Field(min_length=1)]
    pdf: bool = False
    views: bool = True
    files: dict[File, Hash]
    left_out: dict[File, Hash]

    @property
    def sections(self) -> dict[str, Any]:
        """What it says of the sections that are known here."""
        return {name: self.document[name] for name in SECTIONS if name in self.document}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if unknown := self.tasks.keys() - OUTPUTS.keys():
            raise ValueError(f"tasks: there is no output {', '.join(unknown)}")
        for name, record in self.sections.items():
            try:
                SECTIONS[name].again(record)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return self


def check_report(manifest: Manifest, job: Job) -> list[Item]:
    """Return what was found in a report."""
    folder, same_code = job.folder, manifest.code == job.here.code
    inputs = [(f.file, f.sha256) for t in manifest.tasks.values() for f in (t.data, t.priors)]
    items = folders.verify_files(
        folder, MANIFEST, manifest.files, more=inputs, left_out=manifest.left_out
    ) + folders.verify_pictures(folder)
    summary = read_json(folder / SUMMARY)
    with compare.not_computed(items, folder, MANIFEST):
        tasks = _report_tasks(manifest, folder, job.made.with_name("inputs"))
        for task in tasks:
            entry, stated = manifest.tasks[task.output], inside(summary, "models", task.output)
            items.append(folders.verify_label(entry.data.file, task.table, entry.label))
            items.append(_verify_priors(task.output, entry, folder, same_code=same_code))
            path = folder / f"{task.output}.nc"
            items += compare.verify_draws(
                path, partial(_problem, task), inside(stated, "posterior")
            )
            if job.quick:
                items += _estimates(task, stated, manifest, job)
        if job.quick:
            wrong = "left out on purpose, and not made again"
            items += [claim(POSTERIORS, name, wrong, sure=False) for name in manifest.left_out]
        else:
            study = recompute_report(manifest, tasks, job.made, job.progress, job.pool)
            numbers = _numbers(manifest, study, summary, job)
            items += numbers + _files(manifest, numbers, job)
        if "comparison" in manifest.sections:
            items += _check_compared(manifest, tasks, job.inside(COMPARED))
    items += folders.verify_form(folder) + _verify_gaps(folder, summary, same_code=same_code)
    return items + (_verify_tables(manifest, summary, folder, same_code) if manifest.views else [])


def _report_tasks(manifest: Manifest, folder: Path, scratch: Path) -> tuple[Task, ...]:
    """Return the tasks of a report, with the folder's own data and priors.

    These are copied into `scratch` under their first names, which the page shows.
    """
    tasks = []
    for key, entry in manifest.tasks.items():
        data = entry.data
        table = read_table(folder / data.file, allow_missing=tuple(OUTPUTS.values()))
        table = replace(
            table, source=data.source, sha256=data.source_sha256, label=entry.label, text=(),
            header=data.header or table.header, ignored=data.ignored,
        )  # fmt: skip
        (scratch / key).mkdir(parents=True)
        priors = shutil.copyfile(folder / entry.priors.file, scratch / key / entry.priors.source)
        tasks.append(Task(key, entry.model, table, entry.held_out, priors))
    return tuple(tasks)


def _problem(task: Task) -> Problem:
    return build_problem(task.model, fitted_rows(task)[0], task.prior_path)


def _verify_priors(key: str, entry: TaskRecord, folder: Path, *, same_code: bool) -> Item:
    """Check that priors which are called the shipped ones are, all of them or what a file left."""
    file, shipped = entry.priors.file, default_priors(entry.model)
    if not entry.priors.shipped:
        changed: list[str] = []
        with suppress(*FAULTS):  # what cannot be read has another hash
            changed = inherited_otherwise((folder / file).read_text("utf-8"), entry.model)
        names = ", ".join(changed)
        wrong = f"{names}: not as in the {shipped.name} of this version" if names else ""
        return claim(INPUTS, file, wrong, f"priors of the user for {key}", sure=same_code)
    same = unix_lines((folder / file).read_bytes()) == unix_lines(shipped.read_bytes())
    wrong = "" if same else f"not the {shipped.name} of this version"
    return claim(INPUTS, file, wrong, f"the shipped {shipped.name}", sure=same_code)


def recompute_report(
    manifest: Manifest, tasks: tuple[Task, ...], out: Path, progress: Progress, pool: Executor
) -> Study:
    """Work a report out again and write it into a new folder."""
    report = work_out(
        tasks, manifest.seed, settings=manifest.settings, progress=progress, pool=pool,
        sections=[SECTIONS[name].again(record) for name, record in manifest.sections.items()],
    )  # fmt: skip
    write_report(
        report, out, pdf=manifest.pdf, settings=manifest.settings, command=manifest.command,
        title=manifest.title, environment=manifest.environment, progress=progress, pool=pool,
    )  # fmt: skip
    return report.study


def _estimates(task: Task, stated: Mapping[str, Any], manifest: Manifest, job: Job) -> list[Item]:
    """Compare the point estimates of an output, computed again without sampling."""
    place = (SUMMARY, "models", task.output)
    if "error" in stated:
        wrong = "it failed; to see whether it does again, check without --quick"
        name = f"{SUMMARY}: models.{task.output}"
        return [claim(f"{task.output}: error", name, wrong, sure=False)]
    found = summarise_estimates(*estimate_task(task, manifest.seed, progress=job.progress))
    return compare.estimates(job, place, found)


def _numbers(manifest: Manifest, study: Study, summary: Mapping[str, Any], job: Job) -> list[Item]:
    """Compare every document entry by entry, and name the inputs that do not belong to them."""
    n, drawn = compare.count_drawn(job.made), dict[Place, float | None]()
    for key, result in study.successes.items():
        steps = inside(summary, "models", key, "sampling").get("steps")
        sizes = drawn_in_output(result.calibration, result.validation, n, steps)
        drawn |= {(SUMMARY, "models", key, *path): size for path, size in sizes.items()}
    items = compare.document(SUMMARY, job, drawn)
    searches = (".genetic.", ".differential_evolution.")
    for key, task in manifest.tasks.items():
        points = [item for item in items if item.group == f"{key}: estimates"]
        points = [i for i in points if not any(search in i.name for search in searches)]
        mode = [i for i in items if i.name.startswith(f"{SUMMARY}: models.{key}.sampling.mode.")]
        wrong = "most estimates in summary.json do not follow from these rows"
        other = "the posterior mode in summary.json does not follow from these priors and the data"
        blamed = folders.blame(points, task.data.file, wrong)
        items += blamed or folders.blame(mode, task.priors.file, other)
    made = folders.files_in(job.made) if manifest.views else {*manifest.files, MANIFEST}
    for name in sorted(filter(compare.is_document, made - {SUMMARY})):
        items += compare.document(name, job)
    return items


def _files(manifest: Manifest, numbers: list[Item], job: Job) -> list[Item]:
    """Compare every file but the documents and what follows from them."""
    same_program = manifest.environment.same_program(job.here)
    same_draws, exact = not compare.have_moved(numbers), compare.is_exact(numbers)
    made, items = folders.files_in(job.made), []
    if not manifest.views:
        made &= {*manifest.files, *manifest.left_out}
    for name in sorted(n for n in made - _derived(made) if not compare.is_document(n)):
        own = name.startswith(("data/", "priors/")) or "/case/" in name
        if name in manifest.left_out:
            same = sha256((job.made / name).read_bytes()) == manifest.left_out[name]
            wrong = "" if same else "left out on purpose; its summary is compared"
            right = "left out on purpose; made again, it has the recorded hash"
            items.append(claim(POSTERIORS, name, wrong, right, sure=False))
        elif name.endswith(".nc"):
            items.append(compare.draws(name, job))
        elif own:
            items.append(compare.view(name, job))
        else:
            items.append(
                compare.view(name, job, sure=same_program, same_draws=same_draws, exact=exact)
            )
    # A comparison is checked as a folder of `calib compare`.
    inner = (f"{COMPARED}/",) if "comparison" in manifest.sections else ()
    strangers = set(manifest.files) - _derived(manifest.files) - made
    note = "this version makes no such file"
    return items + [
        claim(TEXT, name, note, sure=same_program)
        for name in sorted(strangers)
        if not name.startswith(inner)
    ]


def _derived(names: Iterable[str]) -> set[str]:
    """Return those of a report's files that are made from others."""
    others = {"references.bib", "audit.csv"}
    return {n for n in names if n.startswith(("tables/", "methods.")) or n in others}


def _verify_tables(
    manifest: Manifest, summary: Mapping[str, Any], folder: Path, same_code: bool
) -> list[Item]:
    """Write tables and methods again from the numbers as they are recorded."""
    items = folders.verify_texts(
        folder, f"{SUMMARY} and {MANIFEST}",
        lambda: publication(manifest.document, summary).files, sure=same_code,
    )  # fmt: skip
    for kind in SECTIONS.values():
        write = partial(kind.derived, folder, manifest.files)
        items += folders.verify_texts(folder, kind.name, write, sure=same_code)
    found = {item.name for item in items}
    if found <= folders.files_in(folder) | _derived(found):  # all could be written
        wrong = "it follows from nothing here"
        for name in sorted(_derived(manifest.files) - found):
            items.append(claim(TEXT, name, wrong, sure=same_code))
    return items


def _verify_gaps(folder: Path, summary: Mapping[str, Any], *, same_code: bool) -> list[Item]:
    """Check a summary's statements on the paper's gaps against the diagnoses and corrected models.

    Another version than the one that wrote the report may predict otherwise.
    """
    items = []
    for name, stated in inside(summary, "paper_gaps").items():
        place, both = folder / "gaps" / name, f"{SUMMARY} and gaps/{name}/diagnosis.json"
        if (place / "diagnosis.json").is_file():
            items.append(claim(TEXT, both, misquoted(stated, place), "they say the same"))
            wrong, right = mispredicted(place), "it predicts the gaps of diagnosis.json"
            items.append(claim(TEXT, f"gaps/{name}/corrected.json", wrong, right, sure=same_code))
    return items


def _check_compared(manifest: Manifest, tasks: Iterable[Task], job: Job) -> list[Item]:
    """Check the comparison of models in a report: of its rows and seed, stated as it was found."""
    record = read_record(ComparisonRecord, job.folder)
    items = compare.within(COMPARED, COMPARED, check_comparison(record, job))
    stated = inside(manifest.sections, "comparison")
    same = {"models", "verdict", "seed"} <= stated.keys()
    same = same and stated.items() <= record.document.items()
    output = get_model(next(iter(record.models))).output
    [task] = [task for task in tasks if OUTPUTS[task.output] == output]
    rows, held = fitted_rows(task)
    own = record.seed == manifest.seed and bool(record.held_out) == (held is not None)
    own = own and all(has_rows(job.folder / "runs" / n / DATA, rows) for n in record.models)
    own = own and (held is None or has_rows(job.folder / HELD_OUT, held))
    # By the names of columns values are shown in the units of the file.
    header = record.header == manifest.tasks[task.output].data.header
    for fits, name, what in (
        (same, f"{MANIFEST}: comparison", "what its comparison.json has"),
        (own, f"{COMPARED}/{FILE}", "of the report's own rows and seed"),
        (header, f"{COMPARED}/{FILE}: header", "the column names of the report's own file"),
    ):
        items.append(claim(COMPARED, name, "" if fits else f"it is not {what}", what))
    return items


_CHECKS: Mapping[str, Callable[[Any, Job], list[Item]]] = {
    "report": check_report, "run": check_run, "comparison": check_comparison,
    "diagnosis": check_diagnosis, "joint": check_joint,
}  # fmt: skip
