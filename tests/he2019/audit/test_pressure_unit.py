"""Pressure is in psi, and a table in kPa would be found to be in kPa."""

from __future__ import annotations

import numpy as np
import pytest

from calib.he2019.audit.bounds import NAMES
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.pull import pressure_unit, targets
from calib.he2019.published import PUBLISHED
from tests.he2019.audit.altered import altered


def in_kpa(digits: int) -> dict[str, str]:
    """Return quadratics through Table 4 in kPa, printed to some significant digits."""
    changes = {}
    for what in ("D", "BCD"):
        pressures, wanted = targets(PUBLISHED, what)
        c = np.linalg.solve(np.vander(6.894757 * pressures, 3, increasing=True), wanted)
        for name, value in zip(NAMES[what], c, strict=True):
            changes[f"Table 5: {name}"] = f"{value:.{digits - 1}e}"
    return changes


def test_the_declared_unit_is_corrected():
    found = pressure_unit(PUBLISHED)
    assert found.verdict is Verdict.CORRECTED
    by_unit = {q.name.split()[-1]: q.value for q in found.found}
    assert by_unit["psi"] < 20.0
    assert min(by_unit["kPa"], by_unit["bar"]) > 100.0
    assert "In psi" in found.evidence


def test_a_table_in_kPa_is_confirmed():
    found = pressure_unit(altered(in_kpa(5)))
    assert found.verdict is Verdict.CONFIRMED
    assert "In kPa" in found.evidence


@pytest.mark.parametrize("name", ["c1", "c4"])
def test_a_table_in_no_unit_is_contradicted(name):
    value = 100.0 * PUBLISHED.pressure.estimates[name].value
    wrong = altered({f"Table 5: {name}": f"{value:.1f}"})
    assert pressure_unit(wrong).verdict is Verdict.CONTRADICTED
