"""The evidence of a straight line read seventeen times, which is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from calib.gap.case import Campaigns, OutputData, campaigns
from calib.gap.fit import fit
from calib.gap.forward import Forward
from calib.gap.hypothesis import Hypothesis
from calib.gap.noise import Noise, ln_prior, noise_conditions_of_lab
from calib.gap.refine import refine
from calib.inference.priors import Priors
from tests.custom_problems import normal, problem_of
from tests.gap.cases import PULL_ONLY, make_case


def straight_line(seed: int) -> Campaigns:
    """Ten readings in the laboratory and seven in the field, none of them with a gap."""
    few = campaigns(make_case(models=PULL_ONLY, n_lab=10, n_field=7))
    rng = np.random.default_rng(seed)
    slips = np.linspace(0.0, 0.6, 10), few.view.slip()
    pulls = [0.3 + 0.8 * s + 0.04 * rng.standard_normal(s.size) for s in slips]
    sigma = normal("sigma", np.log(0.05), 0.8, log=True)
    priors = [normal("a", 0.0, 1.0), normal("b", 0.5, 2.0), sigma]
    problem = problem_of(lambda a, b, slip: a + b * slip, priors, slips[0], pulls[0])
    own = Priors(problem.priors.entries[:-1])
    o = OutputData("drawbar_pull", problem, own, np.arange(7), pulls[1])
    at = {o.name: noise_conditions_of_lab(problem.table, few.view)}
    return Campaigns((o,), few.view, at, few.case)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_at_its_noise_the_evidence_is_that_of_the_closed_form(seed: int):
    data = straight_line(seed)
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.04})
    found = fit(data, forward, np.array([0.0, 0.5]), {"drawbar_pull": Noise(0.04)})
    noise, at = found.noise["drawbar_pull"], data.at_rows["drawbar_pull"]
    design = np.stack([np.ones(17), at.slip], axis=1)
    # Both parameters integrated out, the readings are normal.
    covariance = design @ np.diag([1.0, 4.0]) @ design.T + np.diag(noise.sd(at) ** 2)
    exact = multivariate_normal.logpdf(data.observed, design @ [0.0, 0.5], covariance)
    exact += ln_prior(noise)
    # In a linear model Laplace's is exact; of 23,000 weighted draws the error is about 0.01.
    assert found.log_evidence == pytest.approx(exact, abs=1e-4)
    assert refine(found, 1).log_evidence == pytest.approx(exact, abs=0.03)
