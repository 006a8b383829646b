"""The slow reference agrees with a closed form, and the diagnosis with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from calib.gap.hypotheses import Hypothesis
from calib.gap.ranking import calibrate_lab
from calib.gap.screen import Screen
from tests.gap.cases import ranking_of
from tests.gap.fits import straight_line
from tests.gap.reference import ln_evidence, reference
from tests.gap.test_posterior import closed_form, noises


def test_its_evidence_is_that_of_the_closed_form() -> None:
    data = straight_line(1)
    forward = Screen(data, *calibrate_lab(data, 1), 1).forward(Hypothesis("none"))
    grid, each = noises(data)
    exact = logsumexp([closed_form(data, noise) for noise in grid]) + each
    found, psi = ln_evidence(forward, 2000, np.random.default_rng(1))
    # Of two thousand particles, over a dozen powers.
    assert found == pytest.approx(exact, abs=0.25)
    assert psi.shape == (2000, 2)


class Normal:
    """Stands for a hypothesis and its residuals: normal about `mean` with `sd`, prior standard."""

    data, n_dim = None, 25
    mean = np.r_[np.full(10, 0.7), np.zeros(15)]
    sd = np.r_[np.full(10, 0.02), np.full(5, 0.3), np.full(10, 10.0)]

    def prior_draws(self, rng, n):
        return rng.standard_normal((n, 25))

    def log_prior(self, psi):
        return -0.5 * np.square(psi).sum(axis=1) - 12.5 * np.log(2.0 * np.pi)

    def raw(self, psi):
        return (psi - self.mean) / self.sd

    def ln_averaged(self, raw):
        return -0.5 * np.square(raw).sum(axis=1)


@pytest.mark.slow
def test_many_coordinates_do_not_bias_its_evidence(monkeypatch) -> None:
    """Particles that are moved by their own covariance draw together: 1.7 too much of 25."""
    normal = Normal()
    monkeypatch.setattr("tests.gap.reference.Residuals", lambda *_: normal)
    variance = 1.0 + normal.sd**2
    exact = np.log(normal.sd).sum() - 0.5 * (np.log(variance) + normal.mean**2 / variance).sum()
    found = [ln_evidence(normal, 500, np.random.default_rng(i))[0] for i in range(4)]
    # Four runs, each with an sd of 0.15.
    assert np.mean(found) == pytest.approx(exact, abs=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("effect", [None, "force_offset", "lug_thrust"])
def test_the_diagnosis_agrees_with_it(effect: str | None) -> None:
    ranking = ranking_of(effect)
    there, _ = reference(ranking, 1000, 2, 1)
    whole = sum(ranking.probability[name] for name in there)
    for name, p in there.items():
        assert ranking.probability[name] / whole == pytest.approx(p, abs=0.1)
