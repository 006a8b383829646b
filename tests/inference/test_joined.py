"""Coordinates in which two parameters of one sum are sampled."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.data import read_table
from calib.inference.priors import SumAndRatio, sum_and_ratio
from calib.inference.problem import Problem, build_problem
from calib.models import example_csv


def problem(model: str, folder: Path) -> Problem:
    path = folder / "data.csv"
    path.write_text(example_csv(model), encoding="utf-8")
    return build_problem(model, read_table(path))


def joined(problem: Problem) -> Problem:
    pair = problem.bound.model.joined
    return replace(problem, priors=sum_and_ratio(problem.priors, pair, problem.conditions))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return problem("wong_reece_sinkage", tmp_path_factory.mktemp("wheel"))


def test_the_two_coordinates_are_the_sum_and_the_ratio(wheel: Problem) -> None:
    priors = joined(wheel).priors
    assert isinstance(priors, SumAndRatio)
    t = wheel.priors.sample(np.random.default_rng(1), 50)
    width = wheel.table["tyre_width_m"].mean()
    k1, by_width = np.exp(t[:, 0]), np.exp(t[:, 1]) * width
    u = priors.joined(t)
    np.testing.assert_allclose(u[:, 0], np.log(k1 + by_width))
    np.testing.assert_allclose(u[:, 1], np.log(by_width / k1))
    np.testing.assert_array_equal(u[:, 2:], t[:, 2:])
    np.testing.assert_allclose(priors.by_parameter(u), t)


def test_densities_and_natural_parameters_are_the_same(wheel: Problem) -> None:
    again = joined(wheel)
    t = wheel.priors.sample(np.random.default_rng(2), 50)
    u = again.priors.joined(t)
    np.testing.assert_allclose(again.log_prob(u), wheel.log_prob(t))
    np.testing.assert_allclose(again.theta(u), wheel.theta(t))
    np.testing.assert_allclose(again.priors.to_internal(wheel.theta(t)), u, rtol=1e-6)


def test_volumes_are_the_same(wheel: Problem) -> None:
    priors = joined(wheel).priors
    t = wheel.priors.sample(np.random.default_rng(3), 1)[0]
    step = 1e-6 * np.eye(t.size)
    jacobian = (priors.joined(t + step) - priors.joined(t - step)) / 2e-6
    assert np.linalg.det(jacobian) == pytest.approx(1.0, abs=1e-6)


def test_a_fixed_or_bounded_parameter_is_sampled_as_it_is(wheel: Problem) -> None:
    assert joined(wheel.with_fixed({"k1": 20.0})).priors.names == wheel.names[1:]
    assert not isinstance(joined(wheel.with_fixed({"k1": 20.0})).priors, SumAndRatio)
    entries = tuple(replace(p, upper=9.0) if p.name == "k2" else p for p in wheel.priors.entries)
    bounded = replace(wheel, priors=replace(wheel.priors, entries=entries))
    assert joined(bounded).priors is bounded.priors


def test_a_model_without_such_a_pair_is_sampled_as_it_is(tmp_path: Path) -> None:
    bekker = problem("bekker", tmp_path)
    assert joined(bekker).priors is bekker.priors
