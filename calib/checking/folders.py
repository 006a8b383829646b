"""Check runs, comparisons and diagnoses: what they say of themselves, then all computed again."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from calib.batch.environment import Environment, differs_in_lines, sha256, unix_lines
from calib.checking import compare
from calib.checking.compare import (
    FIGURES,
    INPUTS,
    LINE_ENDS,
    PAGE,
    POSTERIORS,
    TEXT,
    Item,
    Job,
    Status,
    claim,
)
from calib.checking.tolerances import drawn_in_comparison, drawn_in_joint, drawn_in_run
from calib.data import Table
from calib.data import files as data_files
from calib.data.files import decoded, inside
from calib.data.reader import KNOWN_DATA, label_of
from calib.errors import FAULTS, CalibError
from calib.gap.batch import INPUTS as DIAGNOSIS_INPUTS
from calib.gap.case import Case, read_case
from calib.gap.describe import gap_document
from calib.gap.diagnose import diagnose
from calib.gap.document import FILE as DOCUMENT
from calib.gap.document import DataFile, GapDocument, load_document
from calib.gap.effects import EFFECTS
from calib.gap.effects.user import load_effects
from calib.gap.files import mispredicted, write_diagnosis
from calib.inference.calibration import Calibration
from calib.inference.io import (
    DATA,
    POSTERIOR,
    PRIORS,
    RUN,
    Hash,
    KnownModel,
    Record,
    RunRecord,
    describe_estimates,
    estimate_again,
    read_record,
    recompute_run,
    run_problem,
)
from calib.inference.joint_files import (
    JOINT,
    JointRecord,
    coordinates_of,
    density_differs,
    joint_problem,
    read_joint_draws,
    recompute_joint,
)
from calib.inference.problem import Problem
from calib.inference.sampler import SamplerSettings
from calib.report import comparison
from calib.report.comparison import FILE, ComparisonRecord, recompute_comparison
from calib.report.page.diagnosis import render_diagnosis
from calib.validation.comparison import stacking_weights

FILES = "files and their hashes"


def verify_files(
    folder: Path, own: str, listed: Mapping[str, str], *, more: Iterable[tuple[str, str]] = (),
    left_out: Iterable[str] = (),
) -> list[Item]:  # fmt: skip
    """Return an item for each file that is listed, by its SHA-256, or there.

    `own` lists them, and so has no hash; `more` hashes are said elsewhere in it, none where one is
    missed; what was left out is not there on purpose.
    """
    pairs = dict.fromkeys([*listed.items(), *more])
    wrong = "missing: only posteriors may be left out"
    return [
        *(_listed(folder / name, own, name, expected) for name, expected in pairs),
        *(claim(FILES, n, wrong) for n in left_out if not n.endswith(".nc") or "/" in n),
        *(claim(FILES, n, "not listed") for n in sorted(files_in(folder) - {own, *listed})),
    ]


def files_in(folder: Path) -> set[str]:
    """Return the names of all files below a folder."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def labels_in(folder: Path) -> list[str]:
    """Return what data must be called, as the documents of a folder state it."""
    texts = [path.read_text("utf-8", "replace") for path in folder.rglob("*.json")]
    return [name for name in KNOWN_DATA if any(f'label": "{name}"' in text for text in texts)]


def _listed(path: Path, own: str, name: str, expected: str) -> Item:
    if not expected:
        return claim(INPUTS, name, f"{own} has no hash of it")
    if not path.is_file():
        return claim(FILES, name, "missing")
    try:
        content = path.read_bytes()
    except OSError as error:
        return claim(FILES, name, f"cannot be read ({error.strerror})")
    found = sha256(content)
    if found == expected:
        return Item(FILES, name, Status.IDENTICAL)
    if differs_in_lines(content, expected):
        return Item(FILES, name, Status.WITHIN, note=LINE_ENDS)
    return Item(FILES, name, Status.DIFFERENT, expected, found, note="changed")


def verify_label(file: str, table: Table, label: str) -> Item:
    """Check that rows which are known are called what they are, and no others are."""
    known = label_of(table)
    right = KNOWN_DATA[known].words if known else "data of the user"
    wrong = f"called {label}, but not {KNOWN_DATA[label].words if label in KNOWN_DATA else 'that'}"
    if known:
        wrong = f"these are {right}, {known} and not measured, but not called so"
    return claim(INPUTS, file, wrong if label != known else "", right)


