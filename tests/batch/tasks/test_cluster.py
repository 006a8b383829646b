"""Tasks on worker processes: the same files, and nothing lost when a process dies."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Thread

import pytest

from calib.batch import cluster
from calib.batch.tasks import run_folder_tasks, run_tasks
from calib.errors import CalibError
from tests.batch.tasks import work

ROOT = Path(__file__).parents[3]
# Started processes import the functions of `work`, and calib from where this process has it.
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def content(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != "seconds.csv"
    }


def dask_workers() -> list[BaseProcess]:
    return [p for p in active_children() if p.name.startswith("Dask Worker")]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory) -> Iterator[str]:
    with scheduler_and_worker(tmp_path_factory.mktemp("cluster")) as (address, _):
        yield address


@contextmanager
def scheduler_and_worker(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Yield the address of a scheduler with one worker, started as a user would, and both."""
    environment = ENVIRONMENT | {"PYTHONWARNINGS": "ignore"}
    file = folder / "scheduler.json"

    def start(*command: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "distributed.cli." + command[0], *command[1:]],
            env=environment, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    processes = [
        start("dask_scheduler", "--scheduler-file", str(file), "--host", "127.0.0.1", "--port",
              "0", "--no-dashboard", "--no-show"),
        start("dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard",
              "--local-directory", str(folder)),
    ]  # fmt: skip
    try:
        while not file.exists() or not file.read_text():
            assert processes[0].poll() is None
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"], processes
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


def test_two_workers_and_a_cluster_write_what_one_process_writes(tmp_path, scheduler):
    items = {f"t{i}": i for i in range(30)}
    said = []
    for i, options in enumerate(({}, {"workers": 2}, {"scheduler": scheduler})):
        folder = tmp_path / str(i)
        assert run_tasks(work.draw, items, folder, announce=said.append, **options).failed == {}
        assert content(folder) == content(tmp_path / "0")
    assert len(content(tmp_path / "0")) == 30
    # Two workers here: `tests/gap/test_batch.py`.
    for i, options in enumerate(({}, {"scheduler": scheduler})):
        run_folder_tasks(work.files, items, tmp_path / f"folders {i}", **options)
    assert content(tmp_path / "folders 0") == content(tmp_path / "folders 1")
    assert len(content(tmp_path / "folders 0")) == 60
    assert "2 workers here" in said[0]
    assert scheduler in said[1]


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [pytest.param(None, None, marks=pytest.mark.slow), ("65536", None), ("1000000", "1000000")],
)
def test_workers_are_processes_of_their_own_with_one_thread_each(
    tmp_path, monkeypatch, ours, theirs
):
    """Dask leaves its 65536 in the environment when it starts workers, which costs them half their
    time in page faults; any other value is the user's."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    if ours is not None:
        monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", ours)
    run_tasks(work.where, {f"t{i}": i for i in range(8)}, tmp_path, workers=2)
    found = [json.loads(p.read_text()) for p in tmp_path.glob("t*.json")]
    assert len({f["pid"] for f in found} - {os.getpid()}) == 2
    assert {f["threads"] for f in found} == {"1"}
    assert {f["trim"] for f in found} == {theirs}
    assert os.environ.get("MALLOC_TRIM_THRESHOLD_") == ours


def test_errors_are_those_of_one_process(tmp_path, scheduler):
    items = {f"t{i}": i for i in range(6)}
    one = run_tasks(work.fail_on_odd, items, tmp_path / "one")
    two = run_tasks(work.fail_on_odd, items, tmp_path / "two", scheduler=scheduler)
    assert one.failed == two.failed
    assert one.done == two.done
    assert content(tmp_path / "one") == content(tmp_path / "two")


def test_items_that_cannot_be_sent_fail_alone(tmp_path, scheduler):
    outcome = run_tasks(work.draw, {"a": lambda: 0, "b": 1}, tmp_path, scheduler=scheduler)
    assert outcome.done == ("b",)
    assert "a" in outcome.failed


def test_more_tasks_than_the_scheduler_is_given_at_once(tmp_path, monkeypatch, scheduler):
    most: list[int] = []
    real = cluster._Sent.come

    def come(sent):
        most.append(len(sent))
        return real(sent)

    monkeypatch.setattr(cluster._Sent, "come", come)
    items = {f"t{i}": i for i in range(40)}
    for name, value, expected in (("WINDOW", 7, 7), ("BATCH", 3, 7), ("BYTES", 20, 4)):
        monkeypatch.setattr(cluster, name, value)
        outcome = run_tasks(work.draw, items, tmp_path / name, scheduler=scheduler)
        assert outcome.done == tuple(items)
        assert max(most) == expected
        most.clear()


def test_many_items_are_sent_without_a_warning(tmp_path, scheduler):
    items = {f"t{i}": (bytes(6_000_000), i) for i in range(4)}
    assert len(run_tasks(work.second, items, tmp_path, scheduler=scheduler).done) == 4


def test_a_worker_that_dies_loses_nothing(tmp_path):
    items = {f"t{i}": ("deadly" if i == 3 else "", str(tmp_path / "memory"), i) for i in range(12)}
    outcome = run_tasks(work.die_once, items, tmp_path / "out", workers=2)
    assert (tmp_path / "memory").exists()
    assert outcome.failed == {}
    assert outcome.done == tuple(items)


def test_a_task_that_kills_its_workers_fails_alone(tmp_path):
    items = {f"t{i}": ("deadly" if i == 1 else "", i) for i in range(8)}
    outcome = run_tasks(work.die, items, tmp_path, workers=2)
    assert list(outcome.failed) == ["t1"]
    assert "the process that ran this task died" in outcome.failed["t1"]
    assert len(outcome.done) == 7


_CLIENT = """
import sys
from pathlib import Path
from calib.batch.tasks import run_tasks
from tests.batch.tasks import work

