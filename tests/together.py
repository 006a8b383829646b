"""Which tests run in one process when several share the work, and which come first."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
# Files that read the same heavy results (session fixtures, caches, a browser) run in one process,
# so that it has them once. The longest groups first: no process is left with one when the others
# are done. A name that ends in a slash stands for all files of a folder; a file that is not here
# is a group of its own, after these.
GROUPS = (
    ("check/test_check_report.py", "check/test_processors.py", "check/test_check_whole.py",
     "check/test_check_run.py", "check/test_check_comparison.py"),
    ("check/test_reference_report.py",),
    ("check/test_tolerances.py", "check/test_check_diagnosis.py", "docs/test_formats.py"),
    # Calibrations of the embedded data, and the pages and figures on them.
    ("report/figures/test_print.py", "report/figures/test_plates.py", "report/test_writer.py",
     "report/test_verdict.py", "report/test_words.py", "report/page/test_page.py",
     "report/page/test_in_browser.py", "report/test_publish.py", "inference/test_calibration.py",
     "inference/test_io.py", "validation/test_prediction.py",
     "validation/test_consistency.py", "validation/test_scores.py",
     "validation/test_validate.py", "check/test_montecarlo.py",
     "cli/test_audit.py", "cli/test_compare.py", "cli/test_paper_gaps.py",
     "he2019/test_audit.py", "he2019/test_published_table.py", "he2019/test_tables_1_and_6.py",
     "he2019/test_gaps.py",
     "extension/test_extension.py", "validation/test_sbc.py", "docs/test_build.py"),
    ("gap/test_ranking.py", "gap/test_mixture.py", "gap/test_files.py", "gap/test_corrected.py",
     "report/page/test_diagnosis.py", "report/figures/test_gap.py"),
    ("batch/campaign/test_run.py", "batch/campaign/test_kinds.py", "batch/campaign/test_plan.py"),
    ("inference/emulation/test_emulate.py",),
    ("inference/sampling/test_sampler.py",),
    ("batch/test_cluster.py",),
    ("cli/test_cli.py",),
    ("challenge/test_make.py", "gap/test_well_specified.py", "cli/test_challenge.py"),
    ("docs/test_snippets.py",),
    ("abuse/test_mutilated_files.py",),
    ("validation/test_replicate.py",),
    ("test_readme.py",),
    ("gap/test_fit.py",),
    ("inference/test_noise.py",),
)  # fmt: skip


@cache
def place_of(file: str) -> int:
    """Return which group a file of the tests belongs to; their number where none."""
    whole = (i for i, names in enumerate(GROUPS) if file.startswith(names))
    return next(whole, len(GROUPS))


def group_of(path: str) -> str:
    """Return the group of a file, given from the folder of the project."""
    file = path.removeprefix("tests/")
    place = place_of(file)
    return f"group {place}" if place < len(GROUPS) else file


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
        items.sort(key=lambda item: place_of(item.path.relative_to(TESTS).as_posix()))