def verify_texts(
    folder: Path, source: str, write: Callable[[], Mapping[str, str]], *, sure: bool = True
) -> list[Item]:
    """Write texts again from what they follow from, by the name of that, and compare the bytes.

    Another version than the one that wrote them may word them otherwise: then it is not `sure`.
    """
    try:
        texts = write()
    except Exception as error:  # whatever somebody else's record makes the writer raise
        wrong = f"what follows from it cannot be written ({type(error).__name__}: {error})"
        return [claim(TEXT, source, wrong, sure=sure)]
    items = []
    for name, text in texts.items():
        wrong, path = "", folder / name
        if not path.is_file():
            wrong = f"missing, though {source} gives it"
        elif unix_lines(path.read_bytes()) != text.encode():
            lines = compare.differing_lines(decoded(path.read_bytes(), "replace"), text)
            wrong = f"it does not follow from {source}: {lines}"
        items.append(claim(TEXT, name, wrong, f"it follows from {source}", sure=sure))
    return items


def verify_form(folder: Path) -> list[Item]:
    """Check that documents are in the form they are written in.

    Of two equal keys a machine reads the last, and a person may see the first.
    """
    wrong = "not in the form it is written in: repeated keys, or edited by hand"
    found = []
    for path in sorted(folder.rglob("*.json")):
        # What cannot be read is said where its entries are compared.
        with suppress(CalibError, *FAULTS):
            text = data_files.read_text(path)
            indent = 1 if text.startswith("{\n") else None
            right = f"{json.dumps(json.loads(text), indent=indent)}\n"
            if path.name == DOCUMENT:
                right = load_document(path.parent).json().decode()
            if text != right:
                found.append(claim(TEXT, path.relative_to(folder).as_posix(), wrong))
    return found


def verify_pictures(folder: Path) -> list[Item]:
    """Check that every picture on a page is one of the folder's figures."""
    if not (folder / PAGE).is_file():
        return []
    strangers = compare.named_pictures(folder, PAGE).count("[picture of its own]")
    wrong = f"{strangers} of its pictures are none of the figures" if strangers else ""
    return [claim(TEXT, f"pictures in {PAGE}", wrong, "they are figures")]


def blame(items: Iterable[Item], file: str, wrong: str) -> list[Item]:
    """Name the input that some numbers cannot have been computed from, if most are different."""
    different = [i.status is Status.DIFFERENT for i in items if isinstance(i.recorded, float)]
    return [claim(INPUTS, file, wrong)] if sum(different) > 0.5 * len(different) else []


# Runs


def check_run(record: RunRecord, job: Job) -> list[Item]:
    """Return what was found in a run."""
    items = _verify_run(record, job.folder)
    with compare.not_computed(items, job.folder, RUN):
        problem = run_problem(record, job.folder / DATA)
        items += _consistent_run(record, problem, job)
        if record.part_of:
            wrong = f"part of a joint posterior ({record.part_of}), which is not sampled again here"
            items.append(claim(POSTERIORS, POSTERIOR, wrong, sure=False))
        elif not job.quick:
            calibration = recompute_run(record, problem, job.made, job.progress)
            items += _compare_run(record, calibration, job)
    return items


def _verify_run(record: RunRecord, folder: Path) -> list[Item]:
    """Hold a run's files against their hashes, and its priors against the copy in its record."""
    missed = [(n, "") for n in (POSTERIOR, PRIORS, DATA) if n not in record.sha256]
    items = verify_files(folder, RUN, record.sha256, more=missed)
    return items + verify_texts(folder, RUN, lambda: {PRIORS: record.prior_text})


def _consistent_run(record: RunRecord, problem: Problem, job: Job) -> list[Item]:
    """Hold the parts of a run against each other; of a quick check, its estimates too."""
    items = [verify_label(DATA, problem.table, record.data_label)]
    items += compare.verify_draws(job.folder / POSTERIOR, lambda: problem)
    if job.quick:
        again = {"estimates": describe_estimates(estimate_again(record, problem))}
        items += compare.estimates(job, (RUN,), again)
    return items


def _compare_run(record: RunRecord, calibration: Calibration, job: Job) -> list[Item]:
    """Compare a run with the same sampled again, and written."""
    steps = inside(record.document, "gate").get("steps")
    drawn = drawn_in_run(calibration, compare.count_drawn(job.made), steps)
    items = compare.document(RUN, job, {(RUN, *path): size for path, size in drawn.items()})
    for name in record.sha256:
        if name.endswith((".csv", ".json")) and name != DATA:
            items += compare.document(name, job)
    items.append(compare.draws(POSTERIOR, job))
    mode = (item for item in items if item.name.startswith(f"{RUN}: mode."))
    wrong = "the posterior mode in run.json does not follow from the data and priors here"
    return items + blame(mode, f"{DATA} or {PRIORS}", wrong)


