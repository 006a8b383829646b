"""The numbers do not depend on how many threads or processes the work is spread over.

Beside these: leaving rows out (`tests/test_validate.py`), diagnoses of many cases
(`tests/gap/test_batch.py`), making a challenge (`tests/challenge/test_make.py`) and campaigns
(`tests/batch/campaign/test_run.py`), each on one process and on two.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from calib.he2019.audit import Seeds, audit_json
from calib.he2019.designs import he2019_tasks
from calib.he2019.gaps import paper_gaps
from calib.he2019.sections import AuditSection, GapsSection
from calib.inference.sampler import SamplerSettings
from calib.report.document import summarise
from calib.report.sections import work_out
from calib.report.study import Task
from calib.report.writer import file_hashes, write_report
from calib.validation.sbc import run_sbc

SHORT = SamplerSettings(steps=60, max_steps=60)
LONGER = SamplerSettings(steps=100, max_steps=400)
OUTPUTS = ("rut_depth", "drawbar_pull")
ROOT = Path(__file__).resolve().parents[2]


def numbers(*outputs: str) -> dict:
    """The summary of some outputs, worked out one after the other in this process."""
    tasks = [task for task in he2019_tasks() if task.output in outputs]
    return summarise(work_out(tasks, 2019, settings=SHORT).study)["models"]


def all_numbers() -> dict:
    """Those of a report: of outputs, a gap and the audit."""
    tasks = [task for task in he2019_tasks() if task.output in OUTPUTS]
    found = work_out(
        tasks, 2019, settings=SHORT,
        sections=[GapsSection(paper_gaps()[:1]), AuditSection(Seeds(1, 1, 1))],
    )  # fmt: skip
    (gaps, diagnosed), (_, audit) = found.parts
    return {
        "models": summarise(found.study)["models"],
        "gaps": gaps.summary(diagnosed),
        "audit": json.loads(audit_json(audit)),
    }


PROGRAM = """
import json
from tests.check.test_threads_and_processes import all_numbers
print(json.dumps(all_numbers()))
"""


def in_a_process(threads: int) -> str:
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": str(threads)}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment, capture_output=True, text=True, check=True,
        cwd=ROOT,
    )  # fmt: skip
    return ran.stdout


@pytest.fixture(scope="module")
def one_thread() -> str:
    return in_a_process(1)


# One of the settings in which the reference report is checked has two threads as well.
@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="this machine has one core")
def test_two_threads_of_linear_algebra_give_the_same_numbers(one_thread: str) -> None:
    assert in_a_process(2) == one_thread


@pytest.mark.slow
def test_two_processes_give_the_same_numbers(one_thread: str) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = dict(zip(OUTPUTS, pool.map(numbers, OUTPUTS), strict=True))
    together = json.loads(one_thread)["models"]
    for output in OUTPUTS:
        assert json.loads(json.dumps(found[output][output])) == together[output]


@pytest.mark.slow
def test_two_workers_make_the_same_report(tmp_path: Path) -> None:
    """With a row that is so far off that leaving it out needs a fit of its own."""
    (task,) = (task for task in he2019_tasks() if task.output == "bulk_density")
    column = "bulk_density_g_cm3"
    values = np.array(task.table[column])
    values[0] *= 1.5
    table = replace(task.table, columns={**task.table.columns, column: values}, label="")
    hashes = []
    for workers in (1, 2):
        found = work_out([Task(task.output, task.model, table)], 1, settings=SHORT, workers=workers)
        assert found.study.successes["bulk_density"].validation.refitted
        out = tmp_path / f"report-{workers}"
        write_report(found, out, settings=SHORT, command=["calib", "report"], title="A report")
        hashes.append(file_hashes(out))
    assert hashes[0] == hashes[1]


@pytest.mark.slow
def test_two_workers_simulate_the_same(tmp_path: Path) -> None:
    replicates = []
    for workers in (1, 2):
        out = tmp_path / f"sbc-{workers}"
        run_sbc(out, models=["bekker"], simulations=4, seed=1, settings=LONGER, workers=workers)
        files = sorted((out / "replicates").glob("*.json"))
        replicates.append({path.name: path.read_bytes() for path in files})
    assert len(replicates[0]) == 4
    assert replicates[0] == replicates[1]
