"""Pieces of one result: the same wherever they are worked out, and clear errors."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import active_children, forkserver
from pathlib import Path

import pytest

from calib.batch.pool import HERE, pool
from calib.errors import CalibError

# What most of these need imported: what a report does takes seconds, for each server anew.
LIGHT = ("calib.errors",)


def square(x: int) -> tuple[int, int]:
    return x * x, os.getpid()


def fail(words: str) -> None:
    raise CalibError(words, hint="do")


def die() -> None:
    os._exit(9)


def leave(path: Path) -> None:
    path.write_text("there")


def test_pieces_come_from_other_processes_in_the_order_they_are_asked_for() -> None:
    with pool(2) as side:
        assert not side.here
        pieces = [side.submit(square, x) for x in range(5)]
        results = [piece.result() for piece in pieces]
    assert [value for value, _ in results] == [0, 1, 4, 9, 16]
    assert os.getpid() not in {pid for _, pid in results}


def test_one_worker_is_this_process_and_works_when_the_piece_is_wanted(tmp_path: Path) -> None:
    with pool(1) as side:
        assert side is HERE
        piece = side.submit(leave, tmp_path / "file")
        assert not (tmp_path / "file").exists()
        piece.result()
        assert (tmp_path / "file").exists()
        assert side.submit(square, 3).result() == (9, os.getpid())


def test_an_interruption_ends_the_processes_at_their_work() -> None:
    with pytest.raises(KeyboardInterrupt), pool(2, LIGHT) as side:  # noqa: PT012
        side.submit(square, 2).result()
        side.submit(time.sleep, 600.0)
        working = active_children()
        raise KeyboardInterrupt
    assert working
    for process in working:
        process.join(60.0)
        assert process.exitcode


def test_a_server_that_is_gone_hides_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that an earlier pool ended, whose place no other has taken yet."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    monkeypatch.setattr("calib.batch.pool._serve", lambda: None)
    monkeypatch.setattr(forkserver._forkserver, "_forkserver_pid", gone.pid)
    with pytest.raises(CalibError, match="of the work"), pool(2, LIGHT):
        raise CalibError("of the work")


def test_an_interruption_while_the_last_pieces_are_waited_for_ends_the_processes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A piece that nobody waits for would keep a script from ending."""
    orderly = ProcessPoolExecutor.shutdown

    def interrupted(executor: ProcessPoolExecutor, wait: bool = True, **how: bool) -> None:
        if wait:
            raise KeyboardInterrupt
        orderly(executor, wait, **how)

    monkeypatch.setattr(ProcessPoolExecutor, "shutdown", interrupted)
    with pytest.raises(KeyboardInterrupt), pool(2, LIGHT) as side:  # noqa: PT012
        side.submit(square, 2).result()
        side.submit(time.sleep, 600.0)
        working = active_children()
    assert working
    for process in working:
        process.join(60.0)
        assert process.exitcode


def test_where_no_process_can_start_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def short(*_: object) -> None:
        raise OSError(24, "too many open files")

    monkeypatch.setattr("calib.batch.pool._serve", short)
    monkeypatch.setattr(ProcessPoolExecutor, "submit", short)
    with pool(2, LIGHT) as side:
        piece = side.submit(square, 2)
        with pytest.raises(OSError, match="too many"):
            piece.result()


def test_what_waits_is_not_begun_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calib.batch.pool._start", lambda *_: None)
    asked: list[object] = []
    monkeypatch.setattr(ProcessPoolExecutor, "submit", lambda _, work: asked.append(work))
    with pytest.raises(CalibError, match="stop"), pool(2, LIGHT) as side:  # noqa: PT012
        side.submit(square, 2)
        raise CalibError("stop")
    side.begun()
    assert asked == []


@pytest.mark.parametrize("workers", [1, 2])
def test_what_goes_wrong_with_a_piece_is_raised_where_it_is_wanted(workers: int) -> None:
    with pool(workers, LIGHT) as side:
        wrong, fine = side.submit(fail, "mine"), side.submit(square, 2)
        with pytest.raises(CalibError, match="mine"):
            wrong.result()
        assert fine.result()[0] == 4


def test_a_process_that_dies_is_a_clear_error() -> None:
    with pool(2, LIGHT) as side, pytest.raises(CalibError, match="a process died"):
        side.submit(die).result()


def test_a_death_that_the_executor_did_not_see_is_noticed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """While one waits, the executor is made to look at its processes again."""
    monkeypatch.setattr("calib.batch.pool._LOOK_SECONDS", 0.05)
    with pool(2, LIGHT) as side:
        slow = side.submit(time.sleep, 0.4)
        assert slow.result() is None
        with pytest.raises(CalibError, match="a process died"):
            side.submit(die).result()


def test_what_was_asked_last_is_worked_out_here_until_the_processes_have_begun(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("calib.batch.pool._start", lambda *_: None)
    with pool(2, LIGHT) as side:
        first, long = side.submit(square, 1), side.submit_long(square, 2)
        last = side.submit(square, 3)
        assert side._last() is last  # type: ignore[comparison-overlap]
        last.work()  # type: ignore[attr-defined]
        assert last.result() == (9, os.getpid())
        assert side._waiting == [long, first]
        side.begun()
        assert [piece.result()[0] for piece in (first, long)] == [1, 4]
        assert os.getpid() not in {piece.result()[1] for piece in (first, long)}
        side.help()  # nothing is left to do here
        wrong = side.submit(fail, "over there")
        with pytest.raises(CalibError, match="over there"):
            wrong.result()


def test_what_goes_wrong_here_is_raised_where_it_is_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("calib.batch.pool._start", lambda *_: None)
    with pool(2, LIGHT) as side:
        wrong = side.submit(fail, "mine")
        side.help()
        with pytest.raises(CalibError, match="mine"):
            wrong.result()


@pytest.mark.parametrize("safe", [None, "1"])
def test_modules_of_the_working_folder_are_not_taken_for_libraries(
    safe: str | None, tmp_path: Path
) -> None:
    """A user's own `colorsys.py`, say; what the processes start finds the environment as it was."""
    (tmp_path / "colorsys.py").write_text("raise SystemExit('the user's own')")
    script = tmp_path / "elsewhere" / "script.py"
    script.parent.mkdir()
    script.write_text(
        "import os\n"
        "from calib.batch.pool import pool\n"
        "if __name__ == '__main__':\n"
        "    with pool(2, ('colorsys',)) as side:\n"
        "        print(side.submit(os.getenv, 'PYTHONSAFEPATH').result())\n"
        "    print(os.getenv('PYTHONSAFEPATH'))\n"
    )
    own = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    ran = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=True,
        env=own if safe is None else own | {"PYTHONSAFEPATH": safe},
    )  # fmt: skip
    assert ran.stdout.split() == [str(safe), str(safe)]
    assert "the user" not in ran.stderr
