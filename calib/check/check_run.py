"""Check a run folder: its hashes, its inputs, and its posterior sampled again from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.check import compare, verify
from calib.check.compare import Job
from calib.check.montecarlo import drawn_in_run
from calib.check.numbers import inside
from calib.check.outcome import Item
from calib.check.posteriors import verify_posterior
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.io import describe_estimates, run_problem, save_calibration
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.inference.record import DATA, POSTERIOR, PRIORS, RUN, RunRecord
from calib.report.study import Progress


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
        again = {"estimates": describe_estimates(_estimate_again(record, problem))}
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


def _estimate_again(record: RunRecord, problem: Problem) -> tuple[PointEstimate, ...]:
    return tuple(
        estimate(problem, e.method, generator(record.seed, record.model, e.method))
        for e in record.estimates
    )


def recompute_run(
    record: RunRecord, problem: Problem, out: Path, progress: Progress
) -> Calibration:
    """Sample a run again and write it into a new folder.

    Sampled from the recorded starts, whoever chose them; the estimates in the new folder are
    computed again, to be compared with them.
    """
    estimates = _estimate_again(record, problem)
    pairs = zip(estimates, record.estimates, strict=True)
    starts = tuple(
        replace(again, theta=np.array(said.theta), rmse=said.rmse) for again, said in pairs
    )
    calibration = calibrate(
        problem, record.seed, label=record.label, estimates=starts, settings=record.settings,
        progress=lambda done, planned: progress("sampling", done, planned),
    )  # fmt: skip
    calibration = replace(calibration, estimates=estimates)
    out.mkdir()
    save_calibration(calibration, out, environment=record.environment)
    return calibration
