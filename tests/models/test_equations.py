"""Each model against its equation written again, one number at a time, from published parameters.

Tolerances: two routes to the same double-precision number differ by rounding, amplified by the
exponents (up to about 50) and by arguments of sin up to 2 pi: 1e-9 is generous to both.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from calib.errors import CalibError
from calib.models import MODELS, get_model
from tests.models.ranges import CONDITIONS, draw

CLOSE = {"rtol": 1e-9, "atol": 1e-12}
SEEDS = st.integers(0, 2**32 - 1)


def pull(x: float, B: float, C: float, D: float, E: float, Sh: float = 0.0, Sv: float = 0.0):
    bx = B * (x - Sh)
    return Sv + D * math.sin(C * math.atan(bx - E * (bx - math.atan(bx))))


def scalar_magic_formula(p, c):
    return pull(100.0 * c["slip_ratio"], p["B"], p["C"], p["D"], p["E"], p["Sh"], p["Sv"])


def scalar_magic_formula_pressure(p, c):
    psi = c["inflation_pressure_psi"]
    C = p["b0"]
    D = p["c1"] + p["c2"] * psi + p["c3"] * psi**2
    B = (p["c4"] + p["c5"] * psi + p["c6"] * psi**2) / (C * D)
    E = p["c7"] + p["c8"] * psi + p["c9"] * psi**2
    return pull(100.0 * c["slip_ratio"], B, C, D, E)


def scalar_bekker(p, c):
    return 1000.0 * (c["average_ground_pressure_kpa"] / p["k"]) ** (1.0 / p["n"])


def scalar_modified_bekker(p, c):
    exponent = p["n0"] + p["n1"] * c["slip_ratio"]
    return 1000.0 * (c["average_ground_pressure_kpa"] / p["k"]) ** (1.0 / exponent)


def scalar_ayers_perumpral(p, c):
    water = c["gravimetric_water_content"]
    return (c["cone_index_kpa"] / p["C1"] * (p["C2"] + (water - p["C3"]) ** 2)) ** (1.0 / p["C4"])


def scalar_ayers_perumpral_volumetric(p, c):
    def excess(gamma: float) -> float:
        dryness = p["A3"] + (c["volumetric_water_content"] / gamma - p["A4"]) ** 2
        index = math.log(p["A1"]) + p["A2"] * math.log(gamma) - math.log(dryness)
        return index - math.log(c["cone_index_kpa"])

    return brentq(excess, 0.1, 5.0, xtol=1e-14, rtol=1e-14)


def scalar_bekker_plate(p, c):
    modulus = p["kc"] / (c["plate_width_mm"] / 1000.0) + p["kphi"]
    return 1000.0 * (c["average_ground_pressure_kpa"] / modulus) ** (1.0 / p["n"])


def scalar_reece(p, c):
    width = c["plate_width_mm"] / 1000.0
    modulus = p["k1"] + p["k2"] * width
    return 1000.0 * width * (c["average_ground_pressure_kpa"] / modulus) ** (1.0 / p["n"])


def scalar_lyasko(p, c):
    s = c["slip_ratio"]
    standing = 1000.0 * (c["average_ground_pressure_kpa"] / p["k"]) ** (1.0 / p["n"])
    return standing * (1.0 + s) / (1.0 - p["a"] * s)


def numeric(c):
    return c["cone_index_kpa"] * c["tyre_width_m"] * c["tyre_diameter_m"] / c["normal_load_kn"]


def scalar_wismer_luth(p, c):
    cn = numeric(c)
    gross = p["c1"] * (1.0 - math.exp(-p["c2"] * cn * c["slip_ratio"]))
    return c["normal_load_kn"] * (gross - (p["c3"] / cn + p["c4"]))


def scalar_brixius(p, c):
    """Gross traction and motion resistance apart, each with the 0.04 of the source."""
    s = c["slip_ratio"]
    bn = numeric(c) * (1.0 + 5.0 * c["tyre_deflection_mm"] / c["section_height_mm"])
    bn /= 1.0 + 3.0 * c["tyre_width_m"] / c["tyre_diameter_m"]
    gross = p["c1"] * (1.0 - math.exp(-p["c2"] * bn)) * (1.0 - math.exp(-p["c3"] * s)) + 0.04
    resistance = p["c4"] / bn + 0.04 + p["c5"] * s / math.sqrt(bn)
    return c["normal_load_kn"] * (gross - resistance)


def scalar_upadhyaya(p, c):
    return c["normal_load_kn"] * p["a"] * (1.0 - p["b"] * math.exp(-p["c"] * c["slip_ratio"]))


def scalar_maclaurin_rut(p, c):
    b, d = c["tyre_width_m"], c["tyre_diameter_m"]
    area = (b * d) ** (1.0 - p["q"] / 2.0) * (c["tyre_deflection_mm"] / 1000.0) ** p["q"]
    number = c["cone_index_kpa"] * area / c["normal_load_kn"]
    return 1000.0 * p["k"] * d / number ** p["m"]


def scalar_elliptic_contact(p, c):
    """The stress added up over the ellipse: along chords in closed form, across them by Gauss."""
    half_length = c["contact_length_mm"] / 2000.0
    half_width = c["contact_width_mm"] / 2000.0
    pressure = c["normal_load_kn"] / (math.pi * half_length * half_width)
    strength = p["c"] + pressure * math.tan(math.radians(p["phi"]))
    slip, K = abs(c["slip_ratio"]), p["K"] / 1000.0

    def along(y: float) -> float:
        chord = 2.0 * half_length * math.sqrt(1.0 - (y / half_width) ** 2)
        if slip == 0.0:
            return 0.0
        return strength * (chord + K / slip * math.expm1(-slip * chord / K))

    # In the angle about the centre chords end smoothly.
    thrust = quad(
        lambda t: along(half_width * math.sin(t)) * half_width * math.cos(t),
        -math.pi / 2.0, math.pi / 2.0, epsabs=0.0, epsrel=1e-12,
    )[0]  # fmt: skip
    return math.copysign(thrust, c["slip_ratio"]) - p["rho"] * c["normal_load_kn"]


def scalar_janosi_hanamoto(p, c):
    strength = p["c"] + c["normal_stress_kpa"] * math.tan(math.radians(p["phi"]))
    return strength * (1.0 - math.exp(-c["shear_displacement_mm"] / p["K"]))


SCALAR = {
    "bekker_plate": scalar_bekker_plate,
    "reece": scalar_reece,
    "reece_plate": scalar_reece,
    "lyasko": scalar_lyasko,
    "wismer_luth": scalar_wismer_luth,
    "brixius": scalar_brixius,
    "upadhyaya": scalar_upadhyaya,
    "maclaurin_rut": scalar_maclaurin_rut,
    "elliptic_contact": scalar_elliptic_contact,
    "janosi_hanamoto": scalar_janosi_hanamoto,
    "magic_formula": scalar_magic_formula,
    "magic_formula_pressure": scalar_magic_formula_pressure,
    "bekker": scalar_bekker,
    "modified_bekker": scalar_modified_bekker,
    "ayers_perumpral": scalar_ayers_perumpral,
    "ayers_perumpral_volumetric": scalar_ayers_perumpral_volumetric,
}


# The rigid wheel has its own test beside the quadrature, to the accuracy of that.
@pytest.mark.parametrize("name", [m for m in MODELS if "wong_reece" not in m])
@settings(max_examples=25, deadline=None)
@given(seed=SEEDS)
def test_a_model_is_its_published_equation(name: str, seed: int) -> None:
    bound, theta, conditions = draw(seed, name)
    predicted = bound.predict(theta, conditions)
    reported = bound.report(theta)
    assert predicted.shape == (3, 5)
    for i in range(3):
        p = {parameter: float(v[i]) for parameter, v in reported.items()}
        expected = [
            SCALAR[name](p, {c: float(v[j]) for c, v in conditions.items()}) for j in range(5)
        ]
        if name == "magic_formula_pressure":  # the monomials cancel: c1 + c2 p + c3 p^2
            np.testing.assert_allclose(predicted[i], expected, rtol=1e-7, atol=1e-7)
        else:
            np.testing.assert_allclose(predicted[i], expected, **CLOSE)


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=15, deadline=None)
@given(seed=SEEDS)
def test_sampled_and_published_parameters_are_equivalent(name: str, seed: int) -> None:
    bound, theta, _ = draw(seed, name)
    for vector in theta:
        reported = {p: float(v[0]) for p, v in bound.report(vector).items()}
        assert set(reported) == set(bound.model.reported)
        np.testing.assert_allclose(bound.theta(reported), vector, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", MODELS)
def test_conditions_may_differ_between_parameter_vectors(name: str) -> None:
    bound, theta, conditions = draw(7, name)
    same = {c: np.tile(v, (3, 1)) for c, v in conditions.items()}
    np.testing.assert_array_equal(bound.predict(theta, same), bound.predict(theta, conditions))
    rng = np.random.default_rng(8)
    own = {c: rng.uniform(*CONDITIONS[c], (3, 5)) for c in conditions}
    together = bound.predict(theta, own)
    for i in range(3):
        alone = bound.predict(theta[i], {c: v[i] for c, v in own.items()})
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-12)


def test_a_pressure_of_its_own_for_every_vector_and_shared_slips() -> None:
    bound, theta, conditions = draw(9, "magic_formula_pressure")
    psi = np.random.default_rng(1).uniform(18.0, 42.0, (3, 5))
    mixed = {"slip_ratio": conditions["slip_ratio"], "inflation_pressure_psi": psi}
    together = bound.predict(theta, mixed)
    for i in range(3):
        alone = bound.predict(theta[i], mixed | {"inflation_pressure_psi": psi[i]})
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_binding_takes_the_references_from_the_data(name: str) -> None:
    _, _, conditions = draw(11, name)
    references = MODELS[name].bind(conditions).references
    geometric = {
        "ci_ref_kpa": "cone_index_kpa", "p_ref_kpa": "average_ground_pressure_kpa",
    }  # fmt: skip
    for reference, column in geometric.items():
        if reference in references:
            product = math.prod(float(v) for v in conditions[column])
            assert references[reference] == pytest.approx(product ** (1 / 5), rel=1e-12)
    if name == "magic_formula_pressure":
        psi = conditions["inflation_pressure_psi"]
        ends = references["p_mid_psi"] + np.array([-1, 1]) * references["p_half_psi"]
        np.testing.assert_allclose(ends, [psi.min(), psi.max()], rtol=1e-12)


def test_a_missing_condition_names_the_model_and_the_column() -> None:
    with pytest.raises(CalibError) as caught:
        MODELS["modified_bekker"].bind({"slip_ratio": np.array([0.1])})
    for word in ("modified_bekker", "average_ground_pressure_kpa", "expected", "hint"):
        assert word in str(caught.value)


def test_an_unknown_model_lists_the_known_ones() -> None:
    with pytest.raises(CalibError, match="no model 'pacejka'") as caught:
        get_model("pacejka")
    assert all(name in str(caught.value) for name in MODELS)
