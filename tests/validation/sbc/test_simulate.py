"""Designs and simulated campaigns: truths from the prior, data from the truths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.data import table_from_arrays
from calib.inference.problem import build_problem
from calib.models import MODELS
from calib.validation.replicate import design_of, simulate


@pytest.mark.parametrize("model", MODELS)
def test_a_design_is_the_embedded_one_and_is_held_out_inside_it(model: str) -> None:
    design = design_of(model)
    problem = build_problem(model, design.table)
    assert set(design.held) == set(problem.bound.model.conditions)
    assert len({v.size for v in design.held.values()}) == 1
    for name, values in problem.conditions.items():
        assert values.min() <= design.held[name].min()
        assert design.held[name].max() <= values.max()
    assert 0 <= design.watched < next(iter(design.held.values())).size
    fitted = np.column_stack([problem.conditions[n] for n in design.held])
    held = np.column_stack(list(design.held.values()))
    assert not (held[:, None] == fitted).all(axis=2).any()
    assert str(len(fitted)) in design.text
    assert str(len(held)) in design.text


def test_held_out_rows_can_be_predicted() -> None:
    for model in MODELS:
        table_from_arrays(design_of(model).held)  # checked as a file is


@pytest.mark.parametrize("model", ["bekker", "ayers_perumpral"])
def test_truths_are_the_priors_and_noise_is_normal(model: str) -> None:
    design = design_of(model)
    template = build_problem(model, design.table)
    rng = np.random.default_rng(1)
    cases = [simulate(template, design, rng) for _ in range(400)]
    truths = np.array([c.truth for c in cases])
    for j in range(template.n_dim):
        grid = template.priors.ppf(np.tile(np.linspace(0, 1, 2002)[1:-1, None], template.n_dim))
        assert stats.ks_2samp(truths[:, j], grid[:, j]).pvalue > 1e-4, template.names[j]
    z = []
    for case in cases:
        natural = template.theta(case.truth[None])
        residual = case.problem.residuals(natural)[0]
        z.append(residual / natural[0, -1])
        back = template.bound.to_response
        held = back(case.measured) - back(case.location)
        z.append(held / natural[0, -1])
    flat = np.concatenate(z)
    assert stats.kstest(flat, "norm").pvalue > 1e-4
    # Neighbouring rows share nothing.
    assert abs(np.corrcoef(flat[:-1], flat[1:])[0, 1]) < 5.0 / np.sqrt(flat.size)


def test_parameters_without_a_value_are_drawn_again() -> None:
    """Negative exponents give no rut; the truths are the prior's where there is one."""
    design = design_of("modified_bekker")
    template = build_problem("modified_bekker", design.table)
    rng = np.random.default_rng(3)
    cases = [simulate(template, design, rng) for _ in range(300)]
    drawn = template.priors.sample(np.random.default_rng(4), 20_000)
    natural = template.theta(drawn)
    defined = np.isfinite(template.bound.mean_response(natural[:, :-1], template.conditions)).all(
        axis=1
    )
    attempts = np.array([c.attempts for c in cases])
    assert abs(1.0 / attempts.mean() - defined.mean()) < 0.02
    j = template.names.index("n1")
    truths = np.array([c.truth[j] for c in cases])
    assert stats.ks_2samp(truths, drawn[defined, j]).pvalue > 1e-4


def test_simulated_outputs_replace_the_embedded_ones() -> None:
    design = design_of("modified_bekker")
    template = build_problem("modified_bekker", design.table)
    case = simulate(template, design, np.random.default_rng(1))
    assert not (case.problem.observed == template.observed).any()
    assert case.problem.table.label == "simulated"
    assert case.problem.bound is template.bound
    for name, values in template.conditions.items():
        np.testing.assert_array_equal(case.problem.conditions[name], values)
