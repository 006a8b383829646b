"""Check a run folder: its hashes, its inputs, and its posterior sampled again from them."""

from __future__ import annotations

from pathlib import Path

from calib.check import compare, verify
from calib.check.compare import Job
from calib.check.montecarlo import drawn_in_run
from calib.check.outcome import Item
from calib.check.posteriors import verify_posterior
from calib.data.documents import inside
from calib.inference.again import estimate_again, recompute_run
from calib.inference.calibration import Calibration
from calib.inference.io import describe_estimates, run_problem
from calib.inference.problem import Problem
from calib.inference.record import DATA, POSTERIOR, PRIORS, RUN, RunRecord


def check_run(record: RunRecord, job: Job) -> list[Item]:
    """Return what was found in a run."""
    items = verify_run(record, job.folder)
    with compare.not_computed(items, job.folder, RUN):
        problem = run_problem(record, job.folder / DATA)
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
        *verify.files(folder, RUN, record.sha256, more=missed),
        *verify.derived(folder, (), priors, sure=True),
    ]


def consistent_run(record: RunRecord, problem: Problem, job: Job) -> list[Item]:
    """Hold the parts of a run against each other; of a quick check, its estimates too."""
    items = [verify.label(DATA, problem.table, record.data_label)]
    items += verify_posterior(job.folder / POSTERIOR, lambda: problem)
    if job.quick:
        again = {"estimates": describe_estimates(estimate_again(record, problem))}
        items += compare.estimates(job, (RUN,), again)
    return items


def compare_run(record: RunRecord, calibration: Calibration, job: Job) -> list[Item]:
    """Compare a run with the same sampled again, and written."""
    steps = inside(record.document, "gate").get("steps")
    drawn = drawn_in_run(calibration, compare.count_drawn(job.made), steps)
    items = compare.document(RUN, job, {(RUN, *path): size for path, size in drawn.items()})
    items += compare.file(POSTERIOR, job)
    mode = (item for item in items if item.name.startswith(f"{RUN}: mode."))
    wrong = "the posterior mode in run.json does not follow from the data and priors here"
    return items + verify.blame(mode, f"{DATA} or {PRIORS}", wrong)
