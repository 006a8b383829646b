"""The evidence of a straight line read seventeen times, which is known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import calib.gap.fit as module
from calib.gap.ascent import together
from calib.gap.case import Campaigns, OutputData, campaigns
from calib.gap.fit import Fit, finish, fit
from calib.gap.forward import Forward
from calib.gap.hypothesis import Hypothesis
from calib.gap.noise import Noise, ln_prior, noise_conditions_of_lab
from calib.gap.refine import refine
from calib.inference.priors import Prior, Priors
from tests.custom_problems import normal, problem_of
from tests.gap.cases import PULL_ONLY, make_case


def straight_line(seed: int, *idle: Prior, lower: float = -np.inf) -> Campaigns:
    """Ten readings in the laboratory and seven in the field, none of them with a gap.

    On parameters that are idle nothing depends.
    """
    few = campaigns(make_case(models=PULL_ONLY, n_lab=10, n_field=7))
    rng = np.random.default_rng(seed)
    slips = np.linspace(0.0, 0.6, 10), few.view.slip()
    pulls = [0.3 + 0.8 * s + 0.04 * rng.standard_normal(s.size) for s in slips]
    sigma = normal("sigma", np.log(0.05), 0.8, log=True)
    a = replace(normal("a", 0.0, 1.0), lower=lower)
    priors = [a, normal("b", 0.5, 2.0), *idle, sigma]
    problem = problem_of(lambda a, b, *more: a + b * more[-1], priors, slips[0], pulls[0])
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


@pytest.mark.parametrize("start", [0.1, 0.1005, 0.5, 0.899, 0.9])
def test_what_nothing_depends_on_changes_no_evidence(start: float):
    def evidence(data: Campaigns, begun: list[float]) -> tuple[float, float]:
        forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.04})
        found = fit(data, forward, np.array(begun), {"drawbar_pull": Noise(0.04)})
        refined = refine(found, 1)
        assert refined.sample is not None
        return found.log_evidence, refined.log_evidence

    # As the change point of a step that falls between two runs.
    idle = Prior("c", "1", "a test", "nobody", "uniform", False, 0.5, np.inf, 0.1, 0.9)
    without = evidence(straight_line(1), [0.0, 0.5])
    found = evidence(straight_line(1, idle), [0.0, 0.5, start])
    assert found[0] == pytest.approx(without[0], abs=0.01)
    assert found[1] == pytest.approx(without[1], abs=0.05)


@pytest.mark.parametrize("lower", [-np.inf, 0.2, 0.3, 0.4])
def test_of_a_bounded_parameter_the_evidence_is_the_mass_inside(lower: float):
    """The mode is inside the bound, beside it, or held at it by readings that ask for less."""
    data = straight_line(1, lower=lower)
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.04})
    found = fit(
        data, forward, np.array([max(0.0, lower + 0.1), 0.5]), {"drawbar_pull": Noise(0.04)}
    )
    noise, at = found.noise["drawbar_pull"], data.at_rows["drawbar_pull"]
    design = np.stack([np.ones(17), at.slip], axis=1)
    prior, sd = np.diag([1.0, 4.0]), noise.sd(at)
    free = multivariate_normal.logpdf(
        data.observed, design @ [0.0, 0.5], design @ prior @ design.T + np.diag(sd**2)
    )
    # Of the normals without the bound, the shares beyond it after and before the readings.
    precision = design.T @ (design / sd[:, None] ** 2) + np.linalg.inv(prior)
    information = design.T @ (data.observed / sd**2) + np.linalg.inv(prior) @ [0.0, 0.5]
    mean, covariance = np.linalg.solve(precision, information), np.linalg.inv(precision)
    after, before = norm.logsf(lower, mean[0], np.sqrt(covariance[0, 0])), norm.logsf(lower)
    exact = free + after - before + ln_prior(noise)
    assert found.log_evidence == pytest.approx(exact, abs=1e-3)
    if lower == 0.4:
        assert found.psi[0] == pytest.approx(lower)
        assert mean[0] + 2.0 * np.sqrt(covariance[0, 0]) < lower


def test_of_two_modes_the_more_probable_is_kept():
    """Also where it is the other that promised more before both had been climbed."""

    def at(psi: float, evidence: float) -> Fit:
        return Fit(None, np.array([psi]), np.eye(1), {}, evidence, 0.0, {})  # type: ignore[arg-type]

    begun = [at(0.0, -3.0), at(9.0, -1.0), at(9.5, -2.0), at(20.0, -30.0)]
    climbed: list[list[float]] = []

    def climb(fits):
        climbed.append([float(f.psi[0]) for f in fits])
        return [replace(f, log_evidence=-float(f.psi[0])) for f in fits]
        yield

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "full_fit", climb)
        (found,) = together([finish(begun)])
    # Of two on the way to one mode the better is climbed; one far less probable is not.
    assert climbed == [[9.0, 0.0]]
    assert found.psi[0] == 0.0
