"""The genetic algorithm: its generation, its determinism, where it ends."""

from __future__ import annotations

import numpy as np
import pytest

from calib.errors import CalibError
from calib.inference.estimators import (
    GeneticDraws,
    GeneticSettings,
    descendants,
    draw_generations,
    estimate,
    minimise_genetic,
)

TABLE_2 = GeneticSettings()


def bowl(x):
    return ((x - 0.3) ** 2).sum(axis=1)


def one_generation_by_hand(population, best, draws, F, lower, upper):
    """Eq 11, crossover and mutation gene by gene."""
    children = []
    for i, parent in enumerate(population):
        child = []
        for j, gene in enumerate(parent):
            if draws.crossed[i][j]:
                r1, r2 = population[draws.first[i]], population[draws.second[i]]
                new = best[j] + F * (r1[j] - r2[j])
            else:
                new = gene
            new = new + draws.mutation[i][j] * (upper[j] - lower[j])
            child.append(new if lower[j] <= new <= upper[j] else gene)
        children.append(child)
    return np.array(children)


def test_settings_are_table_2():
    s = TABLE_2
    assert (s.F, s.CP, s.MP, s.mutation_low, s.mutation_high) == (0.4, 0.6, 0.1, 0.0, 1.0)
    assert (s.NP, s.max_iterations) == (50, 4000)


def test_generation_equals_scalar_reimplementation():
    rng = np.random.default_rng(2)
    lower, upper = np.array([0.0, -5.0, 1.0]), np.array([1.0, 5.0, 100.0])
    population = lower + (upper - lower) * rng.random((TABLE_2.NP, 3))
    best = population[17]
    block = draw_generations(rng, 3, 3, TABLE_2)
    for g in range(3):
        draws = GeneticDraws(*(part[g] for part in block))
        got = descendants(population, best, draws, TABLE_2.F, lower, upper)
        by_hand = one_generation_by_hand(population, best, draws, TABLE_2.F, lower, upper)
        np.testing.assert_array_equal(got, by_hand)
        assert (got >= lower).all()
        assert (got <= upper).all()
        assert not np.array_equal(got, population)


def test_draws_have_the_stated_probabilities():
    s = GeneticSettings(mutation_low=0.2, mutation_high=0.5)
    draws = draw_generations(np.random.default_rng(0), 200, 4, s)
    assert (draws.first != draws.second).all()
    assert set(np.unique(draws.first)) == set(np.unique(draws.second)) == set(range(s.NP))
    assert draws.crossed.mean() == pytest.approx(0.6, abs=0.01)
    mutated = draws.mutation[draws.mutation != 0.0]
    assert mutated.size / draws.mutation.size == pytest.approx(0.1, abs=0.01)
    assert abs(mutated).min() >= 0.2
    assert abs(mutated).max() <= 0.5
    assert (mutated > 0).mean() == pytest.approx(0.5, abs=0.03)


def test_whole_run_equals_scalar_reimplementation():
    """Selection, best and stopping: a run of several blocks of draws, repeated by hand."""
    settings = GeneticSettings(NP=8, max_iterations=70)
    lower, upper = np.zeros(2), np.ones(2)
    result = minimise_genetic(bowl, lower, upper, np.random.default_rng(5), settings)
    rng = np.random.default_rng(5)
    population = rng.random((8, 2))
    lowest = [min(bowl(population))]
    for generation in range(70):
        if generation % 32 == 0:
            block = draw_generations(rng, 32, 2, settings)
        draws = GeneticDraws(*(part[generation % 32] for part in block))
        costs = bowl(population)
        best = population[np.argmin(costs)]
        children = one_generation_by_hand(population, best, draws, 0.4, lower, upper)
        population = np.array(
            [c if bowl(c[None])[0] < bowl(p[None])[0] else p
             for c, p in zip(children, population, strict=True)]
        )  # fmt: skip
        lowest.append(min(bowl(population)))
    np.testing.assert_allclose(result.history, lowest, rtol=0, atol=0)
    assert result.n_evaluations == 8 * 71
    assert not result.converged
    assert (np.diff(result.history) <= 0.0).all()


