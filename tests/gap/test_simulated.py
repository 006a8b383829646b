"""A simulator at the rows of both campaigns: beyond their pressures, bent, with its own error."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.gap.campaigns import CaseSimulator, campaigns
from tests.gap.cases import campaigns_of
from tests.gap.test_hypotheses import density_campaigns

PSI = "inflation_pressure_psi"


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def middle(simulated: CaseSimulator, k: int = 2) -> tuple[np.ndarray, np.ndarray]:
    t = np.tile([p.loc for p in simulated.priors], (k, 1))
    t += (
        0.2
        * np.random.default_rng(1).standard_normal(t.shape)
        * [p.scale for p in simulated.priors]
    )
    return t, np.zeros((k, simulated.n_bends + simulated.n_errors))


def test_beyond_the_pressures_of_both_campaigns_it_goes_on_straight(data):
    """From 18 psi to 42 psi; also where each parameter vector has pressures of its own."""
    simulated = data.simulated["drawbar_pull"]
    t, misfit = middle(simulated)

    def at(pressure):
        return simulated.predict(t, misfit, {**simulated.field, PSI: pressure})

    flat = np.full(27, 1.0)
    low, high = at(18.0 * flat), at(42.0 * flat)
    assert np.abs(high - low).max() > 0.05
    pressure = np.linspace(10.0, 54.0, 27)
    for own in (pressure, np.stack([pressure, pressure[::-1]])):
        found = simulated.predict_beyond(t, misfit, {**simulated.field, PSI: own})
        expected = at(np.clip(own, 18.0, 42.0)) + (high - low) * (own - np.clip(own, 18, 42)) / 24.0
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    inside = {**simulated.field, PSI: np.linspace(18.0, 42.0, 27)}
    np.testing.assert_array_equal(
        simulated.predict_beyond(t, misfit, inside), simulated.predict(t, misfit, inside)
    )
    # One pressure only is no range to go on from, and the field's own lie inside.
    for other in (
        CaseSimulator(data.outputs[0], data.view, (30.0, 30.0)),
        CaseSimulator(data.outputs[0], data.view, (20.0, 25.0)),
    ):
        conditions = {**other.field, PSI: data.view.conditions[PSI]}
        np.testing.assert_array_equal(
            other.predict_beyond(t, misfit, conditions), other.predict(t, misfit, conditions)
        )
    wide = {**data.simulated["drawbar_pull"].field, PSI: pressure}
    only = CaseSimulator(data.outputs[0], data.view, (30.0, 30.0))
    np.testing.assert_array_equal(
        only.predict_beyond(t, misfit, wide), only.predict(t, misfit, wide)
    )


def test_without_pressures_nothing_goes_beyond_them():
    case = density_campaigns()
    data = campaigns(case)
    simulated = data.simulated["bulk_density"]
    t, misfit = middle(simulated)
    misfit[1] = 0.02
    np.testing.assert_array_equal(
        simulated.predict_beyond(t, misfit, simulated.field),
        simulated.predict(t, misfit, simulated.field),
    )


def test_the_conditions_of_any_view_are_the_models(data):
    simulated = data.simulated["rut_depth"]
    assert simulated.conditions(data.view) is simulated.field
    some = {name: values[:4] for name, values in data.view.conditions.items()}
    found = simulated.conditions(replace(data.view, conditions=some))
    assert set(found) == set(simulated.field)
    for name, values in found.items():
        np.testing.assert_array_equal(values, some[name])


def test_a_density_is_bent_no_farther_than_two_and_a_half_ranges_out():
    data = campaigns(density_campaigns())
    simulated = data.simulated["bulk_density"]
    wet, cone = (simulated.lab[n] for n in ("gravimetric_water_content", "cone_index_kpa"))
    half, mid = 0.5 * np.ptp(wet), 0.5 * (wet.max() + wet.min())
    logs = np.log(cone)
    half_log, mid_log = 0.5 * np.ptp(logs), 0.5 * (logs.max() + logs.min())
    u, v = np.array([0.5, 2.4, 3.1, -4.0]), np.array([-1.5, 0.0, 2.0, 2.6])
    # Any size of a cone index: its logarithm is taken.
    at = {
        "gravimetric_water_content": mid + half * u,
        "cone_index_kpa": np.exp(mid_log + half_log * v),
    }
    t, misfit = middle(simulated, 4)
    t[:] = t[0]
    misfit[1:] = np.eye(3)
    found = simulated.predict(t, misfit, at)
    bends = found[1:] - found[0]
    u, v = np.clip(u, -2.5, 2.5), np.clip(v, -2.5, 2.5)
    expected = {"uu": u * u - 1 / 3, "uv": u * v, "vv": v * v - 1 / 3}
    one, other = (list(simulated.lab).index(n) for n in at)
    order = ("uu", "uv", "vv") if one < other else ("vv", "uv", "uu")
    np.testing.assert_allclose(bends, [expected[name] for name in order], rtol=1e-6)


@pytest.mark.parametrize(("spread", "bends"), [(0.0, 1), (1e-10, 1), (1e-6, 3)])
def test_a_condition_that_was_constant_in_the_laboratory_bends_nothing(spread, bends):
    case = density_campaigns()
    n = len(case.lab)
    lab = replace(case.lab, columns={
        **case.lab.columns, "gravimetric_water_content": 0.1 + spread * np.linspace(-1, 1, n)
    })  # fmt: skip
    data = campaigns(replace(case, lab=lab))
    assert data.simulated["bulk_density"].n_bends == bends


def test_an_emulators_error_is_told_by_the_axes_that_are_more_than_it_neglects(data):
    """Of the covariance of its curves over all rows that of the large axes, and nothing else."""
    rng = np.random.default_rng(4)
    curves = rng.standard_normal((30, 6))
    curves[3] = np.nan
    variances = np.array([4.0, 1.0, 1e-2, 1e-4, 1e-9])
    emulator = SimpleNamespace(
        typical_variances=variances, curves_at=lambda at: curves[at["row"]], negligible=0.02
    )
    simulated = CaseSimulator.__new__(CaseSimulator)
    simulated._emulator, simulated._ranges = emulator, ()
    simulated._mix = simulated._error_of({"row": np.arange(30)})
    simulated.n_errors = simulated._mix.shape[1]
    known = np.delete(curves[:, 1:], 3, axis=0)
    values, vectors = np.linalg.eigh((known * variances) @ known.T)
    # Three times what is neglected, rms over the 29 rows.
    large = values > 29 * (3.0 * 0.02) ** 2
    assert large.sum() == simulated.n_errors == 3
    errors = np.stack(simulated._bends({"row": np.delete(np.arange(30), 3)}), axis=-1)
    expected = (vectors[:, large] * values[large]) @ vectors[:, large].T
    np.testing.assert_allclose(errors @ errors.T, expected, atol=1e-9)
    emulator.negligible = 1e3
    assert simulated._error_of({"row": np.arange(30)}).shape == (5, 0)
    simulated._emulator = None
    assert simulated._error_of({"row": np.arange(30)}).shape == (0, 0)
