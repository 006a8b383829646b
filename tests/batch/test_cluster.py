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

import psutil
import pytest
from distributed import Client

from calib.batch import cluster
from calib.batch.tasks import run_tasks
from calib.errors import CalibError
from tests.batch import work

ROOT = Path(__file__).parents[2]
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
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
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


def test_workers_here_and_a_cluster_write_what_one_process_writes(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "WINDOW", 7)
    items: dict[str, object] = {f"t{i}": i for i in range(20)} | {"a": lambda: 0}
    said: list[str] = []
    failed = []
    for i, options in enumerate(({}, {"workers": 2}, {"scheduler": scheduler})):
        outcome = run_tasks(
            work.draw_even, items, tmp_path / str(i), announce=said.append, **options
        )
        failed.append(outcome.failed)
        assert len(outcome.done) == 10
    # One that cannot be sent fails alone, and the errors of the others are those of one process.
    assert "a" in failed[1]
    for errors in failed:
        errors.pop("a")  # type: ignore[attr-defined]
    assert failed[0] == failed[1] == failed[2]
    (one, two, three) = (
        {k: v for k, v in content(tmp_path / str(i)).items() if k != "failed.json"}
        for i in range(3)
    )
    assert one == two == three
    assert len(one) == 10
    assert "2 workers here" in said[0]
    assert scheduler in said[1]


def test_workers_are_processes_of_their_own_with_one_thread_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the settings of memory that Dask would have do not double their time."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    run_tasks(work.where, {f"t{i}": i for i in range(8)}, tmp_path, workers=2)
    found = [json.loads(p.read_text()) for p in tmp_path.glob("t*.json")]
    assert len({f["pid"] for f in found} - {os.getpid()}) == 2
    assert {(f["threads"], f["trim"]) for f in found} == {("1", None)}


def test_many_items_are_sent_without_a_warning(tmp_path: Path, scheduler: str) -> None:
    items = {f"t{i}": (bytes(12_000_000), i) for i in range(3)}
    assert len(run_tasks(work.second, items, tmp_path, scheduler=scheduler).done) == 3


def test_a_worker_that_dies_loses_nothing_and_a_task_that_kills_them_fails_alone(
    tmp_path: Path,
) -> None:
    memory = str(tmp_path / "memory")
    deaths = {2: "always", 3: "once"}
    items = {f"t{i}": (deaths.get(i, ""), memory, i) for i in range(10)}
    outcome = run_tasks(work.die, items, tmp_path / "out", workers=2)
    assert (tmp_path / "memory").exists()
    assert list(outcome.failed) == ["t2"]
    assert "the process that ran this task died" in outcome.failed["t2"]
    assert len(outcome.done) == 9


_CLIENT = """
import sys
from pathlib import Path
from calib.batch.tasks import run_tasks
from tests.batch import work

if __name__ == "__main__":
    items = {f"t{i}": (i, 0.1) for i in range(30)}
    run_tasks(work.slow, items, Path(sys.argv[1]), workers=2)
"""


def test_a_client_that_is_killed_is_resumed(tmp_path: Path) -> None:
    (tmp_path / "client.py").write_text(_CLIENT)
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "client.py"), str(out)],
        env=ENVIRONMENT, start_new_session=True,
    )  # fmt: skip
    while len(list(out.glob("t*.json"))) < 5:
        assert process.poll() is None
        time.sleep(0.01)
    its = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGKILL)
    process.wait()
    there = {p.name: p.stat().st_mtime_ns for p in out.glob("t*.json")}
    assert 5 <= len(there) < 30
    # Its workers end with it.
    assert psutil.wait_procs(its, timeout=30.0)[1] == []
    items = {f"t{i}": (i, 0.0) for i in range(30)}
    outcome = run_tasks(work.slow, items, out)
    assert len(outcome.resumed) == len(there)
    assert {n: (out / n).stat().st_mtime_ns for n in there} == there
    run_tasks(work.slow, items, tmp_path / "serial")
    assert content(out) == content(tmp_path / "serial")


def test_a_script_without_a_guard_is_refused_with_a_hint(tmp_path: Path) -> None:
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
def test_a_scheduler_that_is_lost_is_reported(tmp_path: Path) -> None:
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


def test_a_scheduler_that_is_not_there_is_refused_if_anything_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with pytest.raises(CalibError, match="no Dask scheduler"):
            run_tasks(work.draw, {"a": 1}, tmp_path, scheduler=address)
    run_tasks(work.draw, {"a": 1}, tmp_path)
    assert run_tasks(work.draw, {"a": 1}, tmp_path, scheduler="tcp://127.0.0.1:1").done == ("a",)


def test_workers_of_other_versions_are_refused(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = cluster.versions()
    monkeypatch.setattr(cluster, "versions", work.versions)
    with Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(1)
    with pytest.raises(CalibError, match=r"would not give the same numbers.*numpy"):
        run_tasks(work.draw, {"a": 1}, tmp_path, scheduler=scheduler)
    assert {"numpy", "scipy", "emcee", "calib source"} == set(ours)


def test_an_interruption_does_not_wait_for_workers_at_their_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_an_interruption_leaves_no_half_started_worker(tmp_path: Path) -> None:
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
