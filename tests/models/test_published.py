"""Numbers that can be worked out by hand from the tables of He, Sandu & Osorio (2019)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.models import MODELS
from calib.models.magic_formula import coefficients_at
from calib.models.soil import rut_depth

TABLE_4 = {
    18: (0.0794, 1.5619, 1.6480, -0.1026),
    30: (0.0713, 1.5685, 1.0071, -6.0844),
    42: (0.1265, 1.4802, 0.5954, -8.1747),
}
TABLE_5 = {
    "c1": 3.272, "c2": -0.107, "c3": 0.001, "c4": 0.267, "c5": -0.007, "c6": 0.0001,
    "c7": 0.963, "c8": -0.139, "c9": -0.0025, "b0": 1.554,
}  # fmt: skip
SLIP = {"slip_ratio": np.linspace(0.0, 0.7, 4001)}


@pytest.mark.parametrize("psi", TABLE_4)
def test_table_4_has_its_peak_and_its_initial_slope(psi: int) -> None:
    B, C, D, E = TABLE_4[psi]
    bound = MODELS["magic_formula"].bind(SLIP)
    theta = bound.theta({"B": B, "C": C, "D": D, "E": E})
    curve = bound.predict(theta, SLIP)[0]
    # The grid of 0.0175 % misses the peak by at most D C^2/2 (step B)^2 < 1e-5 of D here.
    assert curve.max() == pytest.approx(D, rel=1e-4)
    assert curve[0] == 0.0
    near_zero = bound.predict(theta, {"slip_ratio": np.array([1e-8])})[0, 0]
    assert near_zero / 1e-6 == pytest.approx(B * C * D, rel=1e-6)
    # Eq 7: the asymptote is D sin(pi C/2).
    far = bound.predict(theta, {"slip_ratio": np.array([1e9])})[0, 0]
    assert far == pytest.approx(D * math.sin(math.pi * C / 2), rel=1e-6)


def test_table_5_in_psi_gives_the_peaks_stated_with_it() -> None:
    model = MODELS["magic_formula_pressure"]
    conditions = {"slip_ratio": np.zeros(3), "inflation_pressure_psi": np.array([18.0, 30.0, 42.0])}
    bound = model.bind(conditions)
    theta = bound.theta(TABLE_5)
    found = coefficients_at(theta, conditions["inflation_pressure_psi"], bound.references)
    # D(42) = 3.272 - 0.107 x 42 + 0.001 x 42^2 = 0.542, where Table 4 has 0.595.
    np.testing.assert_allclose(found["D"][0], [1.67, 0.962, 0.542], rtol=1e-9)
    np.testing.assert_allclose(found["C"][0], 1.554)
    K = np.array([0.1734, 0.147, 0.1494])
    np.testing.assert_allclose((found["B"] * found["C"] * found["D"])[0], K, rtol=1e-9)
    np.testing.assert_allclose(found["E"][0], [-2.349, -5.457, -9.285], rtol=1e-9)


def test_table_6_gives_centimetre_ruts_that_grow_with_slip_and_pressure() -> None:
    pressure = np.array([106.6, 178.2, 106.6, 178.2])
    slip = np.array([0.0, 0.0, 0.2, 0.2])
    conditions = {"average_ground_pressure_kpa": pressure, "slip_ratio": slip}
    bound = MODELS["modified_bekker"].bind(conditions)
    theta = bound.theta({"n0": 1.996, "n1": 1.266, "k": 3.306e5})
    # By hand: ln(106.6/330600) = -8.0396; over 1.996 it is -4.0278, or 17.81 mm; and so on.
    np.testing.assert_allclose(
        bound.predict(theta, conditions)[0], [17.81, 23.04, 28.03, 35.23], rtol=3e-4
    )


def test_table_1_gives_plausible_densities_with_a_negative_exponent_only() -> None:
    conditions = {
        "cone_index_kpa": np.array([500.0, 1500.0]),
        "gravimetric_water_content": np.array([0.05, 0.05]),
    }
    bound = MODELS["ayers_perumpral"].bind(conditions)
    printed = {"C2": 0.022, "C3": 0.609, "C4": 42.996}
    theta = bound.theta(printed | {"C1": 5.934e-10})
    # Eq 1: (500/5.934e-10 x (0.022 + 0.559^2))^(1/42.996) = 1.846, and so on.
    by_hand = [math.exp((math.log(ci / 5.934e-10) + math.log(0.022 + 0.559**2)) / 42.996)
               for ci in (500.0, 1500.0)]  # fmt: skip
    np.testing.assert_allclose(bound.predict(theta, conditions)[0], by_hand, rtol=1e-9)
    assert 1.8 < by_hand[0] < by_hand[1] < 1.95
    wrong_sign = bound.theta(printed | {"C1": 5.934e10})
    assert np.all(bound.predict(wrong_sign, conditions) < 0.7)


def test_a_rut_depth_carries_the_pressure_that_made_it() -> None:
    """p = k z^(n0 + n1 s), and a metre at p = k whatever the exponent."""
    slip = np.array([0.0, 0.1, 0.2])
    z = rut_depth(np.array([60.0, 120.0, 200.0]), slip, 3.306e5, 1.996, 1.266)
    np.testing.assert_allclose(3.306e5 * z ** (1.996 + 1.266 * slip), [60.0, 120.0, 200.0])
    np.testing.assert_allclose(rut_depth(np.full(3, 80.0), slip, 80.0, 1.2, 0.7), 1.0)


def test_a_rut_whose_exponent_is_not_positive_has_no_value() -> None:
    """n0 + n1 s is 0.5, 0 and -0.5: at 0 the limit would be no rut or one without end."""
    conditions = {
        "average_ground_pressure_kpa": np.array([100.0, 150.0, 200.0]),
        "slip_ratio": np.array([0.0, 0.25, 0.5]),
    }
    bound = MODELS["modified_bekker"].bind(conditions)
    found = bound.predict(np.array([[20.0, 0.5, -2.0]]), conditions)
    np.testing.assert_array_equal(np.isfinite(found), [[True, False, False]])
    assert np.isnan(found[0, 1:]).all()
    # The least exponent is zero.
    assert np.isnan(bound.predict(np.array([[20.0, 1.0, -2.0]]), conditions)[0, 2])
