"""Tasks in this process: what is kept, what is resumed, what fails, what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from calib.batch.tasks import run_tasks
from calib.errors import CalibError
from tests.batch import work

ITEMS = {f"task-{i}": i for i in range(4)}
FILES = ["seconds.csv", *(f"{name}.json" for name in ITEMS)]


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_each_task_has_its_file_and_is_not_done_again(tmp_path: Path) -> None:
    run_tasks(work.draw, {"task-1": 1}, tmp_path / "out")
    before = (tmp_path / "out" / "task-1.json").stat().st_mtime_ns
    seen = []
    outcome = run_tasks(work.draw, ITEMS, tmp_path / "out", progress=lambda *p: seen.append(p))
    assert (outcome.done, outcome.resumed, outcome.failed) == (tuple(ITEMS), ("task-1",), {})
    assert seen == [(i, 4) for i in range(1, 5)]
    assert names(tmp_path / "out") == FILES
    assert (tmp_path / "out" / "task-1.json").stat().st_mtime_ns == before
    for name, item in ITEMS.items():
        assert json.loads((tmp_path / "out" / f"{name}.json").read_text()) == work.draw(item)
        assert 0.0 < outcome.seconds[name] < 10.0


def test_a_task_can_give_a_folder_with_what_is_inside_it_only(tmp_path: Path) -> None:
    assert run_tasks(work.files, ITEMS, tmp_path / "out", folders=True).done == tuple(ITEMS)
    assert (tmp_path / "out" / "task-2" / "text.txt").read_text() == "2\n"
    assert (tmp_path / "out" / "task-3" / "deep" / "er" / "data.bin").read_bytes() == b"\x03"
    more = {**ITEMS, "a": 1}
    outcome = run_tasks(work.outside, more, tmp_path / "out", folders=True)
    assert outcome.resumed == tuple(ITEMS)
    assert "not inside its folder" in outcome.failed["a"]
    assert names(tmp_path) == ["out"]


def test_failed_tasks_are_listed_and_tried_again(tmp_path: Path) -> None:
    outcome = run_tasks(work.fail_on_odd, ITEMS, tmp_path)
    assert outcome.done == ("task-0", "task-2")
    assert outcome.failed == {
        "task-1": "1 is odd\n  hint: use an even number",
        "task-3": "3 is odd\n  hint: use an even number",
    }
    assert json.loads((tmp_path / "failed.json").read_text()) == outcome.failed
    again = run_tasks(work.draw, ITEMS, tmp_path)
    assert again.resumed == ("task-0", "task-2")
    assert again.done == tuple(ITEMS)
    assert names(tmp_path) == FILES


@pytest.mark.parametrize(
    ("function", "item", "error"),
    [
        (work.break_on_zero, 0, "ZeroDivisionError: division by zero (work.py, line "),
        (work.leave, 0, "SystemExit: 3"),
        (work.not_json, 0, "ValueError: Out of range float values are not JSON compliant"),
        (work.not_json, 1, "TypeError: Object of type ndarray is not JSON serializable"),
    ],
)
def test_whatever_goes_wrong_with_a_task_is_its_own_failure(
    function, item: int, error: str, tmp_path: Path
) -> None:
    assert run_tasks(function, {"a": item}, tmp_path).failed["a"].startswith(error)
    assert names(tmp_path) == ["failed.json", "seconds.csv"]


def test_items_are_read_when_they_are_needed(tmp_path: Path) -> None:
    def read(source: str) -> int:
        asked.append(source)
        if source == "bad":
            raise CalibError("this item cannot be read")
        return 1

    asked: list[str] = []
    run_tasks(work.draw, {"a": 1}, tmp_path)
    outcome = run_tasks(work.draw, {name: name for name in ("a", "bad", "c")}, tmp_path, read=read)
    assert asked == ["bad", "c"]
    assert outcome.done == ("a", "c")
    assert outcome.failed == {"bad": "this item cannot be read"}


def test_it_gives_up_after_failures_in_a_row(tmp_path: Path) -> None:
    items = {"a": 1, "b": 2, "c": 3, "d": 5, "e": 4}
    outcome = run_tasks(work.fail_on_odd, items, tmp_path, give_up=2)
    assert (outcome.done, list(outcome.failed)) == (("b",), ["a", "c", "d"])


@pytest.mark.parametrize("name", ["", ".a", "a/b", "a b", "failed", "ä", "x" * 201])
def test_names_that_are_no_file_names_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(CalibError, match="cannot be the name of a task"):
        run_tasks(work.draw, {name: 1}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_and_no_workers_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibError, match="cannot be written"):
        run_tasks(work.draw, ITEMS, tmp_path / "file")
    with pytest.raises(CalibError, match="0 workers"):
        run_tasks(work.draw, ITEMS, tmp_path, workers=0)


def test_two_runs_cannot_write_to_one_folder(tmp_path: Path) -> None:
    def intrude(done: int, planned: int) -> None:
        if done == 1:
            with pytest.raises(CalibError, match="another process"):
                run_tasks(work.draw, ITEMS, tmp_path)

    assert run_tasks(work.draw, ITEMS, tmp_path, progress=intrude).done == tuple(ITEMS)


def test_an_interruption_keeps_what_is_done(tmp_path: Path) -> None:
    def interrupt(done: int, planned: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="2 of 4 results are kept"):
        run_tasks(work.draw, ITEMS, tmp_path, progress=interrupt)
    assert names(tmp_path) == ["seconds.csv", "task-0.json", "task-1.json"]


def test_leftovers_of_a_kill_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / ".landing" / "task-1").mkdir(parents=True)
    (tmp_path / "seconds.csv").write_text("task-0,0.5\ntask-1,0.")
    (tmp_path / "task-0.json").write_text("{}")
    outcome = run_tasks(work.draw, ITEMS, tmp_path)
    assert outcome.resumed == ("task-0",)
    assert outcome.seconds["task-0"] == 0.5
    assert set(outcome.seconds) == set(ITEMS)
    assert names(tmp_path) == FILES


def test_one_process_does_not_import_dask(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from calib.batch.tasks import run_tasks;"
        "run_tasks(dict, {'a': {}}, Path(sys.argv[1]));"
        "assert not {'dask', 'distributed'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
