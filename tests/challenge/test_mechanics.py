"""The mechanics must behave as wheels on soil do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from challenge.contact import settle, solve_increasing
from challenge.density import draw_cone_law
from challenge.mechanics import self_propelled_slip, simulate
from challenge.soil import draw_soil, shear_stress
from challenge.tyre import PSI_KPA, Tyre, average_ground_pressure
from tests.challenge.realities import conditions, reality, sandy_loam


def test_contact_lengths_are_the_measured_ones() -> None:
    got = Tyre().contact_length(np.array([18.0, 30.0, 42.0]) * PSI_KPA, np.full(3, 5.0))
    assert got == pytest.approx([0.26656, 0.20159, 0.15943], rel=1e-9)


def test_ground_pressure_is_load_over_area() -> None:
    got = average_ground_pressure(np.array([18.0, 30.0, 42.0]) * PSI_KPA, np.full(3, 5.0))
    assert got == pytest.approx([106.577, 140.925, 178.192], abs=2e-3)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), load=st.floats(2.0, 7.0), slipping=st.booleans())
def test_vertical_forces_balance(seed: int, load: float, slipping: bool) -> None:
    rng = np.random.default_rng(seed)
    soil = draw_soil(rng, slip_sinkage=slipping)
    slip, inflation = rng.uniform(-0.05, 0.75, 20), rng.uniform(100.0, 320.0, 20)
    contact = settle(soil, Tyre(), slip, inflation, np.full(20, load))
    assert contact.support_kn == pytest.approx(np.full(20, load), rel=1e-6)
    assert np.all(contact.sinkage_m > 0.0)


def test_pull_vanishes_at_recorded_zero_slip() -> None:
    inflation = np.array([110.0, 150.0, 200.0, 300.0])
    recorded = conditions(4, slip=0.0, inflation_kpa=inflation)
    assert simulate(reality(), recorded)["drawbar_pull"] == pytest.approx(np.zeros(4), abs=1e-6)
    zero = self_propelled_slip(reality(), inflation)
    assert np.all((zero > 0.0) & (np.diff(zero, prepend=0.0) > 0.0))


def test_pull_and_rut_resemble_the_source() -> None:
    got = simulate(reality(), conditions(29))
    pull, rut = got["drawbar_pull"], got["rut_depth"]
    assert 0.4 < pull.max() < 2.0
    assert pull[4] > 0.5 * pull.max()
    assert np.all(np.diff(rut) > 0.0)
    assert 8.0 < rut[0] < rut[-1] < 110.0


@settings(max_examples=20, deadline=None)
@given(factor=st.floats(1.05, 3.0), slip=st.floats(0.05, 0.7))
def test_pull_grows_with_cohesion(factor: float, slip: float) -> None:
    zero = np.full(1, 0.01)
    at = conditions(1, slip=slip)
    weak = simulate(reality(), at, zero)
    strong = simulate(reality(cohesion_kpa=4.0 * factor), at, zero)
    assert strong["drawbar_pull"][0] > weak["drawbar_pull"][0]
    assert strong["rut_depth"][0] < weak["rut_depth"][0]


@settings(max_examples=20, deadline=None)
@given(load=st.floats(2.0, 7.0), more=st.floats(0.2, 3.0))
def test_rut_grows_with_load(load: float, more: float) -> None:
    light, heavy = (
        simulate(reality(), conditions(5, load_kn=each))["rut_depth"]
        for each in (load, load + more)
    )
    assert np.all(heavy > light)


def test_rut_grows_with_inflation() -> None:
    ruts = [
        simulate(reality(), conditions(3, inflation_kpa=p))["rut_depth"]
        for p in (120.0, 200.0, 290.0)
    ]
    assert np.all(np.diff(ruts, axis=0) > 0.0)


def test_shear_is_odd_bounded_and_softens() -> None:
    soil = sandy_loam(residual=0.6, softening_m=0.03).columns(1)
    j = np.linspace(-0.3, 0.3, 61)[None, :]
    stress = shear_stress(soil, np.full((1, 61), 100.0), j)[0]
    assert stress == pytest.approx(-stress[::-1])
    assert np.all(np.abs(stress) <= 4.0 + 30.0)
    assert stress[-1] < 0.75 * stress.max()


def test_solver_returns_ends_outside_the_bracket() -> None:
    shift = np.array([-2.0, 0.3, 5.0])
    got = solve_increasing(lambda x: x**3 - shift**3, np.full(3, -1.0), np.full(3, 1.0))
    assert got == pytest.approx([-1.0, 0.3, 1.0], abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), index=st.floats(200.0, 1500.0), water=st.floats(0.02, 0.09))
def test_density_grows_with_cone_index_and_water(seed: int, index: float, water: float) -> None:
    law = draw_cone_law(np.random.default_rng(seed))
    base = law.density(np.array([index]), np.array([water]))
    assert law.density(np.array([1.1 * index]), np.array([water])) > base
    assert law.density(np.array([index]), np.array([1.1 * water])) > base
