"""The geometric method and the regression as published."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.he2019.estimators import Features, coefficients, read_features, rut_regression
from calib.he2019.published import PUBLISHED
from calib.inference.estimators import estimate
from calib.inference.problem import build_problem
from calib.models.magic_formula import magic_formula

TABLE_3, TABLE_4 = (
    {psi: tuple(table.values.values()) for psi, table in tables.items()}
    for tables in (PUBLISHED.geometric, PUBLISHED.genetic)
)
FIXED = {"Sh": 0.0, "Sv": 0.0}


def exact_features(B, C, D, E):
    """Features of the curve itself, found numerically."""

    def bend(x):
        return B * x - E * (B * x - np.arctan(B * x)) - np.tan(np.pi / (2 * C))

    x_peak = brentq(bend, 1e-9, 1e6, xtol=1e-13)
    h = 1e-6
    slope = (magic_formula(h, B, C, D, E) - magic_formula(-h, B, C, D, E)) / (2 * h)
    return Features(
        float(slope), x_peak, float(magic_formula(x_peak, B, C, D, E)),
        float(magic_formula(1e12, B, C, D, E)),
    )  # fmt: skip


def build(slip, pull, **kwargs):
    table = table_from_arrays({"slip_percent": slip, "drawbar_pull_kn": pull})
    return build_problem("magic_formula", table, **({"fixed": FIXED} | kwargs))


@pytest.mark.parametrize("values", [*TABLE_3.values(), *TABLE_4.values()])
def test_features_give_the_parameters_back(values):
    features = exact_features(*values)
    found = coefficients(features)
    # The asymptote enters by an arcsine, whose slope is large near the peak.
    np.testing.assert_allclose(found, values, rtol=1e-6)
    again = exact_features(*found)
    np.testing.assert_allclose(again[:4], features[:4], rtol=1e-6)


@pytest.mark.parametrize("psi", TABLE_3)
def test_reads_a_dense_curve(psi):
    B, C, D, E = TABLE_3[psi]
    levels = np.append(np.geomspace(0.1, 100.0, 38), 3000.0)
    got = read_features(levels, magic_formula(levels, B, C, D, E), slope_slip_percent=1.0)
    want = exact_features(B, C, D, E)
    assert got.slope == pytest.approx(want.slope, rel=0.05)
    assert got.peak == pytest.approx(want.peak, rel=0.01)
    assert got.asymptote == pytest.approx(want.asymptote, rel=0.05)
    assert got.has_peak


def test_parabola_finds_the_slip_of_the_peak():
    x = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 40.0])
    y = 2.0 - 0.004 * (x - 11.0) ** 2
    got = read_features(x, np.maximum(y, 0.1))
    assert got.x_peak == pytest.approx(11.0)
    assert got.peak == pytest.approx(y.max())


def test_repeats_are_averaged_and_order_does_not_matter():
    x = np.array([1.0, 3.0, 5.0, 10.0, 20.0, 40.0])
    y = np.array([0.1, 0.3, 0.5, 0.8, 0.7, 0.6])
    noise = np.array([0.05, -0.05, 0.03, 0.02, -0.04, 0.01])
    twice_x, twice_y = np.tile(x, 2), np.concatenate([y + noise, y - noise])
    order = np.random.default_rng(0).permutation(12)
    a = read_features(x, y)
    b = read_features(twice_x[order], twice_y[order])
    np.testing.assert_allclose(b[1:4], a[1:4], rtol=1e-12)


def test_zero_is_found_where_it_is_asked_for():
    x = np.array([0.0, 2.5, 5.0, 10.0, 20.0, 30.0, 50.0])
    y = magic_formula(x, 0.1, 1.5, 1.0, -2.0, Sh=-2.0)
    got = read_features(x, y, find_zero=True)
    assert got.zero == pytest.approx(-2.0, abs=1.0)
    problem = build(x, y, fixed={"Sv": 0.0})
    found = estimate(problem, "geometric", np.random.default_rng(0))
    assert found.reported["Sh"] == pytest.approx(got.zero)
    assert found.r_squared > 0.9


def test_fixed_parameters_are_respected():
    x = np.array([2.0, 4.5, 7.0, 12.0, 20.0, 30.0, 50.0])
    y = magic_formula(x, 0.1, 1.5, 1.0, -2.0, Sh=1.0, Sv=0.2)
    problem = build(x, y, fixed={"Sh": 1.0, "Sv": 0.2, "C": 1.5})
    found = estimate(problem, "geometric", np.random.default_rng(0))
    assert found.reported["C"] == 1.5
    assert found.reported["Sh"] == 1.0
    assert found.reported["Sv"] == 0.2
    assert found.r_squared > 0.9


def test_no_peak_inside_the_range():
    x = np.linspace(2.0, 30.0, 10)
    problem = build(x, 0.03 * x / (1.0 + 0.01 * x))
    found = estimate(problem, "geometric", np.random.default_rng(0))
    assert "no peak" in found.note
    assert found.reported["C"] == 1.5
    assert np.isfinite(found.cost)


def test_dense_noisy_data():
    rng = np.random.default_rng(4)
    x = rng.uniform(0.0, 70.0, 3000)
    y = magic_formula(x, *TABLE_4[30]) + 0.05 * rng.standard_normal(x.size)
    found = estimate(build(x, y), "geometric", rng)
    assert found.reported["D"] == pytest.approx(1.007, rel=0.05)
    assert found.r_squared > 0.8


@pytest.mark.parametrize("pressures", [(18, 42), (18, 30, 42)])
def test_pressures_are_joined_exactly(pressures):
    slip = np.array([2, 4.5, 7, 9.5, 12, 14.5, 17, 19.5, 22, 32, 42, 52, 62, 72])
    pull = [magic_formula(slip, *TABLE_4[psi]) for psi in pressures]
    joint = build_problem(
        "magic_formula_pressure",
        table_from_arrays(
            {
                "inflation_pressure_psi": np.repeat(np.array(pressures, float), slip.size),
                "slip_percent": np.tile(slip, len(pressures)),
                "drawbar_pull_kn": np.concatenate(pull),
            }
        ),
    )
    found = estimate(joint, "geometric", np.random.default_rng(0))
    names = joint.bound.model.parameters
    theta = dict(zip(names, found.theta, strict=True))
    single = [
        estimate(build(slip, y), "geometric", np.random.default_rng(0)).reported for y in pull
    ]
    c, K, D, E = found.reported, [], [], []
    for psi, s in zip(pressures, single, strict=True):
        K.append(c["c4"] + c["c5"] * psi + c["c6"] * psi**2 - s["B"] * s["C"] * s["D"])
        D.append(c["c1"] + c["c2"] * psi + c["c3"] * psi**2 - s["D"])
        E.append(c["c7"] + c["c8"] * psi + c["c9"] * psi**2 - s["E"])
    np.testing.assert_allclose([K, D, E], 0.0, atol=1e-9)
    assert c["b0"] == pytest.approx(np.mean([s["C"] for s in single]))
    if len(pressures) == 2:
        assert "bends are at the prior's location" in found.note
        bends = {p.name: p.loc for p in joint.priors.entries if p.name.endswith("_bend")}
        assert {name: theta[name] for name in bends} == pytest.approx(bends)


@pytest.mark.parametrize(
    ("slip", "pull"),
    [
        (np.array([1.0, 2, 3, 5, 10, 20, 25, 30]), -np.array([1, 2, 3, 4, 5, 5, 4.5, 4]) / 10),
        (np.repeat([1.0, 5.0, 9.0], 3), np.tile([0.1, 0.5, 0.6], 3)),
        (-np.array([1.0, 2, 3, 5, 10, 20, 25, 30]), np.array([1, 2, 3, 4, 5, 5, 4.5, 4]) / 10),
    ],
)
def test_unreadable_curves(slip, pull):
    with pytest.raises(CalibError, match="geometric method"):
        estimate(build(slip, pull), "geometric", np.random.default_rng(0))


def build_rut(kpa, slip, rut, model="modified_bekker", **kwargs):
    columns = {"average_ground_pressure_kpa": kpa, "rut_depth_mm": rut, "slip_ratio": slip}
    return build_problem(model, table_from_arrays(columns), **kwargs)


@pytest.fixture
def noisy():
    rng = np.random.default_rng(3)
    kpa = np.repeat([106.6, 178.2], 12)
    slip = np.tile(np.append(np.linspace(0.0, 0.2, 9), [0.3, 0.5, 0.7]), 2)
    rut = 1000 * (kpa / 3.3e5) ** (1 / (2.0 + 1.3 * slip))
    return kpa, slip, rut * np.exp(0.05 * rng.standard_normal(kpa.size))


def test_equals_ordinary_least_squares(noisy):
    kpa, slip, rut = noisy
    keep = slip <= 0.2
    ln_z = np.log(rut[keep] / 1000)
    X = np.column_stack([np.ones(18), ln_z, slip[keep] * ln_z])
    y = np.log(kpa[keep])
    beta, sse, *_ = np.linalg.lstsq(X, y, rcond=None)
    fit = rut_regression(build_rut(kpa, slip, rut))
    assert fit.n == 18
    assert fit.n_excluded == 6
    assert fit.reported == pytest.approx({"n0": beta[1], "n1": beta[2], "k": np.exp(beta[0])})
    assert fit.rmse == pytest.approx(np.sqrt(sse[0] / 15))
    assert fit.r_squared == pytest.approx(1 - sse[0] / np.sum((y - y.mean()) ** 2))
    # The estimate is judged on the likelihood's scale, by all rows.
    problem = build_rut(kpa, slip, rut)
    found = estimate(problem, "published_regression", np.random.default_rng(0))
    assert found.reported == pytest.approx(fit.reported)
    r = problem.response - problem.bound.mean_response(found.theta, problem.conditions)[0]
    assert found.cost == pytest.approx(float(r @ r))
    assert "6 rows above 0.2 slip left out" in found.note
    assert f"RMSE = {fit.rmse:.3f}" in found.note


def test_bekker_leaves_slip_out(noisy):
    kpa, slip, rut = noisy
    keep = slip <= 0.2
    slope, intercept = np.polyfit(np.log(rut[keep] / 1000), np.log(kpa[keep]), 1)
    fit = rut_regression(build_rut(kpa, slip, rut, "bekker"))
    assert fit.reported == pytest.approx({"n": slope, "k": np.exp(intercept)})
    everything = rut_regression(build_rut(kpa, slip, rut, "bekker"), max_slip=1.0)
    assert everything.n_excluded == 0


def test_noise_in_the_rut_attenuates_the_published_exponent():
    rng = np.random.default_rng(8)
    kpa = np.repeat([106.6, 178.2], 2000)
    slip = np.tile(np.linspace(0.0, 0.2, 10), 400)
    rut = 1000 * (kpa / 3.3e5) ** (1 / (2.0 + 1.3 * slip))
    problem = build_rut(kpa, slip, rut * np.exp(0.1 * rng.standard_normal(kpa.size)))
    published = estimate(problem, "published_regression", rng)
    proper = estimate(problem, "least_squares", rng)
    assert proper.reported["n0"] == pytest.approx(2.0, rel=0.03)
    assert published.reported["n0"] < 0.85 * proper.reported["n0"]


def test_one_ground_pressure(noisy):
    _, slip, rut = noisy
    with pytest.raises(CalibError, match="cannot tell its 3 coefficients apart"):
        rut_regression(build_rut(np.full(24, 120.0), slip, rut))


def test_fixed_parameters_and_falling_ruts(noisy):
    kpa, slip, rut = noisy
    with pytest.raises(CalibError, match="n1 is fixed"):
        estimate(
            build_rut(kpa, slip, rut, fixed={"n1": 0.0}), "published_regression",
            np.random.default_rng(0),
        )  # fmt: skip
    with pytest.raises(CalibError, match="an exponent of -"):
        estimate(build_rut(kpa[::-1], slip, rut), "published_regression", np.random.default_rng(0))
