"""The rivals of benchmarks/rivals on problems whose answers are known."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.case import Case
from calib.gap.forward import Forward
from calib.gap.hypotheses import singles
from calib.models import MODELS
from calib.models.base import Model

pytestmark = pytest.mark.slow
BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
if not (BENCHMARKS / "rivals").is_dir():
    pytest.skip("benchmarks/ is not here: this is no checkout", allow_module_level=True)
sys.path.insert(0, str(BENCHMARKS))

from rivals import akaike, processes, sindy  # noqa: E402
from rivals.common import Prepared, prepare  # noqa: E402

NOISE = 0.05
LINE = Model(
    name="line", title="A line", output="drawbar_pull_kn", conditions=("slip_ratio",),
    parameters=("level", "slope"),
    predict=lambda theta, c: theta[:, :1] + theta[:, 1:2] * c["slip_ratio"],
    latex=("$P = a + bs$",), letters="[$P] the pull (kN), [$s] the slip", source="a test",
    example="slip_ratio,drawbar_pull_kn\n0.0,1.0\n0.2,1.2\n0.4,1.4\n0.6,1.6\n",
    priors='model = "line"\n' + "".join(
        f'[parameters.{name}]\ndist = "normal"\nmean = 1.0\nsd = 5.0\nunit = "kN"\n'
        'reason = "wide"\nsource = "a test"\n' for name in ("level", "slope")
    ) + '[parameters.sigma]\ndist = "lognormal"\nmedian = 0.05\nsd_log = 1.0\nunit = "kN"\n'
    'reason = "wide"\nsource = "a test"\n',
)  # fmt: skip


@pytest.fixture(autouse=True)
def line() -> Iterator[None]:
    with MODELS.standing_in(LINE):
        yield


def bump(slip: np.ndarray) -> np.ndarray:
    """A smooth discrepancy that no line has the shape of."""
    return 0.6 * np.sin(2.0 * np.pi * slip / 0.6)


def line_with(gap, seed: int = 7, rows: int = 25) -> tuple[Prepared, np.ndarray]:
    """A line in the laboratory, with a gap in the field; the truth at what is to be predicted."""
    rng = np.random.default_rng(seed)
    lab, field, new = (rng.uniform(0.0, 0.6, n) for n in (40, rows, 30))
    tables = []
    for slip, change in ((lab, 0.0), (field, gap(field))):
        pull = 1.0 + 2.0 * slip + change + NOISE * rng.standard_normal(slip.size)
        columns = {"slip_ratio": slip, "normal_load_kn": np.full(slip.size, 5.0)}
        tables.append(table_from_arrays(columns | {"drawbar_pull_kn": pull}))
    to_predict = table_from_arrays({"slip_ratio": new, "normal_load_kn": np.full(30, 5.0)})
    case = Case("line", *tables, {"drawbar_pull": "line"}, to_predict)
    return prepare(case), 1.0 + 2.0 * new + gap(new)


@pytest.mark.parametrize("kind", ["koh", "sgasp", "ogp"])
def test_processes_see_a_smooth_discrepancy_and_correct_it(kind: str) -> None:
    p, truth = line_with(bump)
    found = processes.diagnose(p, kind)
    assert found.probability["unknown"] > 0.99
    c = found.curves["drawbar_pull"]
    before = p.labs[0].predict(p.labs[0].mode[None], p.target)[0] - truth
    after = c.after - truth
    assert np.sqrt(np.mean(after**2)) < 0.15 * np.sqrt(np.mean(before**2))
    assert np.mean(np.abs(after) < 3.0 * c.after_sd) > 0.8
    assert c.noise == pytest.approx(NOISE, rel=0.3)
    assert processes.diagnose(line_with(np.zeros_like)[0], kind).probability["none"] > 0.5


def test_koh_is_the_posterior_of_a_gaussian_process() -> None:
    """The same kernel and noise, by another's code; the line is known to a tenth of the noise."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    p, _ = line_with(bump)
    (lab,) = p.labs
    fit = processes.Fit(p, lab, "koh")
    reach, size, noise = np.exp(fit.hyper)
    delta = ConstantKernel(size**2) * RBF(reach)
    regressor = GaussianProcessRegressor(delta + WhiteKernel(noise**2), optimizer=None)
    regressor.fit(fit.x, fit.off(lab.mode))
    mean, sd = fit.at(p.scaled(p.target), p.target)
    expected, with_noise = regressor.predict(p.scaled(p.target), return_std=True)
    calibrated = lab.predict(lab.mode[None], p.target)[0]
    np.testing.assert_allclose(mean - calibrated, expected, atol=0.2 * noise)
    np.testing.assert_allclose(sd**2 + noise**2, with_noise**2, rtol=0.1)


