"""Table 3: its slope, its curvature, its features and its costs."""

from __future__ import annotations

import numpy as np
import pytest

from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.pull import chord_curvature, features, geometric_findings
from calib.he2019.estimators import Features, coefficients
from calib.he2019.published import PUBLISHED
from tests.he2019.audit.altered import altered


def judged(published):
    return {f.key: f for f in geometric_findings(published)}


@pytest.fixture(scope="module")
def as_printed():
    return judged(PUBLISHED)


def test_verdicts(as_printed):
    assert {key: f.verdict for key, f in as_printed.items()} == {
        "table3_features": Verdict.CONSISTENT,
        "table3_initial_slope": Verdict.CORRECTED,
        "table3_curvature": Verdict.CORRECTED,
        "table3_costs": Verdict.CONSISTENT,
    }


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


def test_a_slope_like_neither_is_contradicted():
    # A flatter curvature factor puts the peak where the chord is no longer BCD.
    found = judged(altered({"Table 3, 18 psi: E": "-3.1235"}))
    assert found["table3_initial_slope"].verdict is Verdict.CONTRADICTED


def test_a_curvature_that_the_chord_does_not_give_stands():
    found = judged(altered({"Table 3, 42 psi: E": "-8.1655"}))
    assert found["table3_curvature"].verdict is Verdict.CONSISTENT


def test_without_a_peak_the_features_are_contradicted():
    found = judged(altered({"Table 3, 18 psi: E": "15.1235"}))
    assert found["table3_features"].verdict is Verdict.CONTRADICTED


@pytest.mark.parametrize("cost", ["0.0400", "0.9000"])
def test_costs_that_are_not_possible(cost):
    # Below Table 4's, where the optimum would not be one; or beyond what its curve can cost.
    found = judged(altered({"Table 3, 18 psi: cost": cost}))
    assert found["table3_costs"].verdict is Verdict.CONTRADICTED
