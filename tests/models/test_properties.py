"""What the equations must do whatever the parameters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import i1, modstruve

from calib.errors import CalibError
from calib.models import MODELS, Array, BoundModel, Conditions, Model
from calib.models.traction import mobilised
from tests.models.ranges import THETA, draw

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=30, deadline=None)


@FEW
@given(seed=SEEDS)
def test_the_magic_formula_peaks_at_its_peak_factor_and_is_odd(seed: int) -> None:
    bound, theta, _ = draw(seed, "magic_formula")
    theta[:, 4:] = 0.0
    theta[:, 1] = np.maximum(theta[:, 1], 1.05)  # at C = 1 the peak lies at infinite slip
    slip = np.append(0.0, np.geomspace(1e-5, 1e3, 20_001))
    curve = bound.predict(theta, {"slip_ratio": slip})
    D = theta[:, 2]
    assert np.all(curve[:, 0] == 0.0)
    assert np.all(curve <= D[:, None] * (1.0 + 1e-12))
    # Neighbours on the grid differ by a thousandth in slip; the peak is quadratic in that. With
    # a large G the argument of the sine moves by about 3 G times as much: 1e-3 x 60 squared.
    np.testing.assert_allclose(curve.max(axis=1), D, rtol=4e-3)
    mirrored = bound.predict(theta, {"slip_ratio": -slip})
    np.testing.assert_allclose(mirrored, -curve, rtol=1e-12)


@settings(max_examples=60, deadline=None)
@given(low=st.floats(0.01, 5), high=st.floats(0.01, 5), bend=st.floats(-4, 4))
def test_a_quadratic_must_be_positive_between_the_end_pressures(
    low: float, high: float, bend: float
) -> None:
    """A dense grid decides, except within its own resolution of zero."""
    bound, theta, _ = draw(1, "magic_formula_pressure", k=1)
    names = bound.model.parameters
    for name, value in (("D_lo", low), ("D_hi", high), ("D_bend", bend)):
        theta[0, names.index(name)] = value
    theta[0, names.index("K_bend")] = theta[0, names.index("G_bend")] = 0.0
    u = np.linspace(-1.0, 1.0, 2001)
    mean = 0.5 * (low + high)
    lowest = (mean + 0.5 * (high - low) * u + bend * mean * (u * u - 1.0)).min()
    slip = {"slip_ratio": np.array([0.1]), "inflation_pressure_psi": np.array([18.0])}
    defined = bool(np.isfinite(bound.predict(theta, slip)).all())
    # Between points 1e-3 apart a quadratic falls by at most curvature x (5e-4)^2.
    margin = 4.0 * abs(bend) * mean * 2.5e-7
    if lowest > margin:
        assert defined
    elif lowest < 0.0:
        assert not defined


@pytest.mark.parametrize("name", ["K_lo", "K_hi", "D_lo", "D_hi", "G_lo", "G_hi"])
def test_negative_ends_have_no_value(name: str) -> None:
    bound, theta, conditions = draw(2, "magic_formula_pressure", k=2)
    theta[1, bound.model.parameters.index(name)] = -0.1
    location = bound.mean_response(theta, conditions)
    assert np.isfinite(location[0]).all()
    assert np.isnan(location[1]).all()


def test_extrapolation_to_a_negative_peak_has_no_value() -> None:
    bound, theta, _ = draw(3, "magic_formula_pressure", k=1)
    names = bound.model.parameters
    theta[0, [names.index("D_lo"), names.index("D_hi"), names.index("D_bend")]] = 2.0, 0.2, 0.0
    conditions = {"slip_ratio": np.full(2, 0.1), "inflation_pressure_psi": np.array([42.0, 60.0])}
    location = bound.mean_response(theta, conditions)[0]
    assert np.isfinite(location[0])
    assert np.isnan(location[1])


def test_one_pressure_cannot_bind_the_pressure_model() -> None:
    conditions = {"slip_ratio": np.array([0.1, 0.2]), "inflation_pressure_psi": np.full(2, 30.0)}
    with pytest.raises(CalibError, match="one inflation pressure only") as caught:
        MODELS["magic_formula_pressure"].bind(conditions)
    assert "inflation_pressure" in str(caught.value)
    assert "fit the model magic_formula" in str(caught.value)


@FEW
@given(seed=SEEDS)
def test_the_two_density_relations_agree_at_their_common_water(seed: int) -> None:
    """Eq 2 with theta_v = theta_g gamma is Eq 1 with A1 = C1, A2 = C4, A3 = C2, A4 = C3."""
    bound, theta, conditions = draw(seed, "ayers_perumpral")
    gravimetric = bound.predict(theta, conditions)
    reported = bound.report(theta)
    for i in range(theta.shape[0]):
        A2, A3, A4 = float(theta[i, 3]), float(theta[i, 1]), float(theta[i, 2])
        volume_water = conditions["gravimetric_water_content"] * gravimetric[i]
        ln_density = np.linspace(np.log(0.1), np.log(5.0), 4000)[:, None]
        offset = volume_water * np.exp(-ln_density) - A4
        if np.any(np.diff(A2 * ln_density - np.log(A3 + offset**2), axis=0) <= 0.0):
            continue  # the implicit equation may then have several roots
        other = MODELS["ayers_perumpral_volumetric"].bind(
            {"cone_index_kpa": conditions["cone_index_kpa"],
             "volumetric_water_content": volume_water}
        )  # fmt: skip
        named = {"A1": "C1", "A2": "C4", "A3": "C2", "A4": "C3"}
        vector = other.theta({a: float(reported[c][i]) for a, c in named.items()})
        found = other.predict(
            vector,
            {"cone_index_kpa": conditions["cone_index_kpa"],
             "volumetric_water_content": volume_water},
        )[0]  # fmt: skip
        np.testing.assert_allclose(found, gravimetric[i], rtol=1e-9)


def test_a_density_does_not_depend_on_the_vectors_beside_it() -> None:
    """Not even where the equation has several roots, of which one is returned."""
    bound, theta, conditions = draw(11, "ayers_perumpral_volumetric", k=100, n=5)
    theta[:, 1] = 3.0  # a small A2 gives several roots
    together = bound.predict(theta, conditions)
    alone = np.concatenate([bound.predict(row[None], conditions) for row in theta])
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_a_density_just_outside_the_bracket_has_none_either() -> None:
    bound, theta, _ = draw(1, "ayers_perumpral_volumetric")
    p = {name: v[0] for name, v in bound.report(theta).items()}
    density = np.array([0.0999, 0.1001, 4.99, 5.01, 0.09, 6.0])
    water = np.full(density.size, 0.1)
    index = p["A1"] * density ** p["A2"] / (p["A3"] + (water / density - p["A4"]) ** 2)
    at = {"cone_index_kpa": index, "volumetric_water_content": water}
    found = bound.predict(theta[:1], at)[0]
    np.testing.assert_allclose(found[1:3], density[1:3], rtol=1e-9)
    assert np.isnan(found[[0, 3, 4, 5]]).all()


def test_the_implicit_solver_handles_thousands_of_vectors_at_once() -> None:
    bound, theta, conditions = draw(6, "ayers_perumpral_volumetric", k=1000, n=7)
    density = bound.predict(theta, conditions)
    assert density.shape == (1000, 7)
    A2, A3, A4 = (theta[:, j, None] for j in (1, 2, 3))
    ln_a1 = np.log(bound.report(theta)["A1"])[:, None]
    water = conditions["volumetric_water_content"] / density
    index = ln_a1 + A2 * np.log(density) - np.log(A3 + (water - A4) ** 2)
    residual = index - np.log(conditions["cone_index_kpa"])
    # Newton stops at steps below 1e-13 in ln(density); A2 up to 45 amplifies that.
    defined = np.isfinite(density)
    assert np.abs(residual[defined]).max() < 1e-10
    # Only densities beyond 0.1 to 5 g/cm3 are left out; in these ranges, almost none.
    assert defined.mean() > 0.99


@FEW
@given(seed=SEEDS)
def test_upadhyayas_form_at_no_slip_at_a_fifth_and_at_its_limit(seed: int) -> None:
    bound, theta, conditions = draw(seed, "upadhyaya", n=3)
    conditions["slip_ratio"] = np.array([0.0, 0.2, 1e4])
    coefficient = bound.predict(theta, conditions) / conditions["normal_load_kn"]
    p20, r, _ = theta.T
    a = bound.report(theta)["a"]
    np.testing.assert_allclose(coefficient, np.stack([-r, p20, a], axis=1), rtol=1e-12)


def test_the_mobilised_part_of_an_elliptic_contact_is_bessel_and_struve() -> None:
    q = np.geomspace(1e-3, 8.0, 40)
    bessel = 1.0 - 2.0 / q * (i1(q) - modstruve(1, q))
    np.testing.assert_allclose(mobilised(q), bessel, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(mobilised(-q), -mobilised(q), rtol=1e-15)
    # Half of the mean chord, 4/(3 pi) of the length, is what the soil is sheared by at first.
    np.testing.assert_allclose(mobilised(np.array([1e-6])) / 1e-6, 4.0 / (3.0 * np.pi), rtol=1e-5)
    # Far out all but the edge: no jump where the series takes over, and nothing below it.
    far = np.linspace(30.0, 40.0, 2001)
    slope = np.diff(mobilised(far)) / np.diff(far)
    expected = 4.0 / np.pi / (0.5 * (far[1:] + far[:-1])) ** 2
    np.testing.assert_allclose(slope, expected, rtol=0.01)
    np.testing.assert_allclose(mobilised(np.array([1e6])), 1.0 - 4e-6 / np.pi, rtol=1e-12)


@FEW
@given(seed=SEEDS)
def test_maclaurins_ruts_are_z_ref_at_the_means_and_scale_with_the_tyre(seed: int) -> None:
    bound, theta, conditions = draw(seed, "maclaurin_rut")
    bound = bound.model.bind(conditions)
    means = {c: np.exp(np.log(v).mean(keepdims=True)) for c, v in conditions.items()}
    np.testing.assert_allclose(bound.predict(theta, means)[:, 0], theta[:, 0], rtol=1e-12)
    # At the same mobility number, on twice the tyre: twice as deep.
    large = {
        c: v * {"cone_index_kpa": 1.0, "normal_load_kn": 4.0}.get(c, 2.0)
        for c, v in conditions.items()
    }
    ratio = bound.predict(theta, large) / bound.predict(theta, conditions)
    np.testing.assert_allclose(ratio, 2.0, rtol=1e-9)


def test_every_model_has_a_range_to_be_tested_over() -> None:
    assert {name: set(r) for name, r in THETA.items()} == {
        name: set(model.parameters) for name, model in MODELS.items()
    }


def test_a_slow_equation_is_evaluated_once_for_equal_vectors() -> None:
    asked: list[int] = []

    def predict(theta: Array, at: Conditions) -> Array:
        asked.append(len(theta))
        return theta[:, :1] * at["slip_ratio"]

    model = Model(
        name="asked", title="", output="drawbar_pull_kn", conditions=("slip_ratio",),
        parameters=("a",), predict=predict, slow=True,
    )  # fmt: skip
    theta, slip = np.array([[3.0], [1.0], [3.0], [2.0], [1.0]]), np.array([0.1, 0.2])
    bound = BoundModel(model, {})
    np.testing.assert_allclose(bound.mean_response(theta, {"slip_ratio": slip}), theta * slip)
    assert asked == [3]
    # Conditions of each vector's own: the first and third differ now.
    own = slip * np.array([[1.0], [1.0], [2.0], [1.0], [1.0]])
    np.testing.assert_allclose(bound.mean_response(theta, {"slip_ratio": own}), theta * own)
    assert max(asked[1:]) == 4
