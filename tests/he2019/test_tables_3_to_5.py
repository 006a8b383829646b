"""Tables 3 to 5: the verdict follows the figure, and would be another for another figure."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from calib.he2019.audit.bounds import ASSUMED_SLIPS, NAMES
from calib.he2019.audit.finding import Basis, Verdict
from calib.he2019.audit.table5 import (
    Bounds,
    cost_as_printed,
    cost_bounds,
    joint_cost,
    nearest,
    pressure_unit,
    rounding_findings,
    signs_of_quadratic,
    study_rounding,
    targets,
)
from calib.he2019.audit.tables_1_to_4 import (
    chord_curvature,
    features,
    geometric_findings,
    sign_of_curvature,
)
from calib.he2019.embedded import tables
from calib.he2019.estimators import Features, coefficients
from calib.he2019.published import PUBLISHED
from calib.he2019.reconstruction import magic_formula_jacobian
from calib.models.magic_formula import magic_formula
from tests.he2019.altered import altered, flipped


def judged(published):
    return {f.key: f for f in geometric_findings(published)}


def test_features_are_the_inverse_of_eqs_6_to_9():
    for table in PUBLISHED.geometric.values():
        f = features(table)
        back = coefficients(
            Features(float(f.slope.middle), float(f.x_peak.middle), table.values["D"],
                     float(f.asymptote.middle))
        )  # fmt: skip
        for name, value in zip("BCD", back[:3], strict=True):
            assert value == pytest.approx(table.values[name], rel=1e-4)
        assert pytest.approx(table.values["E"], rel=0.02) == back.E


def test_the_chord_gives_the_E_of_eq_9():
    for C in (1.3, 1.4743, 1.5664, 1.7):
        asymptote = np.sin(0.5 * np.pi * (2.0 - C))
        read = coefficients(Features(1.0 / 8.0, 8.0, 1.0, asymptote))
        assert chord_curvature(C) == pytest.approx(read.E, rel=1e-9)


def test_a_slope_like_table_4_would_be_confirmed():
    changes = {}
    for psi, table in PUBLISHED.geometric.items():
        v, fitted = table.values, PUBLISHED.genetic[psi].values
        B = fitted["B"] * fitted["C"] * fitted["D"] / (v["C"] * v["D"])
        changes[f"Table 3, {psi} psi: B"] = f"{B:.4f}"
    assert judged(altered(changes))["table3_initial_slope"].verdict is Verdict.CONFIRMED


@pytest.mark.parametrize(
    ("figure", "text", "key", "verdict"),
    [
        # A flatter curvature factor puts the peak where the chord is no longer BCD.
        ("E", "-3.1235", "table3_initial_slope", Verdict.CONTRADICTED),
        ("E", "-8.1655", "table3_curvature", Verdict.CONSISTENT),
        ("E", "15.1235", "table3_features", Verdict.CONTRADICTED),
        # Below Table 4's, where the optimum would not be one; or beyond what its curve can cost.
        ("cost", "0.0400", "table3_costs", Verdict.CONTRADICTED),
        ("cost", "0.9000", "table3_costs", Verdict.CONTRADICTED),
    ],
)
def test_another_figure_of_table_3_would_be_judged_otherwise(figure, text, key, verdict):
    assert judged(altered({f"Table 3, 18 psi: {figure}": text}))[key].verdict is verdict


STRONG = [("geometric", 18), ("geometric", 30), ("geometric", 42), ("genetic", 30), ("genetic", 42)]


@pytest.mark.parametrize(("which", "psi"), STRONG)
def test_E_is_negative_where_the_other_sign_has_no_peak(which, psi):
    table = getattr(PUBLISHED, which)[psi]
    found = sign_of_curvature(table)
    assert found.verdict is Verdict.CONFIRMED
    assert not found.reconstructed
    wrong = flipped(f"{table.source}: E")
    assert sign_of_curvature(getattr(wrong, which)[psi]).verdict is Verdict.CONTRADICTED


def test_at_18_psi_both_signs_of_table_4_have_a_peak():
    found = sign_of_curvature(PUBLISHED.genetic[18])
    assert found.verdict is Verdict.CONSISTENT
    wrong = flipped("Table 4, 18 psi: E").genetic[18]
    assert sign_of_curvature(wrong).verdict is Verdict.CONSISTENT
    large = altered({"Table 4, 18 psi: E": "-6.1026"}).genetic[18]
    assert sign_of_curvature(large).verdict is Verdict.CONFIRMED
    beyond = altered({"Table 4, 18 psi: B": "0.0194"}).genetic[18]
    assert sign_of_curvature(beyond).verdict is Verdict.CONTRADICTED


@pytest.mark.parametrize("what", ["D", "BCD"])
def test_only_one_reading_of_three_signs_is_near_table_4(what):
    names = {"D": ("c1", "c2", "c3"), "BCD": ("c4", "c5", "c6")}[what]
    assert signs_of_quadratic(PUBLISHED, what).verdict is Verdict.CONFIRMED
    for name in names:
        wrong = flipped(f"Table 5: {name}")
        assert signs_of_quadratic(wrong, what).verdict is Verdict.CORRECTED
    large = altered({f"Table 5: {names[0]}": "32.72"})
    assert signs_of_quadratic(large, what).verdict is Verdict.CONTRADICTED


@pytest.mark.parametrize("what", NAMES)
@pytest.mark.parametrize("signs", [(1, -1, 1), (1, 1, -1), (-1, -1, -1)])
def test_no_coefficients_of_the_box_come_nearer(what, signs):
    figures = [PUBLISHED.pressure.estimates[name] for name in NAMES[what]]
    pressures, wanted = targets(PUBLISHED, what)
    axes = [
        np.linspace(s * abs(f.value) - f.half_unit, s * abs(f.value) + f.half_unit, 31)
        for s, f in zip(signs, figures, strict=True)
    ]
    c = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = c @ np.vander(pressures, 3, increasing=True).T
    deviation = np.abs(values / np.abs(wanted) - np.sign(wanted)).max(axis=1)
    least, coefficients = nearest(PUBLISHED, what, signs=signs)
    assert least <= deviation.min() + 1e-12
    # It is attained: by its own coefficients, which lie in the box.
    values = np.vander(pressures, 3, increasing=True) @ coefficients
    own = np.abs(values / np.abs(wanted) - np.sign(wanted)).max()
    assert own == pytest.approx(least, rel=1e-9, abs=1e-12)
    for x, axis in zip(coefficients, axes, strict=True):
        assert axis[0] - 1e-12 <= x <= axis[-1] + 1e-12


def in_table_5(digits: int, unit: float = 1.0, whats: tuple[str, ...] = tuple(NAMES)):
    """Print Table 5 as the quadratics through Table 4, pressure in units of so many psi."""
    changes = {"Table 5: b0": "1.55400000"}
    for what in whats:
        pressures, wanted = targets(PUBLISHED, what)
        c = np.linalg.solve(np.vander(pressures / unit, 3, increasing=True), wanted)
        for name, value in zip(NAMES[what], c, strict=True):
            changes[f"Table 5: {name}"] = f"{value:.{digits - 1}e}"
    return altered(changes)


def test_the_declared_unit_is_corrected():
    found = pressure_unit(PUBLISHED)
    assert found.verdict is Verdict.CORRECTED
    by_unit = {q.name.split()[-1]: q.value for q in found.found}
    assert by_unit["psi"] < 20.0
    assert min(by_unit["kPa"], by_unit["bar"]) > 100.0
    assert "In psi" in found.evidence


def test_a_table_in_kPa_is_confirmed():
    found = pressure_unit(in_table_5(5, 1.0 / 6.894757, ("D", "BCD")))
    assert found.verdict is Verdict.CONFIRMED
    assert "In kPa" in found.evidence


@pytest.mark.parametrize("name", ["c1", "c4"])
def test_a_table_in_no_unit_is_contradicted(name):
    value = 100.0 * PUBLISHED.pressure.estimates[name].value
    wrong = altered({f"Table 5: {name}": f"{value:.1f}"})
    assert pressure_unit(wrong).verdict is Verdict.CONTRADICTED


TABLES = PUBLISHED.genetic.values()


def joint_optimum(slips, pulls) -> float:
    """Fit one C and B, D, E of each pressure: Eqs 12-15 through three pressures."""
    start = np.concatenate([[1.56], *([t.values[n] for n in "BDE"] for t in TABLES)])

    def residuals(t):
        each = zip(t[1:].reshape(3, 3), slips, pulls, strict=True)
        return np.concatenate([magic_formula(x, B, t[0], D, E) - y for (B, D, E), x, y in each])

    found = least_squares(residuals, start, x_scale="jac", max_nfev=400)
    return 2.0 * float(found.cost)


@pytest.fixture(scope="module")
def at_most() -> Bounds:
    return cost_bounds(PUBLISHED)


def test_the_printed_cost_is_not_a_minimum(at_most):
    found = joint_cost(PUBLISHED, 0.0709, at_most)
    assert found.verdict is Verdict.CONTRADICTED
    assert found.basis is Basis.PRINTED
    assert at_most.anywhere < 0.10495


@pytest.mark.parametrize(
    ("cost", "verdict", "basis"),
    [
        ("0.0700", Verdict.CONSISTENT, Basis.SLIPS),
        ("0.0950", Verdict.CONTRADICTED, Basis.SLIPS),
        ("0.0500", Verdict.CONTRADICTED, Basis.PRINTED),
        ("0.1500", Verdict.CONTRADICTED, Basis.PRINTED),
    ],
)
def test_another_cost_would_be_judged_otherwise(cost, verdict, basis, at_most):
    # The bounds follow from Table 4 alone.
    found = joint_cost(altered({"Table 5: cost": cost}), 0.0709, at_most)
    assert (found.verdict, found.basis) == (verdict, basis)


@pytest.mark.parametrize("seed", range(5))
def test_simulated_data_at_any_slips_have_their_optimum_below_the_bound(seed, at_most):
    rng = np.random.default_rng(seed)
    slips, pulls = [], []
    for table in TABLES:
        # Any 14 slips 1 % apart: kinder and crueller designs than the assumed one.
        x = np.sort(rng.choice(np.arange(1, 75), 14, replace=False)) + rng.uniform(0.0, 0.5)
        errors = rng.standard_normal(14) + rng.choice([0.0, 2.0]) * np.sign(x - np.median(x))
        errors *= np.sqrt(table.quality["cost"].value) / np.linalg.norm(errors)
        slips.append(x)
        pulls.append(magic_formula(x, **table.values) + errors)
    assert joint_optimum(slips, pulls) <= at_most.anywhere


@pytest.mark.parametrize("optimal", [False, True])
def test_simulated_data_at_the_assumed_slips(optimal, at_most):
    rng = np.random.default_rng(5)
    bound = at_most.optimal if optimal else at_most.assumed
    for _ in range(4):
        pulls = []
        for table in TABLES:
            errors = rng.standard_normal(ASSUMED_SLIPS.size)
            if optimal:
                q, _ = np.linalg.qr(magic_formula_jacobian(ASSUMED_SLIPS, **table.values))
                errors -= q @ (q.T @ errors)
            errors *= np.sqrt(table.quality["cost"].value) / np.linalg.norm(errors)
            pulls.append(magic_formula(ASSUMED_SLIPS, **table.values) + errors)
        assert joint_optimum([ASSUMED_SLIPS] * 3, pulls) <= bound


def test_the_reconstructed_optimum_obeys_all_bounds(at_most):
    pulls = tables()["drawbar_pull"]["drawbar_pull_kn"].reshape(3, -1)
    optimum = joint_optimum([ASSUMED_SLIPS] * 3, pulls)
    assert optimum == pytest.approx(0.0709, abs=5e-5)
    assert optimum < at_most.optimal < at_most.assumed < at_most.anywhere


def test_the_digits_as_they_stand_cost_more_than_is_printed():
    assert cost_as_printed(PUBLISHED).verdict is Verdict.CONTRADICTED
    # Were their own cost printed, it would be possible.
    assert cost_as_printed(altered({"Table 5: cost": "0.40"})).verdict is Verdict.CONSISTENT


def rounded(published):
    return {f.key: f for f in rounding_findings(published, study_rounding(published, 31))}


def test_D_at_42_psi_by_hand():
    found = {q.name: q for q in rounded(PUBLISHED)["table5_digits_of_D"].found}["D at 42 psi"]
    assert found.value == pytest.approx(3.272 - 0.107 * 42 + 0.001 * 42**2)
    half = 0.0005 + 0.0005 * 42 + 0.0005 * 42**2
    assert found.lower == pytest.approx(found.value - half, abs=1e-9)
    assert found.upper == pytest.approx(found.value + half, abs=1e-9)
    assert found.published == "0.5954 (Table 4)"


def test_with_more_digits_the_verdicts_change():
    found = rounded(in_table_5(9))
    assert found["table5_digits_of_D"].verdict is Verdict.CONFIRMED
    assert found["table5_digits_of_BCD_and_E"].verdict is Verdict.CONFIRMED
    assert found["table5_digits_of_pull"].verdict is Verdict.CONFIRMED


@pytest.mark.parametrize(
    ("where", "text", "key", "verdict"),
    [
        ("Table 5: c1", "4.272", "table5_digits_of_D", Verdict.CONTRADICTED),
        ("Table 5: b0", "1.654", "table5_b0", Verdict.CONTRADICTED),
        ("Table 4, 42 psi: D", "0.6", "table4_digits", Verdict.CORRECTED),
    ],
)
def test_other_digits_would_be_judged_otherwise(where, text, key, verdict):
    assert rounded(altered({where: text}))[key].verdict is verdict
