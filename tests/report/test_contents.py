"""A report is the same wherever its pieces are worked out and drawn."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.batch.pool import pool
from calib.he2019.audit import Seeds
from calib.he2019.designs import he2019_tasks
from calib.he2019.gaps import paper_gaps
from calib.he2019.sections import AuditSection, GapsSection
from calib.inference.sampler import SamplerSettings
from calib.report.sections import work_out
from calib.report.writer import file_hashes, write_report

SHORT = SamplerSettings(steps=60, max_steps=60)


@pytest.mark.slow  # `tests/check/test_threads_and_processes.py` has a smaller one
def test_processes_make_the_same_report_as_one(tmp_path: Path) -> None:
    """Outputs, a gap, the audit and all figures, to the byte."""
    tasks = [task for task in he2019_tasks() if task.output == "rut_depth"]
    gaps = [gap for gap in paper_gaps() if gap.name == "plain_bekker"]
    told: dict[int, set[str]] = {}
    for workers in (1, 2):
        told[workers] = set()

        def tell(what: str, done: int, planned: int, seen: set[str] = told[workers]) -> None:
            assert 0 <= done <= planned
            seen.add(what)

        with pool(workers) as side:
            found = work_out(
                tasks,
                7,
                settings=SHORT,
                progress=tell,
                pool=side,
                sections=[GapsSection(gaps), AuditSection(Seeds(1, 1, 2))],
            )
            write_report(
                found, tmp_path / f"{workers}", settings=SHORT, command=["calib"], title="R",
                progress=tell, pool=side,
            )  # fmt: skip
    one, two = (file_hashes(tmp_path / f"{workers}") for workers in (1, 2))
    assert one == two
    assert "gaps/plain_bekker/index.html" in one
    assert "outputs" in told[2]
    assert {"drawing figures", "genetic algorithm over seeds"} <= told[1] & told[2]
