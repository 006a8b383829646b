"""The script behind priors/shifts/another_soil.toml recovers what it is meant to estimate."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from calib.gap.discrepancy import ZERO_OF_SLIP, another_soil, quantities
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.gap.noise import Noise
from tests.gap.cases import MODELS, NOISE, campaigns_of
from tests.gap.fits import draws_of

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "shift_prior.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("benchmarks/ is not here: this is no checkout")
    spec = importlib.util.spec_from_file_location("shift_prior", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["shift_prior"] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


def test_it_sees_a_shift_in_prior_sds(script: ModuleType) -> None:
    data = campaigns_of(None)
    sigma = {o: NOISE[o] for o in MODELS}
    forward = Forward(data, Hypothesis("parameter_shift", shift=0.25), sigma)
    psi = np.array([p.loc for p in forward.priors.free])
    psi[forward.shift_slice] = np.linspace(-0.2, 0.2, 14)
    # As a likelihood of precision 400 would leave it beside the prior.
    prior = np.array([p.scale for p in forward.priors.free]) ** -2.0
    covariance = np.diag(1.0 / (np.where(np.isfinite(prior), prior, 0.0) + 400.0))
    noise = {o: Noise(s) for o, s in sigma.items()}
    found = script.seen(
        Fit(forward, noise, 0.0, {}, draws_of(psi, np.sqrt(covariance))), data.outputs
    )
    np.testing.assert_allclose(np.diag(found.precision), 400.0, rtol=1e-9)
    names = [
        q
        for o in data.outputs
        for q in [
            *quantities(o.priors.names),
            *([ZERO_OF_SLIP] if o.name == "drawbar_pull" else []),
        ]
    ]
    order = [names.index(q) for q in script.QUANTITIES]
    expected = (400.0 + prior[forward.shift_slice]) * psi[forward.shift_slice]
    np.testing.assert_allclose(found.pull, expected[order], rtol=1e-9)


def test_it_recovers_a_covariance_it_did_not_know(script: ModuleType) -> None:
    rng = np.random.default_rng(5)
    d = len(script.QUANTITIES)
    ways = np.zeros((d, 1))
    ways[:2, 0] = 0.9, -0.8
    true = ways @ ways.T + np.diag(script.alone().diagonal())
    main = [script.QUANTITIES.index(q) for q in ("K", "D", "z_ref")]
    true /= np.exp(np.mean(np.log(true.diagonal()[main])))
    root = np.linalg.cholesky(true)
    cases = []
    for _ in range(600):
        shift = rng.choice(script.SIZES) * root @ rng.standard_normal(d)
        measured = shift + 0.05 * rng.standard_normal(d)
        cases.append(script.Seen(400.0 * np.eye(d), 400.0 * measured))
    found = script.estimate(cases, rounds=60)
    big = [i for i, q in enumerate(script.QUANTITIES) if script.alone()[i, i] == 1.0]
    np.testing.assert_allclose(
        np.sqrt(found.diagonal()[big]), np.sqrt(true.diagonal()[big]), rtol=0.12
    )
    between = found[0, 1] / np.sqrt(found[0, 0] * found[1, 1])
    assert between == pytest.approx(true[0, 1] / np.sqrt(true[0, 0] * true[1, 1]), abs=0.06)
    assert script.gained(cases, found).mean() > 0.05


def test_the_shipped_table_has_every_quantity_and_its_scale(script: ModuleType) -> None:
    table = another_soil()
    assert tuple(table) == script.QUANTITIES
    variance = {q: float(ways @ ways + own**2) for q, (ways, own) in table.items()}
    scale = np.prod([variance[q] for q in ("K", "D", "z_ref")]) ** (1 / 3)
    assert scale == pytest.approx(1.0, abs=0.1)
