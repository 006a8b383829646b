"""What Table 5's digits can reproduce, and what more digits would."""

from __future__ import annotations

import numpy as np
import pytest

from calib.he2019.audit.bounds import NAMES
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.pull import rounding_findings, study_rounding, targets
from calib.he2019.published import PUBLISHED
from tests.he2019.audit.altered import altered


def judged(published):
    return {f.key: f for f in rounding_findings(published, study_rounding(published, 31))}


def with_digits(digits: int):
    """Return Table 5 as the quadratics through Table 4, printed to many digits."""
    changes = {"Table 5: b0": "1.55400000"}
    for what, names in NAMES.items():
        pressures, wanted = targets(PUBLISHED, what)
        c = np.linalg.solve(np.vander(pressures, 3, increasing=True), wanted)
        changes |= {
            f"Table 5: {name}": f"{value:.{digits - 1}e}"
            for name, value in zip(names, c, strict=True)
        }
    return altered(changes)


@pytest.fixture(scope="module")
def as_printed():
    return judged(PUBLISHED)


def test_as_printed_the_digits_are_too_few(as_printed):
    verdicts = {key: f.verdict for key, f in as_printed.items()}
    assert verdicts == {
        "table5_digits_of_D": Verdict.CORRECTED,
        "table5_digits_of_BCD_and_E": Verdict.CONTRADICTED,
        "table5_digits_of_pull": Verdict.CORRECTED,
        "table5_b0": Verdict.CONSISTENT,
        "table4_digits": Verdict.CONFIRMED,
    }


def test_D_at_42_psi_by_hand(as_printed):
    found = {q.name: q for q in as_printed["table5_digits_of_D"].found}["D at 42 psi"]
    assert found.value == pytest.approx(3.272 - 0.107 * 42 + 0.001 * 42**2)
    half = 0.0005 + 0.0005 * 42 + 0.0005 * 42**2
    assert found.lower == pytest.approx(found.value - half, abs=1e-9)
    assert found.upper == pytest.approx(found.value + half, abs=1e-9)
    assert found.published == "0.5954 (Table 4)"


def test_with_more_digits_the_verdicts_change():
    found = judged(with_digits(9))
    assert found["table5_digits_of_D"].verdict is Verdict.CONFIRMED
    assert found["table5_digits_of_BCD_and_E"].verdict is Verdict.CONFIRMED
    assert found["table5_digits_of_pull"].verdict is Verdict.CONFIRMED


def test_a_wrong_c1_cannot_give_table_4():
    assert judged(altered({"Table 5: c1": "4.272"}))["table5_digits_of_D"].verdict is (
        Verdict.CONTRADICTED
    )


def test_b0_outside_the_range_of_C():
    assert judged(altered({"Table 5: b0": "1.654"}))["table5_b0"].verdict is Verdict.CONTRADICTED


def test_table_4_with_fewer_digits_is_not_enough():
    coarse = altered({"Table 4, 42 psi: D": "0.6"})
    assert judged(coarse)["table4_digits"].verdict is Verdict.CORRECTED


def test_every_range_of_the_pull_holds_the_printed_curve():
    study = study_rounding(PUBLISHED, 61)
    for psi, allowed in study.allowed.items():
        assert allowed.holds(study.as_printed[psi])
