"""Table 1: exponent, sign, unit and quality."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.he2019.audit.bounds import printed
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.regressions import density_findings, density_range
from calib.he2019.published import PUBLISHED
from calib.models.ayers_perumpral import bulk_density
from tests.he2019.audit.altered import altered


def judged(published):
    return {f.key: f for f in density_findings(published)}


def test_verdicts():
    assert {key: f.verdict for key, f in judged(PUBLISHED).items()} == {
        "table1_exponent_of_C1": Verdict.CONFIRMED,
        "table1_sign_of_C3": Verdict.UNTESTABLE,
        "table1_unit_of_cone_index": Verdict.UNTESTABLE,
        "table1_quality": Verdict.CONSISTENT,
        "table1_values": Verdict.UNTESTABLE,
    }


@given(st.lists(st.floats(0, 1), min_size=6, max_size=6))
def test_every_density_lies_in_the_range(shares):
    figures = [printed(PUBLISHED.bulk_density.estimates[n]) for n in ("C1", "C2", "C3", "C4")]
    c = [float(i.lower + s * (i.upper - i.lower)) for i, s in zip(figures, shares, strict=False)]
    index, water = np.array(100.0 + 2900.0 * shares[4]), np.array(0.088 * shares[5])
    assert density_range(PUBLISHED).holds(bulk_density(index, water, *c))


def test_the_range_is_reached_at_its_corners():
    v = PUBLISHED.bulk_density.values
    found = density_range(PUBLISHED)
    low = bulk_density(np.array(100.0), np.array(0.088), **v)
    high = bulk_density(np.array(3000.0), np.array(0.0), **v)
    assert float(found.lower) == pytest.approx(float(low), rel=2e-3)
    assert float(found.upper) == pytest.approx(float(high), rel=2e-3)


def test_the_other_exponent_is_corrected():
    found = judged(altered({"Table 1: C1": "5.934e10"}))["table1_exponent_of_C1"]
    assert found.verdict is Verdict.CORRECTED


def test_an_exponent_that_matters_little_stays_open():
    # With C1 near one both signs of its exponent are alike.
    found = judged(altered({"Table 1: C1": "5.934e-1", "Table 1: C4": "13.2"}))
    assert found["table1_exponent_of_C1"].verdict is Verdict.CONSISTENT


def test_the_other_exponent_could_hold_for_few_samples_only():
    # By brute force: errors of equal size are the smallest largest error that an RMSE allows.
    density, relative, rmse = 0.6621, 0.02945, 0.02815
    possible = [
        n for n in range(5, 200)
        if rmse * np.sqrt((n - 4) / n) <= relative * density / (1.0 - relative)
    ]  # fmt: skip
    evidence = judged(PUBLISHED)["table1_exponent_of_C1"].evidence
    assert f"only with {max(possible)} samples or fewer" in evidence


def test_a_steep_relation_would_show_the_sign_of_C3():
    found = judged(altered({"Table 1: C4": "8.000", "Table 1: C1": "5.934e0"}))
    assert found["table1_sign_of_C3"].verdict is not Verdict.UNTESTABLE


@pytest.mark.parametrize(
    ("C1", "verdict"),
    [("5.934e-13", Verdict.CORRECTED), ("5.934e-16", Verdict.CONTRADICTED),
     ("5.934e0", Verdict.CONSISTENT)],
)  # fmt: skip
def test_the_unit_of_cone_index_would_be_decided_by_another_C1(C1, verdict):
    # A thousand times less: only MPa gives a soil. A thousand times more: only kPa does.
    found = judged(altered({"Table 1: C1": C1}))["table1_unit_of_cone_index"]
    assert found.verdict is verdict


@pytest.mark.parametrize(
    "changes", [{"Table 1: max_relative_error": "0.0024"}, {"Table 1: r_squared": "0.981"}]
)
def test_quality_that_cannot_belong_to_one_fit(changes):
    # Errors all below 0.24 % cannot have that RMSE; an R^2 of 0.98 needs cone indices over decades.
    assert judged(altered(changes))["table1_quality"].verdict is Verdict.CONTRADICTED
