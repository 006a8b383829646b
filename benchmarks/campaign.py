"""What running tasks on Dask costs, and what a second worker gains.

    python benchmarks/campaign.py --out campaign.json

Overhead: tiny tasks through `calib.batch.tasks.run_tasks`, which writes a file for each, and
through Dask's own `Client.map` and `as_completed`, which writes none, on one cluster of two
workers.
Gain: diagnoses of challenge cases in this process and on two workers, start-up included; and in two
plain processes without Dask, each with half of the cases: what this machine's two cores can do.
Each is repeated, the two sides of a comparison in turn, and medians are taken: other work on the
machine disturbs both.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from shared.machine import describe

# The matrices are small: threads of the linear algebra would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

SEED = 77
# Minutes each.
GAIN_REPEATS = 3


def tiny(item: int) -> dict[str, int]:
    """Do nothing."""
    return {"item": item}


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Return seconds on the wall clock, and of this process's processors."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def overhead(tasks: int, repeats: int) -> dict[str, object]:
    """Milliseconds for each of many tiny tasks, ours and Dask's own."""
    from distributed import Client, LocalCluster, as_completed

    from calib.batch.tasks import run_tasks

    items = {f"task-{i}": i for i in range(tasks)}
    found: dict[str, list[tuple[float, float]]] = {"dask": [], "calib": []}
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster) as client,
    ):

        def dask_own() -> None:
            futures = client.map(tiny, list(items.values()), pure=False)
            for _ in as_completed(futures, with_results=True).batches():
                pass

        def ours() -> None:
            with tempfile.TemporaryDirectory() as folder:
                outcome = run_tasks(tiny, items, Path(folder), scheduler=cluster.scheduler_address)
            assert len(outcome.done) == tasks

        for _ in range(repeats + 1):
            found["dask"].append(timed(dask_own))
            found["calib"].append(timed(ours))
    # The first round imports and connects.
    per_task = {
        name: [(1e3 * w / tasks, 1e3 * c / tasks) for w, c in runs[1:]]
        for name, runs in found.items()
    }
    beyond = [
        (a[0] - b[0], a[1] - b[1]) for a, b in zip(per_task["calib"], per_task["dask"], strict=True)
    ]
    return {
        "tasks": tasks,
        "ms_per_task_wall_and_cpu": per_task,
        "beyond_dask_ms_median_wall": statistics.median(b[0] for b in beyond),
        "beyond_dask_ms_median_cpu": statistics.median(b[1] for b in beyond),
    }


def gain(cases: Path, count: int, repeats: int) -> dict[str, object]:
    """Seconds for some diagnoses with one worker, with two, and in two plain processes."""
    from calib.gap.batch import case_folders

    folders = case_folders(cases)[:count]
    ways: dict[str, Callable[[Path], None]] = {
        "one": partial(diagnosed, folders, workers=1),
        "two": partial(diagnosed, folders, workers=2),
        "alone": partial(in_two_processes, folders),
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            with tempfile.TemporaryDirectory() as out:
                began = time.perf_counter()
                way(Path(out))
                seconds[name].append(time.perf_counter() - began)
    over_one = {
        name: [one / two for one, two in zip(seconds["one"], seconds[name], strict=True)]
        for name in ("two", "alone")
    }
    return {"diagnoses": len(folders), "seconds": seconds, "over_one": over_one}


def diagnosed(folders: list[Path], out: Path, *, workers: int) -> None:
    """Diagnose cases, here or on workers."""
    from calib.gap.batch import diagnose_cases

    failed = diagnose_cases(folders, out, 1, workers=workers)
    if failed:
        raise SystemExit(f"failed: {failed}")


def in_two_processes(folders: list[Path], out: Path) -> None:
    """Diagnose every other case in one process and the others in another, without Dask."""
    # Dask's own cluster, of the overhead above, leaves a setting of the C library's memory behind
    # that would slow them.
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)
    context = multiprocessing.get_context("spawn")
    halves = [
        context.Process(target=diagnosed, args=(folders[i::2], out / str(i)), kwargs={"workers": 1})
        for i in range(2)
    ]
    for half in halves:
        half.start()
    for half in halves:
        half.join()
    if any(half.exitcode for half in halves):
        raise SystemExit("a plain process failed")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, help="JSON file to write; printed if none")
    parser.add_argument("--tasks", type=int, default=10_000, help="tiny tasks")
    parser.add_argument("--cases", type=int, default=200, help="diagnoses")
    parser.add_argument("--repeats", type=int, default=3, help="of the overhead")
    options = parser.parse_args()
    from challenge.make import make

    result: dict[str, object] = {
        "machine": describe(),
        "load_before": os.getloadavg(),
        "overhead": overhead(options.tasks, options.repeats),
    }
    if options.cases:
        with tempfile.TemporaryDirectory() as scratch:
            cases = Path(scratch) / "cases"
            make(cases, Path(scratch) / "key", seed=SEED, n_cases=options.cases, workers=2)
            result["gain"] = gain(cases, options.cases, GAIN_REPEATS)
    result["load_after"] = os.getloadavg()
    text = json.dumps(result, indent=1) + "\n"
    if options.out is None:
        print(text)
    else:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
