"""Diagnose many cases on several processes; what is there already is not done again.

It is given case folders and an output folder, and opens nothing else: a key of sealed answers is
not among its inputs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from calib.errors import CalibError
from calib.folders import fresh_folder

__all__ = ["case_folders", "diagnose_cases"]


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
            "there are no cases", where=str(folder), allowed="folders with a case.toml in them",
            mend="make some with `calib challenge make`",
        )  # fmt: skip
    return found


def diagnose_cases(
    cases: Sequence[Path],
    out: Path,
    seed: int,
    *,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, str]:
    """Diagnose cases, each into a folder of its name that appears whole or not at all.

    Parameters
    ----------
    cases : sequence of Path
    out : Path
    seed : int
        Results do not depend on the number of workers.
    workers : int
    progress : callable, optional
        Called with cases done and cases in all.

    Returns
    -------
    dict of str to str
        Cases that failed, with their error.
    """
    missing = [c for c in cases if not (out / c.name / "diagnosis.json").exists()]
    done, failed = len(cases) - len(missing), {}
    if progress is not None:
        progress(done, len(cases))
    if workers == 1:
        for case in missing:
            error = _one(case, out / case.name, seed)
            if error is not None:
                failed[case.name] = error
            done += 1
            if progress is not None:
                progress(done, len(cases))
        return failed
    # Spawned, not forked: numerical libraries keep threads that do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_quiet) as pool:
        futures = {pool.submit(_one, case, out / case.name, seed): case for case in missing}
        for future in as_completed(futures):
            error = future.result()
            if error is not None:
                failed[futures[future].name] = error
            done += 1
            if progress is not None:
                progress(done, len(cases))
    return failed


def _quiet() -> None:
    # One process per core: threads of the linear algebra would only get in each other's way.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"


def _one(case: Path, out: Path, seed: int) -> str | None:
    from calib.gap.case import read_case
    from calib.gap.diagnose import diagnose
    from calib.gap.files import write_diagnosis

    try:
        found = diagnose(read_case(case), seed)
        with fresh_folder(out, overwrite=True) as folder:
            write_diagnosis(found, folder)
    except CalibError as error:
        return str(error)
    return None
