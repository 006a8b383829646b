"""Work a recorded run out again, from its record alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.io import save_calibration
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.inference.record import RunRecord


def estimate_again(record: RunRecord, problem: Problem) -> tuple[PointEstimate, ...]:
    """Return a run's point estimates, by the methods and the seed that it names."""
    return tuple(
        estimate(problem, e.method, generator(record.seed, record.model, e.method))
        for e in record.estimates
    )


def recompute_run(
    record: RunRecord, problem: Problem, out: Path, progress: Callable[[str, int, int], None]
) -> Calibration:
    """Sample a run again and write it into a new folder.

    Sampled from the recorded starts, whoever chose them; the estimates in the new folder are
    computed again, to be compared with them.
    """
    estimates = estimate_again(record, problem)
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
