"""Check a run folder: its hashes, its inputs, and its posterior sampled again from them."""

from __future__ import annotations

from pathlib import Path

from calib.check.compare import blame, compare_document, compare_estimates, count_drawn
from calib.check.derived import verify_derived
from calib.check.inputs import verify_files, verify_label
from calib.check.montecarlo import drawn_in_run
from calib.check.numbers import inside
from calib.check.outcome import Item, claim
from calib.check.posteriors import GROUP as POSTERIORS
from calib.check.posteriors import compare_posterior, read_draws, verify_density
from calib.check.recompute import Job, estimate_again, not_computed, recompute_run
from calib.check.schema import DATA, POSTERIOR, PRIORS, RUN, RunRecord
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.io import describe_estimates, run_problem
from calib.inference.problem import Problem


def check_run(record: RunRecord, job: Job) -> list[Item]:
    """Return what was found in a run."""
    items = verify_run(record, job.folder)
    with not_computed(items, job.folder, RUN):
        problem = run_problem(record.document, job.folder / DATA)
        items += consistent_run(record, problem, job)
        if not job.quick:
            calibration = recompute_run(record, problem, job.made, job.progress)
            items += compare_run(record, calibration, job)
    return items


def verify_run(record: RunRecord, folder: Path) -> list[Item]:
    """Hold a run's files against their hashes, and its priors against the copy in its record."""
    missed = [(n, "") for n in (POSTERIOR, PRIORS, DATA) if n not in record.sha256]
    priors = {RUN: lambda: {PRIORS: record.prior_text}}
    return [
        *verify_files(folder, RUN, record.sha256, more=missed),
        *verify_derived(folder, (), priors, sure=True),
    ]


def consistent_run(record: RunRecord, problem: Problem, job: Job) -> list[Item]:
    """Hold the parts of a run against each other; of a quick check, its estimates too."""
    items, summary = [verify_label(DATA, problem.table, record.data_label)], {}
    if (job.folder / POSTERIOR).is_file():
        try:
            file = read_draws(job.folder / POSTERIOR)
            summary = file.summary
            items.append(verify_density(POSTERIOR, file, problem))
        except CalibError as error:
            items.append(claim(POSTERIORS, POSTERIOR, error.message))
    if job.quick:
        again = {"estimates": describe_estimates(estimate_again(record, problem))}
        items += compare_estimates((RUN,), {**record.document, "posterior": summary}, again)
    return items


def compare_run(record: RunRecord, calibration: Calibration, job: Job) -> list[Item]:
    """Compare a run with the same sampled again, and written."""
    steps = inside(record.document, "gate").get("steps")
    drawn = drawn_in_run(calibration, count_drawn(job.made), steps)
    items = compare_document(RUN, job, {(RUN, *path): size for path, size in drawn.items()})
    if (job.folder / POSTERIOR).is_file():
        items.append(compare_posterior(POSTERIOR, job.folder / POSTERIOR, job.made / POSTERIOR))
    mode = (item for item in items if item.name.startswith(f"{RUN}: mode."))
    note = "the posterior mode in run.json does not follow from the data and priors here"
    return items + blame(mode, f"{DATA} or {PRIORS}", note)
