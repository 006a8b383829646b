"""Pieces of one result: the same wherever they are worked out, and clear errors."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from pathlib import Path

import psutil
import pytest

from calib.batch.pool import HERE, pool
from calib.errors import CalibError


def square(x: int) -> tuple[int, int]:
    return x * x, os.getpid()


def fail(words: str) -> None:
    raise CalibError(words, hint="do")


@pytest.fixture(scope="module")
def two() -> Iterator[Executor]:
    with pool(2) as side:
        yield side


def test_pieces_come_from_other_processes_in_the_order_they_are_asked_for(two: Executor) -> None:
    results = [piece.result() for piece in [two.submit(square, x) for x in range(5)]]
    assert [value for value, _ in results] == [0, 1, 4, 9, 16]
    assert os.getpid() not in {pid for _, pid in results}


def test_one_worker_is_this_process_and_works_when_the_piece_is_wanted(tmp_path: Path) -> None:
    with pool(1) as side:
        assert side is HERE
        piece = side.submit((tmp_path / "file").write_text, "there")
        assert not (tmp_path / "file").exists()
        assert piece.result() == piece.result() == 5
        assert (tmp_path / "file").exists()
        assert side.submit(square, 3).result() == (9, os.getpid())


@pytest.mark.parametrize("here", [False, True])
def test_what_goes_wrong_with_a_piece_is_raised_where_it_is_wanted(
    here: bool, two: Executor
) -> None:
    side = HERE if here else two
    wrong, fine = side.submit(fail, "mine"), side.submit(square, 2)
    with pytest.raises(CalibError, match="mine"):
        wrong.result()
    assert fine.result()[0] == 4


def started(before: list[BaseProcess]) -> list[BaseProcess]:
    return [process for process in active_children() if process not in before]


def test_an_interruption_ends_the_processes_at_their_work() -> None:
    before = active_children()
    with pytest.raises(KeyboardInterrupt), pool(2) as side:  # noqa: PT012
        side.submit(time.sleep, 600.0)
        working = started(before)
        raise KeyboardInterrupt
    assert len(working) == 2
    for process in working:
        process.join(60.0)
        # The executor's own thread may be taking the exit code at this moment.
        until = time.monotonic() + 60.0
        while process.exitcode is None and time.monotonic() < until:
            time.sleep(0.01)
        assert process.exitcode == -signal.SIGKILL


def test_a_process_that_dies_is_a_clear_error_and_ends_the_others() -> None:
    before = active_children()
    with pytest.raises(CalibError, match="a process died"), pool(2) as side:
        side.submit(os._exit, 9).result()
    for process in started(before):
        process.join(60.0)
        assert process.exitcode is not None


def test_processes_end_with_the_one_that_waits_and_find_no_library_in_its_folder(
    tmp_path: Path,
) -> None:
    """Neither its death nor a user's own `colorsys.py` beside the data must harm."""
    (tmp_path / "colorsys.py").write_text("raise SystemExit('the user's own')")
    script = tmp_path / "elsewhere" / "script.py"
    script.parent.mkdir()
    script.write_text(
        "import os, signal\n"
        "from calib.batch.pool import pool\n"
        "if __name__ == '__main__':\n"
        "    with pool(2) as side:\n"
        "        print(side.submit(eval, '__import__(\"colorsys\").__name__').result())\n"
        "        print(side.submit(os.getpid).result(), flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ran = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    name, pid = ran.stdout.split()
    assert (name, ran.returncode, "the user" in ran.stderr) == ("colorsys", -signal.SIGKILL, False)
    # `run` has returned: nobody has its output open any more.
    assert not psutil.pid_exists(int(pid)) or psutil.Process(int(pid)).status() == "zombie"