def test_one_model_evaluation_per_generation():
    shapes = []

    def cost(x):
        shapes.append(x.shape)
        return bowl(x)

    result = minimise_genetic(cost, np.zeros(2), np.ones(2), np.random.default_rng(0))
    assert set(shapes) == {(50, 2)}
    assert len(shapes) == result.history.size
    assert result.converged
    assert result.history.size < 1000
    np.testing.assert_allclose(result.x, 0.3, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_ends_at_the_least_squares_optimum(table_4, seed):
    problem, cost = table_4
    found = estimate(problem, "genetic", np.random.default_rng(seed))
    best = estimate(problem, "least_squares", np.random.default_rng(seed))
    assert best.cost == pytest.approx(cost, rel=1e-9)
    assert found.cost == pytest.approx(best.cost, rel=1e-9)
    np.testing.assert_allclose(found.theta, best.theta, rtol=1e-4)
    assert found.converged


def test_no_worse_than_differential_evolution_run_to_its_end(table_4):
    problem, cost = table_4
    genetic, de = [], []
    for seed in range(2):
        genetic.append(estimate(problem, "genetic", np.random.default_rng(seed)))
        de.append(
            estimate(problem, "differential_evolution", np.random.default_rng(seed), polish=False,
                     tol=1e-10)
        )  # fmt: skip
    assert max(e.cost for e in genetic) <= min(e.cost for e in de) * (1.0 + 1e-9)
    assert max(e.cost for e in genetic) == pytest.approx(cost, rel=1e-9)


def test_box_restarts_and_polish(table_4):
    problem, cost = table_4
    rng = np.random.default_rng(0)
    boxed = estimate(problem, "genetic", rng, box={"C": (1.0, 1.4)})
    assert boxed.theta[1] == pytest.approx(1.4, abs=1e-6)
    assert "C on the edge" in boxed.note
    assert boxed.cost > cost
    short = GeneticSettings(max_iterations=20)
    rough = estimate(problem, "genetic", np.random.default_rng(3), settings=short)
    smooth = estimate(problem, "genetic", np.random.default_rng(3), settings=short, polish=True)
    assert smooth.cost < rough.cost
    assert smooth.cost == pytest.approx(cost, rel=1e-9)
    assert "polished" in smooth.note
    twice = estimate(problem, "genetic", np.random.default_rng(3), settings=short, restarts=1)
    assert twice.n_evaluations == 2 * rough.n_evaluations
    assert twice.cost <= rough.cost


@pytest.mark.parametrize(
    "wrong",
    [
        {"F": 0.0}, {"CP": 1.2}, {"MP": -0.1}, {"mutation_low": 2.0}, {"NP": 2},
        {"max_iterations": 0}, {"tolerance": -1.0}, {"patience": 0}, {"F": float("nan")},
    ],
)  # fmt: skip
def test_impossible_settings(wrong):
    with pytest.raises(CalibError, match=f"with {next(iter(wrong))} ="):
        GeneticSettings(**wrong)


@pytest.mark.parametrize("box", [{"Z": (0, 1)}, {"C": (2.0, 1.0)}, {"C": (1.0, np.inf)}])
def test_impossible_boxes(table_4, box):
    with pytest.raises(CalibError, match="search box"):
        estimate(table_4[0], "genetic", np.random.default_rng(0), box=box)


def test_box_of_a_logarithm_must_be_positive(problem_of):
    problem, _ = problem_of("bekker")
    with pytest.raises(CalibError, match="starts at 0"):
        estimate(problem, "genetic", np.random.default_rng(0), box={"n": (0.0, 2.0)})
    found = estimate(problem, "genetic", np.random.default_rng(0), box={"n": (0.5, 2.0)})
    assert found.reported["n"] == pytest.approx(1.2)
