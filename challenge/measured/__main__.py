"""Diagnose the measured cases with the program, and mark what it wrote."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from calib.errors import CalibError
from challenge.answers import read_answer
from challenge.measured.cases import SIMULATORS, read_cases
from challenge.measured.marks import markdown
from challenge.seal import open_answers

# The bench knows what the program reads and writes, and imports none of the diagnosis.
_PROGRAM = (sys.executable, "-c", "from calib.cli import main; main()")


def run(
    out: Path,
    *,
    set_aside: bool = False,
    seed: int = 1,
    only: Sequence[str] = (),
    leave_out: int = 0,
    diagnosed: bool = True,
) -> str:
    """Write cases, answers, diagnoses and their marks to a folder.

    Parameters
    ----------
    out : Path
        A folder that is not there.
    set_aside : bool
        The third that is looked at once, and nothing else.
    seed : int
        Of the diagnoses.
    only : sequence of str
        Names of cases; all by default.
    leave_out : int
        Of so many field rows one is to be predicted.
    diagnosed : bool
        False for the cases and answers alone, for other programs.

    Returns
    -------
    str
        The marks, Markdown.

    Raises
    ------
    CalibError
        If the folder is there, or no case has these names.
    """
    chosen = [c for c in read_cases() if c.set_aside == set_aside and (not only or c.name in only)]
    if not chosen:
        raise CalibError(
            f"no such case: {', '.join(only)}", where="--only",
            expected=", ".join(c.name for c in read_cases() if c.set_aside == set_aside),
            hint="correct the name",
        )  # fmt: skip
    if out.exists():
        raise CalibError(
            "the folder is there already", where=str(out), expected="a new folder",
            hint="name another one",
        )  # fmt: skip
    for case in chosen:
        case.write(out / "cases" / case.name, out / "answers", leave_out)
    if not diagnosed:
        return f"{len(chosen)} cases in {out / 'cases'}, their answers in {out / 'answers'}"
    results = out / "results"
    # A case that cannot be diagnosed is named by the program and marked as failed.
    subprocess.run(
        [*_PROGRAM, "challenge", "run", str(out / "cases"), "--out", str(results),
         "--seed", str(seed), "--workers", "1",
         *(word for file in SIMULATORS for word in ("--models", str(file)))], check=False,
    )  # fmt: skip
    answers = open_answers(out / "cases", out / "answers")
    found = [read_answer(case.name, answers[case.name], results / case.name) for case in chosen]
    table = markdown(found, chosen)
    (out / "measured.md").write_text(table, encoding="utf-8")
    return table


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m challenge.measured", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="new folder for the results")
    parser.add_argument("--set-aside", action="store_true", help="the cases that are set aside")
    parser.add_argument("--only", nargs="*", default=(), metavar="CASE", help="these cases")
    parser.add_argument("--seed", type=int, default=1, help="same seed, same numbers")
    parser.add_argument("--leave-out", type=int, default=0, metavar="N",
                        help="leave one of N field rows out, to be predicted")  # fmt: skip
    parser.add_argument("--cases-only", action="store_true", help="write cases and answers alone")
    given = parser.parse_args()
    try:
        print(run(given.out, set_aside=given.set_aside, seed=given.seed, only=given.only,
                  leave_out=given.leave_out, diagnosed=not given.cases_only))  # fmt: skip
    except CalibError as error:
        print(f"calib: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
