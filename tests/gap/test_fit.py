"""The fit: its mode against a general optimiser, its evidence against importance sampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from calib.data import table_from_arrays
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import Case
from calib.gap.constants import KAPPA, RHO
from calib.gap.effects import EFFECTS
from calib.gap.fit import Fit, fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, effect_priors
from calib.gap.importance import refine
from calib.gap.noise import Noise, ln_prior
from tests.gap.cases import PULL_ONLY, make_case
from tests.gap.fits import averaged_log_joint

SIZE = 0.12


@pytest.fixture(scope="module")
def data() -> Campaigns:
    return campaigns(make_case("force_offset", size={"offset": SIZE}, models=PULL_ONLY))


@pytest.fixture(scope="module")
def fitted(data) -> Fit:
    effect = EFFECTS["force_offset"]
    h = Hypothesis("force_offset", (effect,), (effect_priors(data, effect),))
    forward = Forward(data, h, {"drawbar_pull": 0.03})
    start = np.array([p.loc for p in forward.priors.free])
    return fit(forward, start, {"drawbar_pull": Noise(0.03, 0.0)})


def log_joint(data: Campaigns, found: Fit, psi: np.ndarray) -> np.ndarray:
    """Log of likelihood times prior at the fit's noise, written out, shape (k,)."""
    o, forward = data.outputs[0], found.forward
    noise = found.noise[o.name]
    with np.errstate(all="ignore"):
        lab = o.problem.response - forward.lab(psi)[o.name]
        field = o.field - forward.field(psi, data.view)[o.name][:, o.rows]
    total = forward.priors.log_prob(psi)
    for residual, slip in ((lab, o.problem.table["slip_ratio"]), (field, data.view.slip()[o.rows])):
        sd = noise.sigma * (1.0 + noise.rho * slip)
        total = total - 0.5 * np.square(residual / sd).sum(axis=1)
        total = total - np.log(sd).sum() - 0.5 * slip.size * np.log(2.0 * np.pi)
    return np.where(np.isfinite(total), total, -np.inf)


def test_it_finds_the_mode(data, fitted):
    bounds = [(p.lower, p.upper) for p in fitted.forward.priors.free]
    scale = np.sqrt(np.diag(fitted.covariance))
    rng = np.random.default_rng(3)
    best = np.inf
    for _ in range(3):
        # Start somewhere else, in units of the posterior sds so that the problem is well scaled.
        start = rng.standard_normal(scale.size)
        z = minimize(
            lambda z: -log_joint(data, fitted, (fitted.psi + z * scale)[None])[0],
            start, method="L-BFGS-B",
            bounds=[((lo - m) / s, (hi - m) / s)
                    for (lo, hi), m, s in zip(bounds, fitted.psi, scale, strict=True)],
        )  # fmt: skip
        if z.fun < best:
            best, where = z.fun, z.x
    mine = -log_joint(data, fitted, fitted.psi[None])[0]
    # The noise moves in its last step by up to 1 %, so the mode at that noise is a little off.
    assert mine - best < 0.02
    assert np.abs(where).max() < 0.2


