"""Signs: the verdict follows the figure, and would be another for another sign."""

from __future__ import annotations

import numpy as np
import pytest

from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.pull import sign_of_curvature, signs_of_pull, signs_of_quadratic
from calib.he2019.audit.regressions import signs_of_rut
from calib.he2019.published import PUBLISHED
from tests.he2019.audit.altered import altered, flipped

STRONG = [("geometric", 18), ("geometric", 30), ("geometric", 42), ("genetic", 30), ("genetic", 42)]


def table_of(published, which, psi):
    return getattr(published, which)[psi]


@pytest.mark.parametrize(("which", "psi"), STRONG)
def test_E_is_negative_where_the_other_sign_has_no_peak(which, psi):
    table = table_of(PUBLISHED, which, psi)
    found = sign_of_curvature(table)
    assert found.verdict is Verdict.CONFIRMED
    assert not found.reconstructed
    wrong = flipped(f"{table.source}: E")
    assert sign_of_curvature(table_of(wrong, which, psi)).verdict is Verdict.CONTRADICTED


def test_at_18_psi_both_signs_of_table_4_have_a_peak():
    found = sign_of_curvature(PUBLISHED.genetic[18])
    assert found.verdict is Verdict.CONSISTENT
    wrong = flipped("Table 4, 18 psi: E").genetic[18]
    assert sign_of_curvature(wrong).verdict is Verdict.CONSISTENT
    large = altered({"Table 4, 18 psi: E": "-6.1026"}).genetic[18]
    assert sign_of_curvature(large).verdict is Verdict.CONFIRMED


def test_a_peak_beyond_the_tested_slips_contradicts():
    slow = altered({"Table 4, 18 psi: B": "0.0194"}).genetic[18]
    assert sign_of_curvature(slow).verdict is Verdict.CONTRADICTED


def test_the_peak_of_table_3_at_18_psi():
    (peak, _) = sign_of_curvature(PUBLISHED.geometric[18]).found
    # Independent: the slip of the largest value on a fine grid.
    v = PUBLISHED.geometric[18].values
    x = np.linspace(0.0, 30.0, 300_001)
    u = v["B"] * x
    y = np.sin(v["C"] * np.arctan(u - v["E"] * (u - np.arctan(u))))
    assert peak.lower <= x[y.argmax()] <= peak.upper


@pytest.mark.parametrize("what", ["D", "BCD"])
def test_only_one_reading_of_three_signs_is_near_table_4(what):
    names = {"D": ("c1", "c2", "c3"), "BCD": ("c4", "c5", "c6")}[what]
    assert signs_of_quadratic(PUBLISHED, what).verdict is Verdict.CONFIRMED
    for name in names:
        wrong = flipped(f"Table 5: {name}")
        assert signs_of_quadratic(wrong, what).verdict is Verdict.CORRECTED


def test_no_reading_is_near_if_the_size_is_wrong():
    wrong = altered({"Table 5: c1": "32.72"})
    assert signs_of_quadratic(wrong, "D").verdict is Verdict.CONTRADICTED


def test_signs_of_the_rut_model():
    assert signs_of_rut(PUBLISHED).verdict is Verdict.CONFIRMED
    assert signs_of_rut(flipped("Table 6: n1")).verdict is Verdict.CONTRADICTED
    assert signs_of_rut(altered({"Table 6: k": "3.306e-5"})).verdict is Verdict.CONTRADICTED


def test_every_sign_is_judged_once():
    keys = [f.key for f in (*signs_of_pull(PUBLISHED), signs_of_rut(PUBLISHED))]
    assert len(keys) == len(set(keys)) == 9