# Joint calibrations


def check_joint(record: JointRecord, job: Job) -> list[Item]:
    """Return what was found in a joint calibration."""
    items = verify_files(job.folder, JOINT, record.sha256)
    with compare.not_computed(items, job.folder, JOINT):
        problem = joint_problem(record, job.folder)
        for output, whole in problem.wholes.items():
            label = record.outputs[output].data_label
            items.append(verify_label(f"{output}.csv", whole.table, label))
        file = read_joint_draws(job.folder / POSTERIOR)
        t = coordinates_of(problem, file)
        wrong = density_differs(problem, t, file, len(t))
        right = "its draws have the density of data and priors"
        items.append(claim(POSTERIORS, POSTERIOR, wrong, right))
        if not job.quick:
            again = recompute_joint(record, problem, job.made, job.progress)
            steps = inside(record.document, "gate").get("steps")
            drawn = drawn_in_joint(again, compare.count_drawn(job.made), steps)
            sizes = {(JOINT, *path): size for path, size in drawn.items()}
            items += compare.document(JOINT, job, sizes)
            items.append(compare.draws(POSTERIOR, job))
    return items


# Comparisons


def check_comparison(record: ComparisonRecord, job: Job) -> list[Item]:
    """Return what was found in a comparison."""
    same = record.environment.same_program(job.here)

    def page() -> dict[str, str]:
        image = (job.folder / comparison.FIGURE).read_bytes()
        return {comparison.PAGE: comparison.page(record.document, image)}

    items = verify_files(job.folder, FILE, record.files) + _follows_from_rows(record)
    items += verify_texts(job.folder, FILE, page, sure=same)
    with compare.not_computed(items, job.folder, FILE):
        jobs = {name: job.inside(f"runs/{name}") for name in record.models}
        runs = {name: read_record(RunRecord, of.folder) for name, of in jobs.items()}
        data = {name: of.folder / DATA for name, of in jobs.items()}
        problems = {name: run_problem(run, data[name]) for name, run in runs.items()}
        for name, run in runs.items():
            found = _verify_run(run, jobs[name].folder)
            found += _consistent_run(run, problems[name], jobs[name])
            if run.model != name:
                found.append(claim("comparison", RUN, f"it is of the model {run.model}"))
            items += compare.within(f"runs/{name}", name, found)
        alike = len({path.read_bytes() for path in data.values()}) == 1
        wrong = "" if alike else "the models were fitted to different rows"
        right = "the rows of all models are the same"
        items.append(claim("comparison", f"runs/*/{DATA}", wrong, right))
        if not job.quick:
            job.made.mkdir()
            again = recompute_comparison(
                record, problems, job.folder, job.made, job.progress, job.workers
            )
            steps = {name: inside(r.document, "gate").get("steps") for name, r in runs.items()}
            drawn = drawn_in_comparison(again, compare.count_drawn(job.made), steps)
            sizes = {(FILE, "models", *place): size for place, size in drawn.items()}
            items += compare.document(FILE, job, sizes)
            for c in again.candidates:
                found = _compare_run(runs[c.model], c.calibration, jobs[c.model])
                items += compare.within(f"runs/{c.model}", c.model, found)
            exact = compare.is_exact(item for item in items if item.found is not None)
            items.append(compare.view(comparison.FIGURE, job, sure=same, exact=exact))
    return items


def _follows_from_rows(record: ComparisonRecord) -> list[Item]:
    """Check that what is stated of models follows from their log predictive densities."""
    rows = {name: np.array(m.elpd_rows) for name, m in record.models.items()}
    found: dict[str, object] = {"rows": "the same number for all models"}
    if len({r.size for r in rows.values()}) == 1:
        weights = stacking_weights(np.stack(list(rows.values()), axis=1))
        named = dict(zip(rows, weights.tolist(), strict=True))
        found = comparison.stated_of_rows(rows, named, record.unsound)
    items = []
    for place, value in compare.flatten(found):
        stated = inside(record.document, *place[:-1]).get(place[-1])
        same = stated == value
        if isinstance(value, float) and isinstance(stated, int | float):
            # Weights come of iterations that stop at a billionth.
            same = math.isclose(stated, value, rel_tol=1e-6, abs_tol=1e-6)
        name = f"{FILE}: {'.'.join(place)}, as its elpd_rows give it"
        status = Status.IDENTICAL if same else Status.DIFFERENT
        items.append(Item("comparison", name, status, stated, value))
    return items


