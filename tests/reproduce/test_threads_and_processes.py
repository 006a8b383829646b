"""The numbers do not depend on how many threads or processes the work is spread over."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from calib.sampling.sampler import SamplerSettings
from calib.study import he2019_tasks, run_study
from calib.summary import summarise

SHORT = SamplerSettings(steps=60, max_steps=60)
OUTPUTS = ("rut_depth", "drawbar_pull")
ROOT = Path(__file__).resolve().parents[2]


def numbers(*outputs: str) -> dict:
    """The summary of some outputs, worked out one after the other in this process."""
    tasks = [task for task in he2019_tasks() if task.output in outputs]
    return summarise(run_study(tasks, 2019, settings=SHORT))["models"]


PROGRAM = """
import json
from tests.reproduce.test_threads_and_processes import OUTPUTS, numbers
print(json.dumps(numbers(*OUTPUTS)))
"""


def in_a_process(threads: int) -> str:
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": str(threads)}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment, capture_output=True, text=True, check=True,
        cwd=ROOT,
    )  # fmt: skip
    return ran.stdout


@pytest.fixture(scope="module")
def one_thread() -> str:
    return in_a_process(1)


def test_two_threads_of_linear_algebra_give_the_same_numbers(one_thread: str) -> None:
    assert in_a_process(2) == one_thread


def test_two_processes_give_the_same_numbers(one_thread: str) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = dict(zip(OUTPUTS, pool.map(numbers, OUTPUTS), strict=True))
    together = json.loads(one_thread)
    for output in OUTPUTS:
        assert json.loads(json.dumps(found[output][output])) == together[output]
