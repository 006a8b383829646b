"""Tasks in this process: what lands, what is resumed, what fails, what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from calib.batch.tasks import run_folder_tasks, run_tasks
from calib.errors import CalibError
from tests.batch.tasks import work

ITEMS = {f"task-{i}": i for i in range(4)}


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_each_task_has_its_file(tmp_path):
    seen = []
    outcome = run_tasks(work.draw, ITEMS, tmp_path / "out", progress=lambda *p: seen.append(p))
    assert outcome.done == tuple(ITEMS)
    assert outcome.resumed == ()
    assert outcome.failed == {}
    assert seen == [(i, 4) for i in range(5)]
    assert names(tmp_path / "out") == ["seconds.csv", *(f"task-{i}.json" for i in range(4))]
    for name, item in ITEMS.items():
        assert json.loads((tmp_path / "out" / f"{name}.json").read_text()) == work.draw(item)
        assert 0.0 < outcome.seconds[name] < 10.0


def test_a_task_can_give_a_folder(tmp_path):
    outcome = run_folder_tasks(work.files, ITEMS, tmp_path)
    assert outcome.done == tuple(ITEMS)
    assert (tmp_path / "task-2" / "text.txt").read_text() == "2\n"
    assert (tmp_path / "task-3" / "deep" / "er" / "data.bin").read_bytes() == b"\x03"
    assert run_folder_tasks(work.leave, ITEMS, tmp_path).resumed == tuple(ITEMS)


def test_a_folder_holds_what_is_inside_it_only(tmp_path):
    outcome = run_folder_tasks(work.outside, {"a": 1}, tmp_path / "out")
    assert "not inside its folder" in outcome.failed["a"]
    assert names(tmp_path) == ["out"]


def test_what_is_there_is_not_done_again(tmp_path):
    run_tasks(work.draw, {"task-1": 1}, tmp_path)
    before = (tmp_path / "task-1.json").stat().st_mtime_ns
    seen = []
    outcome = run_tasks(work.draw, ITEMS, tmp_path, progress=lambda *p: seen.append(p))
    assert outcome.resumed == ("task-1",)
    assert outcome.done == tuple(ITEMS)
    assert seen == [(i, 4) for i in range(1, 5)]
    assert (tmp_path / "task-1.json").stat().st_mtime_ns == before
    assert set(outcome.seconds) == set(ITEMS)


def test_failed_tasks_are_listed_and_tried_again(tmp_path):
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
    assert not (tmp_path / "failed.json").exists()


def test_an_unforeseen_error_says_where(tmp_path):
    outcome = run_tasks(work.break_on_zero, {"zero": 0, "one": 1}, tmp_path)
    assert outcome.done == ("one",)
    assert outcome.failed["zero"].startswith("ZeroDivisionError: division by zero (work.py, line ")


def test_a_task_cannot_end_the_others(tmp_path):
    assert run_tasks(work.leave, {"a": 1}, tmp_path).failed["a"].startswith("SystemExit: 3")


@pytest.mark.parametrize(("item", "error"), [(0, "not JSON compliant"), (1, "not JSON serializ")])
def test_what_json_cannot_hold_is_a_failure(tmp_path, item, error):
    assert error in run_tasks(work.not_json, {"a": item}, tmp_path).failed["a"]
    assert names(tmp_path) == ["failed.json", "seconds.csv"]


class Lazy(Mapping[str, int]):
    """Items read when they are asked for."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def __getitem__(self, name: str) -> int:
        self.asked.append(name)
        if name == "bad":
            raise CalibError("this item cannot be read")
        return 1

    def __iter__(self) -> Iterator[str]:
        return iter(("a", "bad", "c"))

    def __len__(self) -> int:
        return 3


def test_items_are_asked_for_when_they_are_needed(tmp_path):
    run_tasks(work.draw, {"a": 1}, tmp_path)
    items = Lazy()
    outcome = run_tasks(work.draw, items, tmp_path)
    assert items.asked == ["bad", "c"]
    assert outcome.done == ("a", "c")
    assert outcome.failed == {"bad": "this item cannot be read"}


@pytest.mark.parametrize("name", ["", ".a", "a/b", "a b", "failed", "ä", "x" * 201])
def test_names_that_are_no_file_names_are_refused(tmp_path, name):
    with pytest.raises(CalibError, match="cannot be the name of a task"):
        run_tasks(work.draw, {name: 1}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibError, match="cannot be written"):
        run_tasks(work.draw, ITEMS, tmp_path / "file")


def test_no_workers_are_refused(tmp_path):
    with pytest.raises(CalibError, match="0 workers"):
        run_tasks(work.draw, ITEMS, tmp_path, workers=0)


def test_two_runs_cannot_write_to_one_folder(tmp_path):
    def intrude(done: int, planned: int) -> None:
        if done == 1:
            with pytest.raises(CalibError, match="another process"):
                run_tasks(work.draw, ITEMS, tmp_path)

    assert run_tasks(work.draw, ITEMS, tmp_path, progress=intrude).done == tuple(ITEMS)


def test_an_interruption_keeps_what_is_done(tmp_path):
    def interrupt(done: int, planned: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_tasks(work.draw, ITEMS, tmp_path, progress=interrupt)
    assert names(tmp_path) == ["seconds.csv", "task-0.json", "task-1.json"]
    assert run_tasks(work.draw, ITEMS, tmp_path).resumed == ("task-0", "task-1")


def test_leftovers_of_a_kill_do_no_harm(tmp_path):
    (tmp_path / ".landing" / "task-1").mkdir(parents=True)
    (tmp_path / "seconds.csv").write_text("task-0,0.5\ntask-1,0.")
    (tmp_path / "task-0.json").write_text("{}")
    outcome = run_tasks(work.draw, ITEMS, tmp_path)
    assert outcome.resumed == ("task-0",)
    assert outcome.seconds["task-0"] == 0.5
    assert set(outcome.seconds) == set(ITEMS)
    assert names(tmp_path) == ["seconds.csv", *(f"task-{i}.json" for i in range(4))]


def test_one_process_does_not_import_dask(tmp_path):
    code = (
        "import sys; from pathlib import Path; from calib.batch.tasks import run_tasks;"
        "run_tasks(dict, {'a': {}}, Path(sys.argv[1]));"
        "assert not {'dask', 'distributed'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
