"""The example of a bevameter: one joint posterior, and a public calibration in three stages.

Both are computed again by quadrature: of the plates, Kc and Kphi are linear given n, so that only n
and sigma are on a grid; of the ring, c, phi and K are, and each sigma is integrated out.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from calib.batch.user_code import run_file
from calib.data import read_table
from calib.data.quantities import QUANTITIES
from calib.inference.joint import JointProblem, build_joint, calibrate_joint
from calib.models import MODELS
from calib.models.base import Array
from tests.registered import forgotten

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "crm2scm"
PAGE = FOLDER / "README.md"
NAMES = ("Kc", "Kphi", "n", "c", "phi", "K")
DATA = {"scm_plate": "plate", "ring_steady": "steady", "ring_mean": "mean"}
type Moments = dict[str, tuple[float, float]]


@pytest.fixture(scope="module")
def staged() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        import staged as module  # type: ignore[import-not-found]

        yield module
    sys.modules.pop("staged")


@pytest.fixture(scope="module")
def joint() -> Iterator[JointProblem]:
    with forgotten(QUANTITIES, MODELS):
        run_file(FOLDER / "crm2scm.py")
        yield build_joint({m: read_table(FOLDER / f"{file}.csv") for m, file in DATA.items()})


def moments(weight: Array, **values: Array) -> Moments:
    weight = weight / weight.sum()
    found = {}
    for name, value in values.items():
        mean = float((weight * value).sum())
        found[name] = mean, float(np.sqrt((weight * (value - mean) ** 2).sum()))
    return found


def plates(staged: ModuleType, fixed: float | None) -> Moments:
    """Integrate over Kc and Kphi in closed form; sigma (kN) is fixed, or has its prior."""
    b, z = (staged.column("plate.csv", f"plate_{q}_mm") / 1000.0 for q in ("radius", "sinkage"))
    force = staged.column("plate.csv", "plate_force_n") / 1000.0
    n = np.linspace(0.9, 1.6, 701)
    x = np.stack([np.pi * b * z ** n[:, None], np.pi * b**2 * z ** n[:, None]], axis=-1)
    xx = np.einsum("gij,gik->gjk", x, x)
    best = np.linalg.solve(xx, np.einsum("gij,i->gj", x, force)[..., None])[..., 0]
    square = np.square(force - np.einsum("gij,gj->gi", x, best)).sum(axis=1)[:, None]
    ln = np.array([0.0]) if fixed else np.linspace(np.log(0.2), np.log(20.0), 400)
    sigma = np.array([fixed]) if fixed else np.exp(ln)
    value = -0.5 * np.linalg.slogdet(xx)[1][:, None] - 0.5 * square / sigma**2
    if not fixed:
        value = value - (force.size - 2) * ln - 0.5 * np.square((ln - np.log(0.1)) / 1.5)
    weight = np.exp(value - value.max())
    found = moments(weight, n=n[:, None], sigma=sigma + 0.0 * weight)
    for j, name in enumerate(("Kc", "Kphi")):
        mean, sd = moments(weight, of=best[:, j, None])["of"]
        own = np.linalg.inv(xx)[:, j, j, None] * sigma**2
        found[name] = mean, float(np.hypot(sd, np.sqrt((weight * own).sum() / weight.sum())))
    return found


def over_sigma(square: Array, rows: int) -> Array:
    """Integrate the likelihood over sigma, whose prior is log-normal about 1 N m: its logarithm."""
    ln = np.linspace(-9.0, 9.0, 601)
    at = np.linspace(np.log(square.min()), np.log(square.max()), 500)
    value = -0.5 * (ln / 1.5) ** 2 - rows * ln - 0.5 * np.exp(at[:, None] - 2.0 * ln)
    top = value.max(axis=1)
    return np.interp(np.log(square), at, top + np.log(np.exp(value - top[:, None]).sum(axis=1)))


def rings(staged: ModuleType, stage: int | None) -> Moments:
    """Integrate over c, phi and K: jointly, or as stage 2, 3, or both at once by theirs, 23."""
    mass, steady, mean = (
        staged.column(f"{file}.csv", name)
        for file, name in (
            ("steady", "ring_mass_kg"), ("steady", "steady_torque_nm"), ("mean", "mean_torque_nm"),
        )
    )  # fmt: skip
    c, phi = np.linspace(0.05, 9.95, 100)[:, None, None], np.linspace(10.0, 40.0, 121)[:, None]
    k = np.exp(np.linspace(np.log(0.2), np.log(30.0), 1000 if stage == 3 else 150))
    sheared = 1000.0 * staged.ARM_M * np.radians([1.0, 2.0, 3.0])
    risen = -np.expm1(-sheared / k[:, None]).mean(axis=1)
    if stage == 3:
        held = 1000.0 * staged.COHESION_KPA * staged.AREA_M2
        held = held + staged.GRAVITY * mass * np.tan(np.radians(staged.FRICTION_DEG))
        left = staged.ARM_M * held * risen[:, None] - mean
        return moments(k * np.exp(-0.5 * np.square(left).mean(axis=1)), K=k)
    pulled = staged.GRAVITY * mass * np.tan(np.radians(phi))
    torque = staged.ARM_M * (1000.0 * c * staged.AREA_M2 + pulled)
    square = np.square(torque - steady).sum(axis=-1)
    if stage == 2:
        ones = np.ones_like(square)
        weight = np.exp(-0.5 * (square - square.min()) / mass.size)
        return moments(weight, c=c[..., 0] * ones, phi=phi[:, 0] * ones)
    own = np.square(torque).sum(axis=-1)[..., None] * risen**2
    own = own - 2.0 * (torque * mean).sum(axis=-1)[..., None] * risen + np.square(mean).sum()
    if stage == 23:
        value = -0.5 * (square[..., None] + own) / mass.size + np.log(k)
    else:
        value = over_sigma(square, mass.size)[..., None] + over_sigma(own, mass.size) + np.log(k)
    weight, ones = np.exp(value - value.max()), np.ones_like(value)
    return moments(weight, c=c * ones, phi=phi * ones, K=k * ones)


# Twenty seconds: pytest -m slow tests/extension/test_crm2scm.py
@pytest.mark.slow
def test_the_joint_posterior_is_that_of_quadrature(staged: ModuleType, joint: JointProblem) -> None:
    assert joint.shared == dict.fromkeys(("c", "phi"), ("steady_torque", "mean_torque"))
    found = calibrate_joint(joint, seed=2019)
    assert found.converged
    exact = plates(staged, None) | rings(staged, None)
    for name, (mean, sd) in exact.items():
        drawn = found.summary["sigma_plate_force" if name == "sigma" else name]
        effective = drawn.ess_bulk
        assert abs(drawn.mean - mean) < 5.0 * sd / np.sqrt(effective), name
        assert drawn.sd == pytest.approx(sd, rel=0.04), name


def test_a_stage_by_metropolis_is_that_of_quadrature(staged: ModuleType) -> None:
    stage = staged.stages()[2]
    draws = staged.metropolis(stage, 10_000, np.random.default_rng(4))
    mean, sd = rings(staged, 3)["K"]
    # Of some 5000 independent draws.
    assert draws.mean() == pytest.approx(mean, abs=0.07 * sd)
    assert draws.std() == pytest.approx(sd, rel=0.05)


def test_the_page_says_what_quadrature_finds(staged: ModuleType) -> None:
    rows = re.findall(r"^\| (\w+) \([^|]*\) \|(.*)\|$", PAGE.read_text(encoding="utf-8"), re.M)
    cells = {name: re.findall(r"(-?[\d.]+) ± ([\d.]+)", rest) for name, rest in rows}
    assert tuple(cells) == NAMES
    exact = (
        plates(staged, None) | rings(staged, None),
        plates(staged, 0.1 * 4.0) | rings(staged, 2) | rings(staged, 3),
        rings(staged, 23),
    )
    for name in NAMES:
        columns = [column[name] for column in exact if name in column]
        for printed, of in zip(cells[name], columns, strict=True):
            for text, value in zip(printed, of, strict=True):
                # Sampled, so within a few hundredths of an sd, and then rounded.
                unit = 10.0 ** -len(text.partition(".")[2])
                assert float(text) == pytest.approx(value, abs=0.05 * of[1] + 0.5 * unit)


def test_the_mean_torques_are_those_of_the_three_angles(staged: ModuleType) -> None:
    each = staged.column("ring.csv", "ring_torque_nm").reshape(8, 3)
    assert staged.column("mean.csv", "mean_torque_nm") == pytest.approx(each.mean(axis=1), rel=1e-8)
