"""Diagnose many cases, here or on a cluster; what is there already is not done again.

It is given case folders and an output folder, and opens nothing else: a key of sealed answers is
not among its inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from calib.batch.folders import read_folder
from calib.batch.tasks import LateItems, run_folder_tasks
from calib.errors import CalibError
from calib.gap.case import Case, read_case
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.files import write_diagnosis
from calib.gap.provenance import INPUTS, check_resumable, inputs_record


def case_folders(folder: Path) -> list[Path]:
    """Return the case folders in a folder, by name.

    Raises
    ------
    CalibError
        If there is none.
    """
    found = sorted(p.parent for p in Path(folder).glob("*/case.toml"))
    if not found:
        raise CalibError(
            "there are no cases", where=str(folder), expected="folders with a case.toml in them",
            hint="make some with `calib challenge make`",
        )  # fmt: skip
    return found


def diagnose_cases(
    cases: Sequence[Path],
    out: Path,
    seed: int,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> dict[str, str]:
    """Diagnose cases, each into a folder of its name that appears whole or not at all.

    Parameters
    ----------
    seed : int
        Results do not depend on the number of workers.
    workers, scheduler, progress, announce
        As for `calib.batch.tasks.run_tasks`.

    Returns
    -------
    dict of str to str
        Cases that failed, with their error.

    Raises
    ------
    CalibError
        If there are diagnoses of other cases, or with another seed.
    """
    check_resumable(cases, out, seed)
    outcome = run_folder_tasks(
        partial(_diagnose, seed=seed),
        LateItems({case.name: case for case in cases}, read_case),
        out, workers=workers, scheduler=scheduler, progress=progress, announce=announce,
    )  # fmt: skip
    return dict(outcome.failed)


def _diagnose(case: Case, seed: int) -> dict[str, bytes]:
    return written(diagnose(case, seed))


def written(found: Diagnosis, effects: Mapping[str, bytes] | None = None) -> dict[str, bytes]:
    """Return the files of a diagnosis, by name, to be written elsewhere.

    Parameters
    ----------
    effects : mapping of str to bytes, optional
        Files of the user's own effects, by name.
    """
    with TemporaryDirectory() as scratch:
        write_diagnosis(found, Path(scratch))
        files = read_folder(Path(scratch))
    return files | {INPUTS: inputs_record(found.data.case, found.seed, effects)}
