"""Isolability: known before any outcome of the field, and right where the answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from calib.data import table_from_arrays
from calib.gap.campaigns import campaigns
from calib.gap.constants import MIN_EFFECT_SIZE, PRIOR
from calib.gap.effects import EFFECTS
from calib.gap.hypotheses import singles
from calib.gap.identifiability import identifiability, smallest_shown
from calib.gap.noise import Noise
from calib.gap.ranking import rank
from calib.inference.mode import prior_widths
from tests.gap.cases import CHOICE, campaigns_of, make_case, ranking_of


def test_shares_sizes_and_cosines_are_in_their_ranges():
    design = ranking_of(None).identifiability
    names = set(design.absorbed)
    assert names == set(design.detectable)
    # Beside the effects only what the pull may depend on that no effect of these is about.
    assert names - set(CHOICE) == {"depends_on_pass_number"}
    for name in names:
        assert 0.0 <= design.absorbed[name] <= 1.0
        assert 0.05 < design.detectable[name] < 20.0
    for (a, b), cosine in design.cosine_similarity.items():
        assert a < b
        assert -1.0 - 1e-9 <= cosine <= 1.0 + 1e-9
    assert len(design.cosine_similarity) == len(names) * (len(names) - 1) // 2


def test_field_outcomes_do_not_matter():
    case = make_case(models={"drawbar_pull": "magic_formula"})
    columns = dict(case.field.columns)
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"][::-1] + 3.0
    other = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")}
    a, b = (rank(campaigns(c), 1, effects=few).identifiability for c in (case, other))
    assert a == b


def test_two_names_of_one_effect_are_alike():
    data = campaigns_of(None, "pull")
    effect = EFFECTS["force_offset"]
    one, two = singles(data, {"force_offset": effect})[0], singles(data, {"same": effect})[0]
    mode = {"drawbar_pull": ranking_of_pull().lab_mode["drawbar_pull"]}
    design = identifiability(data, [one, two], mode, {"drawbar_pull": Noise(0.03, 0.0)}, 1)
    assert design.cosine_similarity["force_offset", "same"] == pytest.approx(1.0)
    assert design.absorbed["same"] == pytest.approx(design.absorbed["force_offset"])


def ranking_of_pull():
    few = {n: EFFECTS[n] for n in ("force_offset",)}
    return rank(campaigns_of(None, "pull"), 1, effects=few)


def test_what_parameters_can_imitate_is_absorbed():
    """The model of one pressure has a vertical shift: it takes up an offset, not a drift."""
    data = campaigns_of(None, "pull")
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    mode = {"drawbar_pull": ranking_of_pull().lab_mode["drawbar_pull"]}
    design = identifiability(data, singles(data, few), mode, {"drawbar_pull": Noise(0.03, 0.0)}, 1)
    assert design.absorbed["force_offset"] > design.absorbed["sensor_drift"]
    # With a laboratory that leaves more noise, everything is harder to see.
    noisy = identifiability(data, singles(data, few), mode, {"drawbar_pull": Noise(0.3, 0.0)}, 1)
    assert noisy.absorbed["force_offset"] != design.absorbed["force_offset"]


def test_more_rows_show_smaller_effects():
    few = {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")}
    models = {"drawbar_pull": "magic_formula"}
    sizes = []
    for n_field in (12, 48):
        data = campaigns(make_case(models=models, n_field=n_field))
        sizes.append(rank(data, 1, effects=few).identifiability.detectable)
    for name in few:
        ratio = sizes[0][name] / sizes[1][name]
        # Four times the rows halve the sd, but not the size from which on an effect counts.
        assert 1.05 < ratio < 2.0
    assert np.isfinite(list(sizes[1].values())).all()


def test_the_smallest_size_shown_is_that_of_the_bayes_factor():
    """Against a fine sum over a uniform prior from the relevant size on, and its limits."""
    prior = np.linspace(0.0, 10.0, 10_001)
    sd, ln_odds = 0.25, 5.0
    sizes = prior[prior >= MIN_EFFECT_SIZE]

    def ln_factor(estimate: float) -> float:
        with_effect = norm.pdf(estimate, sizes, sd).mean()
        return float(np.log(with_effect / norm.pdf(estimate, 0.0, sd)))

    threshold = brentq(lambda t: ln_factor(t) - ln_odds, 0.1, 3.0)
    found = smallest_shown(prior, sd, ln_odds)
    assert found == pytest.approx(threshold + norm.ppf(0.8) * sd, abs=0.01)
    assert smallest_shown(prior, 1e-3, ln_odds) == pytest.approx(0.5 * MIN_EFFECT_SIZE, abs=0.02)
    assert smallest_shown(prior[prior < MIN_EFFECT_SIZE], sd, ln_odds) == np.inf


def test_absorbed_is_what_the_calibrated_parameters_can_take_up():
    """Of an offset, by least squares: with J S J' worked out again by differences of differences.

    An offset d is d/sigma in every row; what is left of its square is g' (1 + J S J')^-1 g.
    """
    data = campaigns_of(None, "pull")
    (o,) = data.outputs
    mode, sigma = ranking_of_pull().lab_mode[o.name], 0.03
    scale = o.problem.priors.entries[-1]
    at = np.append(mode, np.log(sigma) if scale.log else sigma)
    width = 2e-3 * prior_widths(o.problem.priors)
    d = at.size

    def curvature(i, j):
        a, b = width[i] * np.eye(d)[i], width[j] * np.eye(d)[j]
        points = np.stack([at + a + b, at + a - b, at - a + b, at - a - b])
        return -(o.problem.log_prob(points) @ [1.0, -1.0, -1.0, 1.0]) / (4.0 * width[i] * width[j])

    covariance = np.linalg.inv([[curvature(i, j) for j in range(d)] for i in range(d)])
    conditions = o.problem.bound.model.select(data.view.conditions)

    def field(psi):
        return o.problem.bound.mean_response(o.priors.to_natural(psi[None]), conditions)[0, o.rows]

    steps = np.diag(width[:-1])
    jacobian = np.stack([(field(mode + s) - field(mode - s)) / (2.0 * s.sum()) for s in steps])
    jacobian = jacobian.T / sigma
    c = np.eye(o.rows.size) + jacobian @ covariance[:-1, :-1] @ jacobian.T
    one = np.ones(o.rows.size)
    left = one @ np.linalg.solve(c, one)
    single = singles(data, {"force_offset": EFFECTS["force_offset"]})
    design = identifiability(data, single, {o.name: mode}, {o.name: Noise(sigma, 0.0)}, 1)
    assert design.absorbed["force_offset"] == pytest.approx(1.0 - left / one.size, rel=0.01)
    # Smallest size: its estimate has the sd 1/sqrt(left), its size is |d|/sigma.
    prior = np.abs(single[0].effect_priors[0].sample(np.random.default_rng(3), 4096)[:, 0]) / sigma
    ln_odds = np.log(10.0) + np.log(PRIOR["none"] / PRIOR["single"])
    expected = smallest_shown(prior, left**-0.5, ln_odds)
    # Of one thousand draws against four thousand others.
    assert design.detectable["force_offset"] == pytest.approx(expected, rel=0.05)
