"""Any program on every case of a folder: one process for each, a limit of time, its files kept."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from calib.batch.folders import read_folder
from calib.batch.tasks import run_tasks
from calib.errors import CalibError
from calib.models.simulators.process import run_program
from calib.models.simulators.simulator import Failure
from challenge.format import Scored, read_document
from challenge.results import INPUTS, found_in

CASE, OUT, PROGRAM = "{case}", "{out}", "program.txt"


def run_programs(
    command: str,
    cases: Sequence[Path],
    out: Path,
    *,
    limit: float,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> dict[str, str]:
    """Run a program on cases; run again to resume.

    Each case is copied to where no path leads to other cases or to answers.

    Parameters
    ----------
    command : str
        As typed in a shell, without its variables and pipes; ``{case}`` and ``{out}`` stand for
        the case's folder and one that is empty. Paths of files are relative to this folder.
    cases : sequence of Path
        Case folders.
    out : Path
        Gets what the program wrote for each case, and `calib.batch.tasks.SECONDS`.
    limit : float
        Seconds that each case may take.
    workers, progress, announce
        As for `calib.batch.tasks.run_tasks`.

    Returns
    -------
    dict of str to str
        Cases for which the program failed or wrote no diagnosis that can be scored, and why.

    Raises
    ------
    CalibError
        If the command does not say where its files go, or another one has written to `out`.
    """
    # Links are not followed: a Python finds its packages by the one it was started with.
    words = [str(Path(w).absolute()) if Path(w).exists() else w for w in shlex.split(command)]
    for mark in (CASE, OUT):
        if not any(mark in word for word in words):
            raise CalibError(
                f"there is no {mark} in it", where="--program",
                expected="a command such as 'python rival.py {case} {out}'", hint="add it",
            )  # fmt: skip
    note = out / PROGRAM
    there = note.read_text(encoding="utf-8") if note.exists() else None
    if out.exists() and any(out.iterdir()) and there != command:
        raise CalibError(
            "the results that are there are of another program", where=str(out),
            expected="a new folder", hint="choose another folder",
        )  # fmt: skip
    work, items = partial(_run, words, limit), {case.name: case.resolve() for case in cases}
    out.mkdir(parents=True, exist_ok=True)
    note.write_text(command, encoding="utf-8")
    return dict(
        run_tasks(
            work, items, out, folders=True, workers=workers, progress=progress, announce=announce
        ).failed
    )


def _run(words: Sequence[str], limit: float, case: Path) -> dict[str, bytes]:
    """Return the files that a program writes for a case."""
    with TemporaryDirectory() as scratch:
        copy, made = Path(scratch) / case.name, Path(scratch) / "out"
        shutil.copytree(case, copy)
        made.mkdir()
        typed = [word.replace(CASE, str(copy)).replace(OUT, str(made)) for word in words]
        ran = run_program(typed, Path(scratch), limit)
        if isinstance(ran, Failure):
            raise CalibError(f"{ran.reason}; it printed: {ran.printed.strip() or 'nothing'}")
        read_document(made / "diagnosis.json", Scored)
        files = read_folder(made)
    return {INPUTS: (json.dumps(found_in(case), indent=1) + "\n").encode()} | files
