"""Terms that would explain what listed causes leave: known forms come first, noise has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.describe import gap_document
from calib.gap.diagnose import diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.suggestions import suggest, suggestions
from tests.gap.cases import diagnosis_of, make_case

N = 36
# Noise grows with slip, and the level with slip and pressure.
SLIP, SPEED, PRESSURE = np.random.default_rng(3).uniform(-1.0, 1.0, (3, N))
CONDITIONS = {
    "slip_ratio": (0.3 + 0.3 * SLIP, SLIP),
    "speed_m_s": (1.1 + SPEED, SPEED),
    "inflation_pressure_psi": (30.0 + 12.0 * PRESSURE, PRESSURE),
}
LEVEL = 1.0 + 0.6 * np.tanh(2.0 * SLIP) - 0.1 * PRESSURE
SD = 0.03 * (1.0 + 0.5 * (1.0 + SLIP))


def found(gap, seed: int = 1):
    noise = SD * np.random.default_rng(seed).standard_normal(N)
    return suggest("drawbar_pull", gap + noise, LEVEL, SD, CONDITIONS)


@pytest.mark.parametrize(
    ("gap", "kind", "columns", "factor", "rises"),
    [
        (0.1 * SPEED, "linear", ("speed_m_s",), False, True),
        (-0.1 * PRESSURE * LEVEL, "linear", ("inflation_pressure_psi",), True, False),
        (0.3 * SPEED**2, "quadratic", ("speed_m_s",), False, True),
        (-0.2 * (SPEED > 0.3) * LEVEL, "step", ("speed_m_s",), True, False),
        (0.2 * SLIP * SPEED, "product", ("slip_ratio", "speed_m_s"), False, True),
    ],
)
def test_a_known_form_comes_first(gap, kind, columns, factor, rises):
    # A constant and a part of the level go with any of them.
    for seed in (1, 2, 3):
        best, *others = found(gap + 0.1 - 0.05 * LEVEL, seed)
        assert (best.kind, best.columns, best.factor, best.rises) == (kind, columns, factor, rises)
        assert best.probability > 0.5
        # The noise has a square of 2 (0.03)^2 on average, all terms here of at least 0.0033.
        assert best.removed > 0.4
        assert all(0.05 <= other.probability < best.probability for other in others)
        if kind == "step":
            # Between the two rows about the threshold, of 36 over -1..1, or one farther.
            assert best.at == pytest.approx(1.4, abs=0.15)


def test_noise_has_no_suggestion():
    several = [len(found(0.0, seed)) for seed in range(200)]
    # Some term is as probable as none in one of twenty.
    assert sum(n > 0 for n in several) <= 10


def test_without_conditions_that_vary_or_a_residual_nothing_is_suggested():
    assert suggest("drawbar_pull", SD, LEVEL, SD, {}) == []
    constant = {"speed_m_s": (np.append(np.zeros(N - 1), 1e-9), np.ones(N))}
    assert suggest("drawbar_pull", np.zeros(N), LEVEL, SD, constant) == []


def test_where_nothing_unlisted_acts_nothing_is_suggested():
    for effect in (None, "rate_effect"):
        assert suggestions(diagnosis_of(effect).corrected.mixture) == ()


def test_a_loss_at_the_middle_pressure_is_suggested_of_the_pull_alone():
    """Which no listed effect has, as when a wheel hops at some pressure."""
    case = make_case(None, n_field=36, n_fresh=3)
    columns = dict(case.field.columns)
    middle = columns["inflation_pressure_psi"] == 30.0
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"] * np.where(middle, 0.8, 1.0)
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    case = replace(case, field=table_from_arrays(columns))
    best, *others = gap_document(diagnose_once(case, 1, effects=few)).suggestions
    assert (best.kind, best.factor, best.rises) == ("quadratic", True, True)
    # On one tyre the one pressure goes with the other.
    assert best.columns in {("inflation_pressure_psi",), ("average_ground_pressure_kpa",)}
    assert best.probability > 0.9
    assert {s.output for s in (best, *others)} == {"drawbar_pull"}
