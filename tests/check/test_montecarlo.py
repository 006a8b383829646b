"""What Monte Carlo error allows: no false alarm, and the same to a run as to a report."""

from __future__ import annotations

import pytest
from scipy.stats import norm

from calib.checking.compare import Status, compare_entries, flatten
from calib.checking.tolerances import (
    drawn_in_output,
    drawn_in_run,
    multiple,
    posterior_errors,
)
from calib.he2019.embedded import he2019_tasks
from calib.report.document import summarise
from calib.report.sections import work_out


@pytest.mark.parametrize("n", [1, 54, 400])
def test_one_check_in_a_thousand_cries_wolf(n: int) -> None:
    """Of n differences of a standard error each, to either side, the safety of 1.5 left aside."""
    assert n * 2.0 * norm.sf(multiple(n) / 1.5) == pytest.approx(1e-3)


DRAWN = ("posterior", "validation", "sampling")


@pytest.mark.slow
def test_no_false_alarm_over_the_pairs_of_many_seeds() -> None:
    """Six studies of all three outputs, each compared with each other as if recomputed."""
    tasks = he2019_tasks()
    studies = [work_out(tasks, seed).study for seed in range(6)]
    documents = [summarise(study)["models"] for study in studies]
    alarms, compared = [], 0
    for i, study in enumerate(studies):
        for j, other in enumerate(documents):
            if i == j:
                continue
            for key, result in study.successes.items():
                place = ("summary.json", "models", key)
                old, new = (dict(flatten(d[key], place)) for d in (other, documents[i]))
                steps = old[*place, "sampling", "steps"]
                sizes = drawn_in_output(result.calibration, result.validation, 300, steps)
                drawn_by = {(*place, *path): size for path, size in sizes.items()}
                items = compare_entries(old, new, drawn_by)
                # Other seeds search otherwise: only what is drawn from posteriors is meant here.
                drawn = [i for i in items if any(f".{part}." in i.name for part in DRAWN)]
                compared += len(drawn)
                alarms += [item for item in drawn if item.status is Status.DIFFERENT]
    assert compared > 10_000
    assert [item.name for item in alarms] == []


def test_a_run_is_allowed_what_a_report_is(rut_calibration) -> None:
    sizes = drawn_in_run(rut_calibration, 25, None)
    errors = posterior_errors(rut_calibration)
    # Seven errors of a difference, times what ensembles are short of independence.
    times = sizes["log_evidence",] / errors["sampling", "log_evidence"]
    assert 6.0 < times < 10.0
    assert sizes["posterior", "n1", "mean"] == pytest.approx(
        times * errors["posterior", "n1", "mean"]
    )
    sd = rut_calibration.draws.flat.std(axis=0)
    assert sizes["mode", "1"] == pytest.approx(sd[1])