if __name__ == "__main__":
    items = {f"t{i}": (i, 0.1) for i in range(30)}
    run_tasks(work.slow, items, Path(sys.argv[1]), workers=2)
"""


def test_a_client_that_is_killed_is_resumed(tmp_path):
    (tmp_path / "client.py").write_text(_CLIENT)
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "client.py"), str(out)],
        env=ENVIRONMENT, start_new_session=True,
    )  # fmt: skip
    while len(list(out.glob("t*.json"))) < 5:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    there = {p.name: p.stat().st_mtime_ns for p in out.glob("t*.json")}
    assert 5 <= len(there) < 30
    assert all(json.loads((out / name).read_text()) for name in there)
    # Its workers end with it.
    until = time.monotonic() + 30.0
    while _of_group(process.pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert _of_group(process.pid) == []
    items = {f"t{i}": (i, 0.0) for i in range(30)}
    outcome = run_tasks(work.slow, items, out)
    assert len(outcome.resumed) == len(there)
    assert outcome.done == tuple(items)
    assert {n: (out / n).stat().st_mtime_ns for n in there} == there
    run_tasks(work.slow, items, tmp_path / "serial")
    assert content(out) == content(tmp_path / "serial")


def _of_group(group: int) -> list[int]:
    import psutil

    found = []
    for process in psutil.process_iter():
        try:
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        except (ProcessLookupError, psutil.NoSuchProcess):
            pass
    return found


def test_a_script_without_a_guard_is_told_so(tmp_path):
    script = _CLIENT.replace('if __name__ == "__main__":', "if True:")
    (tmp_path / "client.py").write_text(script)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "client.py"), str(tmp_path / "out")],
        env=ENVIRONMENT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert 'put the call below `if __name__ == "__main__":`' in done.stderr
    assert list((tmp_path / "out").glob("*.json")) == []


@pytest.mark.slow
def test_a_scheduler_that_is_lost_is_told(tmp_path):
    with scheduler_and_worker(tmp_path) as (address, processes):

        def lose(done: int, planned: int) -> None:
            if done == 2:
                processes[0].kill()

        items = {f"t{i}": (i, 0.2) for i in range(10)}
        with pytest.raises(CalibError, match="connection to the Dask scheduler was lost"):
            run_tasks(work.slow, items, tmp_path / "out", scheduler=address, progress=lose)
    outcome = run_tasks(work.slow, items, tmp_path / "out")
    assert len(outcome.resumed) >= 2
    assert outcome.done == tuple(items)


def test_a_scheduler_that_is_not_there_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with pytest.raises(CalibError, match="no Dask scheduler"):
            run_tasks(work.draw, {"a": 1}, tmp_path, scheduler=address)


def test_workers_of_other_versions_are_refused(tmp_path, scheduler, monkeypatch):
    monkeypatch.setattr(cluster, "_SAME", ("numpy", "pytest"))
    with pytest.raises(CalibError, match=r"would not give the same numbers.*pytest"):
        run_tasks(work.draw, {"a": 1}, tmp_path, scheduler=scheduler)


def test_the_cluster_is_not_asked_when_nothing_is_missing(tmp_path):
    run_tasks(work.draw, {"a": 1}, tmp_path)
    assert run_tasks(work.draw, {"a": 1}, tmp_path, scheduler="tcp://127.0.0.1:1").done == ("a",)


def test_an_interruption_does_not_wait_for_workers_at_their_work(tmp_path, monkeypatch):
    # Asked to end, those that work or start take longer than that.
    monkeypatch.setattr(cluster, "CLOSE_SECONDS", 1)
    working: list[BaseProcess] = []

    def interrupt(done: int, planned: int) -> None:
        if done == 1:
            working.extend(dask_workers())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="1 of 3 results are kept"):
        run_tasks(work.slow, {"a": (0, 0.0), "b": (1, 600.0), "c": (2, 600.0)}, tmp_path, workers=2,
                  progress=interrupt)  # fmt: skip
    assert [process.exitcode for process in working] == [-signal.SIGKILL, -signal.SIGKILL]


def test_an_interruption_leaves_no_half_started_worker(tmp_path):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt() -> None:
        while not dask_workers():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    try:
        Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt, match="0 of 1 results are kept"):
            run_tasks(work.slow, {"a": (0, 600.0)}, tmp_path, workers=2)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not dask_workers()
