"""A check judges what another processor rounds otherwise, and what happens when draws part ways."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib.checking.check import check
from calib.gap.forward import Forward
from calib.inference import sampler as sampler_module
from calib.inference.problem import Problem
from tests.check.conftest import different
from tests.check.kernels import ALL, KERNELS, Setting, skip_what_crashes

from . import made


def once(by: float) -> Callable[[np.ndarray], np.ndarray]:
    """Multiply the first value that it is given by 1 + `by`, and no other."""
    left = [1]

    def perturbed(values: np.ndarray) -> np.ndarray:
        if left:
            left.pop()
            values = np.array(values)
            values.flat[0] *= 1.0 + by
        return values

    return perturbed


def perturb(monkeypatch: pytest.MonkeyPatch, by: float) -> None:
    """Round the first density and the first prediction of a diagnosis otherwise."""
    density, predicted = Problem.log_prob, Forward._predict
    first_density, first_prediction = once(by), once(by)
    monkeypatch.setattr(Problem, "log_prob", lambda self, t: first_density(density(self, t)))
    monkeypatch.setattr(
        Forward, "_predict", lambda self, *args: first_prediction(predicted(self, *args))
    )


@pytest.mark.parametrize("by", [1e-15, pytest.param(1e-12, marks=pytest.mark.slow)])
def test_one_evaluation_rounded_otherwise_is_no_difference(
    whole: Path, monkeypatch: pytest.MonkeyPatch, by: float, audited_once: None
) -> None:
    perturb(monkeypatch, by)
    outcome = check(whole)
    assert different(outcome) == {}
    assert outcome.verdict.startswith("SAME")


def test_chains_that_part_ways_are_judged_by_their_monte_carlo_error(
    report: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each density that walkers are moved by is off in its fifth digit, by chance."""
    rng, moved = np.random.default_rng(1), sampler_module.run_walkers

    def perturbed(log_prob, *args):
        def noisy(t: np.ndarray) -> np.ndarray:
            values = log_prob(t)
            return values * (1.0 + 1e-5 * rng.standard_normal(values.shape))

        return moved(noisy, *args)

    monkeypatch.setattr(sampler_module, "run_walkers", perturbed)
    outcome = check(report)
    assert different(outcome) == {}
    assert outcome.draws_differ
    assert outcome.verdict.startswith("SAME within Monte Carlo error")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["whole", "run"])
@pytest.mark.parametrize("setting", ALL, ids=str)
def test_whatever_another_processor_makes_is_the_same(
    tmp_path: Path, setting: Setting, kind: str
) -> None:
    outcome = check(made.elsewhere(tmp_path, setting, kind) / kind)
    assert different(outcome) == {}


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_tampering_is_found_whatever_processor_made_it(kernel: str) -> None:
    """All tests of tampering, on originals of another processor (Prescott's are the fast ones)."""
    skip_what_crashes(Setting(kernel, False, 1))
    environment = os.environ | {"CALIB_MADE_UNDER": str(Setting(kernel, False, 1))}
    files = [f"tests/check/test_check_{name}.py" for name in ("report", "whole", "run")]
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files],
        env=environment, cwd=made.ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout[-3000:]
