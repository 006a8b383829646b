"""Names of methods, what they apply to, and comparing them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.inference.estimators import METHODS, compare, estimate, methods_for
from calib.inference.problem import build_problem
from calib.models import MODELS

ANY = ("genetic", "differential_evolution", "least_squares")


@pytest.mark.parametrize("model", MODELS)
def test_methods_of_every_model(model):
    methods = methods_for(model)
    assert set(ANY) <= set(methods) <= set(METHODS)
    assert ("geometric" in methods) == model.startswith("magic_formula")
    assert ("published_regression" in methods) == model.endswith("bekker")


def test_unknown_names(problem_of):
    problem, _ = problem_of("bekker")
    rng = np.random.default_rng(0)
    with pytest.raises(CalibError, match="there is no method 'guess'"):
        estimate(problem, "guess", rng)
    with pytest.raises(CalibError, match="'geometric' does not apply to model bekker"):
        estimate(problem, "geometric", rng)
    with pytest.raises(CalibError, match="there is no model"):
        methods_for("guess")


def test_compare(problem_of):
    problem, _ = problem_of("modified_bekker", noise=0.02)
    found = compare(problem, np.random.default_rng(1))
    assert tuple(e.method for e in found) == methods_for("modified_bekker")
    again = compare(problem, np.random.default_rng(1))
    for a, b in zip(found, again, strict=True):
        np.testing.assert_array_equal(a.theta, b.theta)
        assert a.theta.shape == (3,)
        assert a.n_evaluations >= 0
        assert a.seconds >= 0.0
    some = compare(problem, np.random.default_rng(1), ("least_squares",))
    assert [e.method for e in some] == ["least_squares"]


def test_compare_leaves_out_what_cannot_read_the_data():
    columns = {
        "average_ground_pressure_kpa": np.linspace(100.0, 140.0, 9), "slip_ratio": np.full(9, 0.5),
        "rut_depth_mm": np.arange(9) + 20.0,
    }  # fmt: skip
    problem = build_problem("bekker", table_from_arrays(columns))
    found = compare(problem, np.random.default_rng(0))
    assert tuple(e.method for e in found) == ANY
    with pytest.raises(CalibError, match="cannot tell"):
        compare(problem, np.random.default_rng(0), ("published_regression",))
