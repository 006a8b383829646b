"""Whether leave-one-out finds the noise that rows were made with, on straight lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.inference.calibration import Calibration, calibrate
from calib.inference.likelihood import Noise, NoiseChoice
from calib.inference.priors import Priors
from calib.inference.problem import Problem
from calib.validation.comparison import NoisePreference, noise_preference, with_usual_noise
from calib.validation.validate import leave_one_out
from tests.custom_problems import normal, problem_of

SLIP = np.linspace(0.0, 0.6, 60)
CHOICE = NoiseChoice("student_t", "slip")
NOISE = Noise(CHOICE, "slip_ratio", float(SLIP.mean()), float(SLIP.std()))


def line(noise: np.ndarray) -> Problem:
    priors = [
        normal("a", 0.0, 3.0), normal("b", 0.0, 3.0), normal("nu", 2.0, 1.0, log=True),
        normal("sigma_slope", 0.0, 0.5), normal("sigma", -2.0, 1.0, log=True),
    ]  # fmt: skip
    usual = problem_of(
        lambda a, b, s: a + b * s, [*priors[:2], priors[-1]], SLIP, 1.0 + SLIP + noise
    )
    return replace(usual, noise=NOISE, priors=Priors(tuple(priors), noise=CHOICE))


def calibrated(noise: np.ndarray) -> Calibration:
    return calibrate(line(noise), 3)


def test_the_noise_that_made_the_rows_is_preferred() -> None:
    rng = np.random.default_rng(3)
    z = (SLIP - SLIP.mean()) / SLIP.std()
    found = noise_preference(calibrated(0.1 * np.exp(z) * rng.standard_t(2.0, 60)))
    assert found is not None
    assert found.preferred == "chosen"
    assert found.sentence.startswith("The data prefer Student-t noise that depends on slip to nor")
    assert f"{found.elpd:+.1f}" in found.sentence


def test_normal_rows_need_no_other_noise() -> None:
    calibration = calibrated(0.1 * np.random.default_rng(4).standard_normal(60))
    found = noise_preference(calibration)
    assert found is not None
    assert found.preferred == "neither"
    assert abs(found.elpd) < 4.0
    # The difference is that of the two sums of leave-one-out.
    problem = with_usual_noise(calibration.problem)
    assert problem.names == ("a", "b", "sigma")
    usual = calibrate(problem, 3, label=" normal noise")
    expected = leave_one_out(calibration).elpd - leave_one_out(usual).elpd
    assert found.elpd == pytest.approx(expected, abs=0.1)
    # What has normal noise already is not compared.
    assert noise_preference(usual) is None


def test_one_row_that_decides_is_named() -> None:
    noise = 0.1 * np.random.default_rng(5).standard_normal(60)
    noise[20] = 20.0
    found = noise_preference(calibrated(noise))
    assert found is not None
    assert found.line == line(noise).table.lines[20]
    assert f"More than half of that is line {found.line}" in found.sentence


@pytest.mark.parametrize(
    ("elpd", "se", "sound", "preferred"),
    [
        (10.0, 4.0, True, "chosen"), (10.0, 6.0, True, "neither"), (3.0, 0.1, True, "neither"),
        (-10.0, 4.0, True, "normal"), (10.0, 4.0, False, "unknown"),
    ],
)  # fmt: skip
def test_small_or_uncertain_differences_prefer_nothing(
    elpd: float, se: float, sound: bool, preferred: str
) -> None:
    found = NoisePreference(NOISE, elpd, se, sound)
    assert found.preferred == preferred
    assert found.sentence.endswith(".")