def test_a_scaled_process_is_smaller_and_an_orthogonal_one_has_no_line_in_it() -> None:
    p, _ = line_with(bump)
    (lab,) = p.labs
    scaled, orthogonal = (processes.Fit(p, lab, kind) for kind in ("sgasp", "ogp"))
    k = scaled.kernel(scaled.hyper, scaled.x, scaled.x)
    ranges, size, noise = np.exp(scaled.hyper)
    r = processes.correlation("sgasp", scaled.x, scaled.x, np.array([ranges]))
    lambda_z = np.sqrt(25 / ranges * size**2 / noise**2)
    # Gu and Wang's form at the points themselves: (R^-1 + lambda/n I)^-1.
    other = size**2 * r @ np.linalg.inv(np.eye(25) + lambda_z / 25 * r)
    np.testing.assert_allclose(k, other, atol=1e-8 * size**2)
    assert np.trace(k) < 0.9 * 25 * size**2
    k = orthogonal.kernel(orthogonal.hyper, orthogonal.x, orthogonal.x)
    assert np.abs(orthogonal.g.T @ k).max() < 1e-6 * np.abs(k).max()
    # So its line is that of least squares, however large the discrepancy.
    slip = orthogonal.conditions["slip_ratio"]
    np.testing.assert_allclose(orthogonal.theta, np.polyfit(slip, orthogonal.y, 1)[::-1], atol=0.05)


def test_aic_fits_by_least_squares_and_finds_an_offset() -> None:
    p, _ = line_with(lambda slip: np.full(slip.size, 0.4))
    found = akaike.diagnose(p).probability
    assert found["none"] < 1e-3
    assert sum(q for name, q in found.items() if "force_offset" in name) > 0.3
    (h,) = singles(p.data, {"force_offset": akaike.EFFECTS["force_offset"]})
    forward = Forward(p.data, h, {"drawbar_pull": NOISE})
    end = akaike.fit(p, forward, [akaike._start(p, forward)])
    assert end is not None
    slip = np.concatenate([p.case.lab["slip_ratio"], p.case.field["slip_ratio"]])
    in_field = np.arange(slip.size) >= 40
    a = np.stack([np.ones(slip.size), slip, in_field], axis=1)
    best, squares, *_ = np.linalg.lstsq(a, p.data.observed)
    np.testing.assert_allclose(end.psi[end.free], best, atol=1e-4)
    assert end.sds["drawbar_pull"] == pytest.approx(np.sqrt(squares[0] / slip.size), rel=1e-4)
    n, k = slip.size, 4
    aicc = n * np.log(squares[0] / n) + 2 * k + 2 * k * (k + 1) / (n - k - 1)
    assert end.aicc == pytest.approx(aicc, abs=1e-4)


def test_sindy_recovers_a_term() -> None:
    pytest.importorskip("pysindy")
    rng = np.random.default_rng(3)
    library = rng.uniform(-1.0, 1.0, (60, 6))
    y = 12.0 * library[:, 4] + rng.standard_normal(60)
    found = sindy.Regression(library, y)
    assert 4 in found.chosen
    coefficient = found.coefficients[4] / found.size[4]
    assert coefficient == pytest.approx(12.0, abs=5.0 / np.sqrt(np.square(library[:, 4]).sum()))
    assert found.sd == pytest.approx(1.0, rel=0.3)
    p, _ = line_with(lambda slip: 3.0 * slip**2)
    terms = sindy.by_polynomials(p).said["terms"]["drawbar_pull"]
    assert "slip_ratio^2" in terms
    offset, _ = line_with(lambda slip: np.full(slip.size, 0.4))
    assert sindy.by_effects(offset).probability.get("none", 0.0) < 1e-3
