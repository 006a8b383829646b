"""The likelihood against scipy's densities, row by row."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.data import Table, table_from_arrays
from calib.errors import CalibError
from calib.inference.problem import Problem, build_problem
from calib.models import example_csv


@pytest.fixture
def rut_problem(rut_tables: tuple[Table, Table]) -> Problem:
    return build_problem("modified_bekker", rut_tables[0])


@pytest.fixture
def pull_problem(pull_tables: tuple[Table, Table]) -> Problem:
    return build_problem("magic_formula_pressure", pull_tables[0])


def near(problem: Problem, k: int = 20) -> np.ndarray:
    """Prior draws for which the model has a value on every row."""
    t = problem.priors.sample(np.random.default_rng(4), 20 * k)
    return t[np.isfinite(problem.log_likelihood(t))][:k]


def test_the_likelihood_of_pull_is_normal(pull_problem: Problem) -> None:
    t = near(pull_problem)
    natural = pull_problem.theta(t)
    mean = pull_problem.bound.predict(natural[:, :-1], pull_problem.conditions)
    expected = stats.norm.logpdf(pull_problem.observed, mean, natural[:, -1:])
    np.testing.assert_allclose(pull_problem.log_likelihood_rows(t), expected, rtol=1e-9)
    np.testing.assert_allclose(pull_problem.log_likelihood(t), expected.sum(axis=1), rtol=1e-9)


def test_the_likelihood_of_rut_depth_is_log_normal_jacobian_included(rut_problem: Problem) -> None:
    t = near(rut_problem)
    natural = rut_problem.theta(t)
    median = rut_problem.bound.predict(natural[:, :-1], rut_problem.conditions)
    expected = stats.lognorm.logpdf(rut_problem.observed, natural[:, -1:], scale=median)
    np.testing.assert_allclose(rut_problem.log_likelihood_rows(t), expected, rtol=1e-9)
    np.testing.assert_allclose(rut_problem.log_likelihood(t), expected.sum(axis=1), rtol=1e-9)


def test_outside_the_bounds_the_density_is_zero(pull_problem: Problem) -> None:
    t = near(pull_problem, 3)
    t[1, pull_problem.names.index("C")] = 2.001
    value = pull_problem.log_prob(t)
    np.testing.assert_array_equal(np.isfinite(value), [True, False, True])
    assert value[1] == -np.inf
    everything_out = t[1:2]
    assert pull_problem.log_prob(everything_out)[0] == -np.inf


def test_where_the_equation_has_no_value_the_likelihood_is_zero(pull_problem: Problem) -> None:
    t = near(pull_problem, 2)
    t[0, pull_problem.names.index("D_bend")] = 5.0  # the peak is negative in between
    assert pull_problem.log_likelihood(t)[0] == -np.inf
    assert np.isfinite(pull_problem.log_likelihood(t)[1])


@pytest.mark.parametrize("sigma", [0.0, -0.1, 1e-300, 1e300])
def test_noise_scales_that_a_prior_may_admit_but_data_cannot(
    rut_problem: Problem, sigma: float
) -> None:
    """No warning, no NaN; sigma = 1e300 is merely improbable."""
    t = near(rut_problem.with_fixed({"sigma": sigma}), 1)
    if not len(t):
        t = rut_problem.with_fixed({"sigma": sigma}).priors.sample(np.random.default_rng(0), 1)
    value = rut_problem.with_fixed({"sigma": sigma}).log_likelihood(t)
    assert value[0] == -np.inf if sigma < 1.0 else value[0] < -1e4


def test_holding_parameters_fixed(rut_problem: Problem) -> None:
    held = rut_problem.with_fixed({"n1": 1.0})
    assert held.names == ("z_ref", "n0", "sigma")
    t = np.log([[20.0, 1.5, 0.1]])
    full = np.insert(t, 2, 1.0, axis=1)
    np.testing.assert_allclose(held.log_likelihood(t), rut_problem.log_likelihood(full))
    assert rut_problem.names == ("z_ref", "n0", "n1", "sigma")


def test_other_rows_keep_the_reference_conditions(rut_tables: tuple[Table, Table]) -> None:
    problem = build_problem("modified_bekker", rut_tables[0])
    other = problem.with_table(rut_tables[1])
    assert other.bound.references == problem.bound.references
    np.testing.assert_array_equal(other.observed, rut_tables[1]["rut_depth_mm"])
    np.testing.assert_array_equal(
        other.bound.references["p_ref_kpa"],
        np.exp(np.log(rut_tables[0]["average_ground_pressure_kpa"]).mean()),
    )


def test_forces_are_relative_to_the_median_load_of_the_data() -> None:
    columns = {"slip_ratio": np.linspace(0, 0.5, 8), "drawbar_pull_kn": np.linspace(0, 1, 8) ** 0.5}
    with_load = columns | {"normal_load_n": np.full(8, 2000.0)}
    plain, loaded = (
        build_problem("magic_formula", table_from_arrays(c)).priors.entries
        for c in (columns, with_load)
    )
    for one, other in zip(plain, loaded, strict=True):
        shift = {"K": np.log(2 / 5), "D": np.log(2 / 5), "sigma": np.log(2 / 5)}
        assert other.loc - one.loc == pytest.approx(shift.get(one.name, 0.0))
        assert other.scale / one.scale == pytest.approx(0.4 if one.name == "Sv" else 1.0)


def table_of(model: str, tmp_path, **changed: np.ndarray | None) -> Table:
    from calib.data import read_table

    path = tmp_path / "my.csv"
    path.write_text(example_csv(model))
    columns = dict(read_table(path).columns) | changed
    return table_from_arrays({k: v for k, v in columns.items() if v is not None}, source="my.csv")


@pytest.mark.parametrize(
    ("model", "changed", "words"),
    [
        ("modified_bekker", {"rut_depth_mm": None}, ["my.csv", "rut_depth_mm", "rut_depth_cm"]),
        ("modified_bekker", {"slip_ratio": None}, ["slip_ratio", "slip_percent"]),
        ("modified_bekker", {"rut_depth_mm": np.full(9, 20.0)}, ["my.csv", "rut_depth_mm", "20"]),
        ("magic_formula_pressure", {"inflation_pressure_psi": np.full(22, 30.0)},
         ["my.csv", "inflation_pressure", "one inflation pressure only (30 psi)"]),
    ],
)  # fmt: skip
def test_data_that_cannot_calibrate(tmp_path, model: str, changed, words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        build_problem(model, table_of(model, tmp_path, **changed))
    for word in [*words, "expected:", "hint:"]:
        assert word in str(caught.value)


def test_as_many_rows_as_parameters_are_too_few(rut_tables: tuple[Table, Table]) -> None:
    with pytest.raises(CalibError, match="4 rows cannot calibrate modified_bekker") as caught:
        build_problem("modified_bekker", rut_tables[0].take([0, 5, 12, 15]))
    assert "at least 5 rows" in str(caught.value)
    assert build_problem("modified_bekker", rut_tables[0].take([0, 5, 9, 12, 15])).n_dim == 4


def test_a_problem_without_a_free_parameter_is_refused(rut_tables: tuple[Table, Table]) -> None:
    values = {"n0": 2.0, "n1": 1.3, "z_ref": 20.0}
    assert build_problem("modified_bekker", rut_tables[0], fixed=values).names == ("sigma",)
    with pytest.raises(CalibError, match="all parameters of modified_bekker are held fixed"):
        build_problem("modified_bekker", rut_tables[0], fixed={**values, "sigma": 0.1})
