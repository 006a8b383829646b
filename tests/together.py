"""Which tests run in one process when several share the work, and which come first."""

from __future__ import annotations

from pathlib import Path

import pytest

TESTS = Path(__file__).parent
# Files that read the same heavy results (session fixtures, caches) run in one process, so that it
# has them once. The longest groups first: no process is left with one when the others are done.
# A file that is not here is a group of its own, after these.
GROUPS = (
    ("check/test_reference_report.py",),
    ("check/test_check_report.py", "check/test_processors.py", "check/test_check_whole.py"),
    ("check/test_check_run.py",),
    ("batch/campaign/test_run.py", "batch/campaign/test_kinds.py", "batch/campaign/test_plan.py"),
    ("he2019/gaps/test_find.py", "he2019/gaps/test_cases.py", "cli/test_paper_gaps.py",
     "he2019/figures/test_gaps.py", "he2019/page/test_gaps.py"),
    ("report/figures/test_print.py", "report/figures/test_plates.py", "report/test_writer.py",
     "report/page/test_page.py"),
    ("batch/tasks/test_cluster.py",),
    ("inference/sampling/test_sampler.py",),
    ("challenge/test_make.py", "gap/test_well_specified.py", "cli/test_challenge.py"),
    ("cli/test_cli.py",),
    ("validation/sbc/test_run.py",),
    ("report/test_contents.py",),
    ("validation/test_validate.py",),
    ("cli/test_campaign.py",),
    ("report/page/test_diagnosis.py", "report/figures/test_gap.py", "gap/test_files.py",
     "gap/test_shrink.py", "gap/test_where.py"),
    ("he2019/audit/test_run.py", "cli/test_audit.py", "he2019/figures/test_audit.py",
     "he2019/page/test_audit.py"),
    ("gap/test_which.py", "gap/test_isolate.py", "gap/test_relevance.py",
     "gap/test_next_measurement.py"),
    ("docs/test_snippets.py",),
    ("docs/test_build.py",),
    ("gap/test_batch.py",),
    ("validation/sbc/test_replicate.py",),
    ("cli/test_check.py",),
    ("he2019/audit/test_table5_cost.py",),
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