# Diagnoses


class DiagnosisRecord(Record):
    """`inputs.json` of a diagnosis folder, which names neither packages nor a processor."""

    FILE, kind, WRITTEN_BY = DIAGNOSIS_INPUTS, "diagnosis", "calib diagnose"
    versions: dict[str, str] = Field(default={})
    machine: dict[str, str] = Field(default={})
    settings: SamplerSettings = SamplerSettings()
    version: str
    code: str = Field(alias="code_sha256")
    models: dict[str, KnownModel]
    effects: dict[str, Hash] = Field(default={})
    context: tuple[str, ...] = ()

    @property
    def environment(self) -> Environment:
        """Where it was made, as it says; what it does not say is taken for what is here."""
        here = Environment.here()
        return Environment({**here.versions, "terracalib": self.version}, here.machine, self.code)


def check_diagnosis(record: DiagnosisRecord, job: Job) -> list[Item]:
    """Return what was found in a diagnosis."""
    folder, same = job.folder, record.code == job.here.code
    effects = _effects_of(record, job)
    items = verify_form(folder)
    wrong, right = mispredicted(folder, effects), "it predicts the gaps of diagnosis.json"
    items.append(claim(TEXT, "corrected.json", wrong, right, sure=same))
    with compare.not_computed(items, folder, DIAGNOSIS_INPUTS):
        document = load_document(folder)
        items += _verify_bytes(folder, render_diagnosis(document), sure=same)
        case = _case_of(document, folder)
        for right, same_input in (
            ("the models are those recorded", dict(case.models) == record.models),
            ("the context is the one recorded", tuple(case.context.words()) == record.context),
        ):
            wrong = "" if same_input else f"not so: {right}"
            items.append(claim(INPUTS, "case/case.toml", wrong, right))
        if not job.quick:
            found = diagnose(case, record.seed, effects=effects, pool=job.pool)
            job.made.mkdir()
            again = gap_document(found, document.command, document.versions)
            write_diagnosis(found, job.made, again)
            numbers: list[Item] = []
            for path in sorted([*job.made.glob("*.json"), *job.made.glob("*.csv")]):
                if path.name != DOCUMENT:
                    numbers += compare.document(path.name, job)
            exact, same_draws = compare.is_exact(numbers), not compare.have_moved(numbers)
            view = compare.view(DOCUMENT, job, sure=same, same_draws=same_draws, exact=exact)
            items += [*numbers, view]
    return items


def _verify_bytes(folder: Path, files: Mapping[str, bytes], *, sure: bool) -> list[Item]:
    """Check that files are what is rendered again from a diagnosis' document."""
    items = []
    for name, content in files.items():
        path, wrong = folder / name, ""
        if not path.is_file() or unix_lines(path.read_bytes()) != unix_lines(content):
            wrong = f"it is not what {DOCUMENT} gives"
        group = FIGURES if name.endswith(".png") else TEXT
        items.append(claim(group, name, wrong, f"it follows from {DOCUMENT}", sure=sure))
    return items


def _case_of(document: GapDocument, folder: Path) -> Case:
    """Return the case that is kept in a folder, its name and files called as when it was made."""
    case = read_case(folder / "case")
    files: Mapping[str, DataFile] = {file.role: file for file in document.files}

    def renamed(table: Table, role: str) -> Table:
        return replace(table, source=files[role].name, sha256=files[role].sha256)

    new = None if case.new_conditions is None else renamed(case.new_conditions, "predict")
    return replace(
        case, name=document.name, lab=renamed(case.lab, "calibration"),
        field=renamed(case.field, "field"), new_conditions=new,
    )  # fmt: skip


def _effects_of(record: DiagnosisRecord, job: Job) -> dict[str, Any]:
    """Return the effects that a diagnosis considered, those of its own file among them."""
    if job.effects is None and not record.effects:
        return dict(EFFECTS)
    own = {} if job.effects is None else load_effects(job.effects)
    files = [job.effects, *(e.prior_file for e in own.values())]
    given = {path.name: sha256(path.read_bytes()) for path in files if path is not None}
    if given != record.effects:
        raise CalibError(
            "the effects are not those that the diagnosis was made with",
            where=str(job.effects or job.folder),
            expected=", ".join(record.effects) or "no effects other than those of calib",
            hint="give the same file of effects (--effects), or none if none was given",
        )
    return {**EFFECTS, **own}