def test_evidence_is_that_of_importance_sampling():
    """Three parameters of the rut and one of the effect: few enough to be sampled exactly."""
    data = campaigns(make_case("slip_zero_shift", models={"rut_depth": "modified_bekker"}))
    effect = EFFECTS["slip_zero_shift"]
    h = Hypothesis("slip_zero_shift", (effect,), (effect_priors(data, effect),))
    forward = Forward(data, h, {"rut_depth": 0.05})
    start = np.array([p.loc for p in forward.priors.free])
    found = fit(forward, start, {"rut_depth": Noise(0.05, 0.0)})
    rng = np.random.default_rng(4)
    proposal = multivariate_t(found.psi, 1.3 * found.covariance, df=5, seed=rng)
    psi = proposal.rvs(20_000)
    log_weight = log_joint(data, found, psi) - proposal.logpdf(psi)
    exact = logsumexp(log_weight) - np.log(log_weight.size)
    averaged = averaged_log_joint(found, psi) - proposal.logpdf(psi)
    exact_averaged = logsumexp(averaged) - np.log(log_weight.size)
    weight = np.exp(log_weight - log_weight.max())
    effective = weight.sum() ** 2 / np.square(weight).sum()
    assert effective > 5000
    # The prior probability of how the noise grows is part of the fit's evidence, and what averaging
    # over it lifts. Beyond the Monte Carlo error, Laplace may be wrong by a tenth of a nat: ten per
    # cent in the odds.
    noise = found.noise["rut_depth"]
    assert noise.rho == 0.0
    growths = [Noise(noise.sigma, rho, kappa) for rho in RHO for kappa in KAPPA]
    lifted = found.log_evidence - exact - ln_prior(noise)
    assert -0.1 < lifted < np.log(len(growths))
    error = 3.0 / np.sqrt(effective)
    assert found.log_evidence == pytest.approx(exact_averaged, abs=error + 0.1)
    # That of its own draws, about as many, has none of Laplace's error.
    assert refine(found, 1).log_evidence == pytest.approx(exact_averaged, abs=2.0 * error)


def test_size_and_noise_are_recovered(fitted):
    i = fitted.forward.phi_slices[0].start
    sd = np.sqrt(fitted.covariance[i, i])
    assert abs(fitted.psi[i] - SIZE) < 3.0 * sd
    assert 0.002 < sd < 0.05
    # 57 rows: the sd of ln sigma is 1/sqrt(2 x 57) = 0.09.
    assert np.log(fitted.noise["drawbar_pull"].sigma / 0.03) == pytest.approx(0.0, abs=0.3)


def test_residuals_are_standardised(data, fitted):
    residual = fitted.field_residuals["drawbar_pull"]
    assert residual.shape == (27,)
    # 27 standard normals: sd of their rms 0.14.
    assert np.sqrt(np.mean(np.square(residual))) == pytest.approx(1.0, abs=0.4)


def noisy_again(case: Case, sds: Sequence[np.ndarray], seed: int) -> Campaigns:
    """The case's two tables without noise, and noise of these sds."""
    rng = np.random.default_rng(seed)
    tables = [
        table_from_arrays(
            dict(table.columns)
            | {"drawbar_pull_kn": table["drawbar_pull_kn"] + sd * rng.standard_normal(sd.size)}
        )
        for table, sd in zip((case.lab, case.field), sds, strict=True)
    ]
    return campaigns(replace(case, lab=tables[0], field=tables[1]))


def fitted_noise(data: Campaigns) -> Noise:
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.03})
    start = np.array([p.loc for p in forward.priors.free])
    return fit(forward, start, {"drawbar_pull": Noise(0.03)}).noise["drawbar_pull"]


def test_noise_that_grows_with_slip_is_seen():
    case = make_case(models=PULL_ONLY, n_lab=120, n_field=60, noise=0.0)
    sds = [0.01 * (1.0 + 5.0 * table["slip_ratio"]) for table in (case.lab, case.field)]
    found = fitted_noise(noisy_again(case, sds, 8))
    assert found.rho >= 2.5
    assert found.kappa == 0.0


@pytest.mark.parametrize("kappa", [0.0, 0.8, -0.8])
def test_noise_of_a_soft_tyre_is_seen(kappa: float):
    case = make_case(models=PULL_ONLY, n_lab=120, n_field=60, noise=0.0)
    pressures = [table["inflation_pressure_psi"] for table in (case.lab, case.field)]
    middle = np.median(pressures[0])
    found = fitted_noise(noisy_again(case, [0.02 * (middle / p) ** kappa for p in pressures], 8))
    assert found.kappa == kappa
    assert found.rho == 0.0
    # 180 readings less a dozen parameters: 5.5 %.
    assert found.sigma == pytest.approx(0.02, rel=0.17)
