"""Which tests run in one process when several share the work, and which come first."""

from __future__ import annotations

from pathlib import Path

import pytest

TESTS = Path(__file__).parent
# Files that read the same heavy results (session fixtures, caches) run in one process, so that it
# has them once. The longest groups first: no process is left with one when the others are done.
# A file that is not here is a group of its own, after these.
GROUPS = (
    ("test_reference_report.py",),
    ("reproduce/test_check_report.py", "reproduce/test_processors.py"),
    ("reproduce/test_check_whole.py",),
    ("reproduce/test_check_run.py",),
    ("campaign/test_run.py", "campaign/test_kinds.py", "campaign/test_plan.py"),
    ("paper_gaps/test_find.py", "paper_gaps/test_cases.py", "cli/test_paper_gaps.py",
     "figures/test_paper_gaps.py", "page/test_paper_gaps.py"),
    ("figures/test_print.py", "figures/test_plates.py"),
    ("tasks/test_cluster.py",),
    ("sampling/test_sampler.py",),
    ("challenge/test_make.py", "gap/test_well_specified.py"),
    ("cli/test_cli.py",),
    ("sbc/test_run.py",),
    ("test_report.py",),
    ("test_contents.py",),
    ("test_validate.py",),
    ("cli/test_campaign.py",),
    ("page/test_diagnosis.py", "figures/test_gap.py", "gap/test_files.py", "gap/test_shrink.py",
     "gap/test_where.py"),
    ("audit/test_run.py", "cli/test_audit.py", "figures/test_audit.py", "page/test_audit.py"),
    ("gap/test_which.py", "gap/test_isolate.py", "gap/test_relevance.py",
     "gap/test_next_measurement.py"),
    ("gap/test_batch.py",),
    ("sbc/test_replicate.py",),
    ("cli/test_check.py",),
    ("audit/test_table5_cost.py",),
    ("gap/test_refine.py",),
)  # fmt: skip
GROUP = {file: i for i, files in enumerate(GROUPS) for file in files}


def group_of(path: str) -> str:
    """Return the group of a file, given from the folder of the project."""
    file = path.removeprefix("tests/")
    return f"group {GROUP[file]}" if file in GROUP else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Share groups out in their order; without it files, those of the most tests first."""
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid.partition("::")[0])

    config.option.loadscopereorder = False
    return Groups(config, log)


def pytest_collection_modifyitems(config, items) -> None:
    """Put the longest groups first in the processes that share the work."""
    if hasattr(config, "workerinput"):
        last = len(GROUPS)
        items.sort(key=lambda item: GROUP.get(item.path.relative_to(TESTS).as_posix(), last))
