"""The numbers do not depend on how many threads or processes the work is spread over.

Leaving rows out, diagnoses of many cases, a challenge and campaigns have such tests of their own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.batch.pool import HERE, pool
from calib.he2019.audit import Seeds, audit_json
from calib.he2019.embedded import he2019_tasks
from calib.he2019.gaps import paper_gaps
from calib.he2019.sections import AuditSection, GapsSection
from calib.inference.sampler import SamplerSettings
from calib.report.document import summarise
from calib.report.sections import work_out
from calib.report.study import Task
from calib.report.writer import file_hashes, write_report

SHORT = SamplerSettings(steps=60, max_steps=60)
ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import json
from tests.check.test_threads_and_processes import numbers
print(json.dumps(numbers()))
"""


def numbers(side=HERE) -> dict:
    """Those of a report: of outputs, a gap and the audit."""
    tasks = [task for task in he2019_tasks() if task.output in ("rut_depth", "drawbar_pull")]
    sections = [GapsSection(paper_gaps()[:1]), AuditSection(Seeds(1, 1, 1))]
    found = work_out(tasks, 2019, settings=SHORT, sections=sections, pool=side)
    (gaps, diagnosed), (_, audit) = found.parts
    return {
        "models": summarise(found.study)["models"],
        "gaps": gaps.summary(diagnosed),
        "audit": json.loads(audit_json(audit)),
    }


def in_a_process(threads: int) -> dict:
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, check=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": str(threads)},
    )  # fmt: skip
    return json.loads(ran.stdout)


@pytest.mark.slow
def test_threads_and_processes_give_the_same_numbers() -> None:
    one = in_a_process(1)
    if (os.cpu_count() or 1) > 1:
        assert in_a_process(2) == one
    with pool(2) as side:
        assert json.loads(json.dumps(numbers(side))) == one


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
