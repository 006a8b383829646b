"""Campaigns bound to models: references, refusals, scaled conditions, simulators."""

from __future__ import annotations

import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.gap.campaigns import Campaigns, CaseSimulator, campaigns
from calib.gap.case import Case
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.inference.emulation.prepared import prepare
from calib.inference.likelihood import log_normal
from calib.inference.prior_files import DeclaredPriors, default_priors
from calib.models.simulators.emulator import emulator_of
from tests.gap.cases import PULL_ONLY, campaigns_of, make_case, table_without
from tests.gap.fits import fitted, log_joint
from tests.inference.emulation.test_emulate import as_before as as_before
from tests.models.simulators.examples import PRIORS, lab, pull


@pytest.mark.parametrize("campaign", ["lab", "field"])
def test_a_missing_output_is_named(campaign):
    case = make_case()
    table = table_without(getattr(case, campaign), "rut_depth_mm")
    with pytest.raises(CalibError, match="no values of rut_depth_mm"):
        campaigns(replace(case, **{campaign: table}))


def test_a_model_of_another_output_is_refused():
    case = replace(make_case(None), models={"rut_depth": "magic_formula"})
    with pytest.raises(CalibError, match="magic_formula does not predict rut_depth") as refused:
        campaigns(case)
    assert "bekker, modified_bekker" in str(refused.value)


def test_an_unknown_model_is_named():
    with pytest.raises(CalibError, match="no model 'spring'"):
        campaigns(replace(make_case(), models={"drawbar_pull": "spring"}))


def test_a_condition_that_the_model_needs_is_named():
    case = make_case(models=PULL_ONLY)
    with pytest.raises(CalibError, match="slip_ratio"):
        campaigns(replace(case, field=table_without(case.field, "slip_ratio")))


def test_rows_without_an_output_are_left_out_of_that_output_alone():
    case = make_case()
    columns = {k: v.copy() for k, v in case.field.columns.items()}
    columns["drawbar_pull_kn"][[2, 5]] = np.nan
    holed = table_from_arrays(columns, allow_missing=("drawbar_pull_kn",))
    data = campaigns(replace(case, field=holed))
    pull, rut = data.outputs
    assert set(range(27)) - set(pull.rows.tolist()) == {2, 5}
    assert rut.rows.size == 27
    assert np.isfinite(pull.field).all()
    np.testing.assert_allclose(rut.field, np.log(case.field["rut_depth_mm"]))


def test_references_come_from_the_laboratory():
    case = make_case()
    view = campaigns(case).view
    assert view.lab["speed_m_s"] == 0.3
    assert view.load_kn == 5.0
    assert view.order_range == (0.0, 26.0)


def test_ground_pressure_follows_inflation_pressure_as_in_the_data():
    # The cases have ground pressure 30 p^0.5.
    assert campaigns(make_case()).view.ground_exponent == pytest.approx(0.5, abs=1e-9)
    case = make_case()
    columns = dict(case.lab.columns)
    columns["average_ground_pressure_kpa"] = 5.0 * columns["inflation_pressure_psi"] ** 0.8
    steeper = Case(case.name, table_from_arrays(columns), case.field, case.models)
    assert campaigns(steeper).view.ground_exponent == pytest.approx(0.8, abs=1e-9)


@pytest.mark.parametrize(("power", "exponent"), [(1.4, 1.4), (2.0, 1.5), (-0.3, 0.0)])
@pytest.mark.parametrize("known", ["both", "field"])
def test_the_exponent_is_that_of_a_tyre_on_soft_ground(known, power, exponent):
    """Of the laboratory, else of the field: none below zero, where it would stand on its rim."""
    case = make_case(models=PULL_ONLY)
    tables = []
    for table, other in ((case.lab, power), (case.field, power if known == "field" else 0.7)):
        psi = table["inflation_pressure_psi"]
        columns = {**table.columns, "average_ground_pressure_kpa": 5.0 * psi**other}
        tables.append(table_from_arrays(columns))
    if known == "field":
        alike = np.full(30, 30.0)
        tables[0] = replace(
            tables[0], columns={**tables[0].columns, "inflation_pressure_psi": alike}
        )
    found = campaigns(Case("pressed", *tables, PULL_ONLY)).view.ground_exponent
    assert found == pytest.approx(exponent, abs=1e-9)


def holed(rows_of_lab, rows_of_field) -> Case:
    """Return a case that lacks the pull of some rows."""
    case = make_case()
    tables = []
    for table, rows in ((case.lab, rows_of_lab), (case.field, rows_of_field)):
        columns = {k: v.copy() for k, v in table.columns.items()}
        columns["drawbar_pull_kn"][rows] = np.nan
        tables.append(table_from_arrays(columns, allow_missing=("drawbar_pull_kn",)))
    return replace(case, lab=tables[0], field=tables[1])


@pytest.mark.parametrize(("n", "refused"), [(4, True), (5, False)])
def test_four_rows_of_the_field_show_no_gap(n, refused):
    case = make_case(models=PULL_ONLY)
    few = replace(case, field=case.field.take(range(n)))
    with pytest.raises(CalibError, match="4 field rows") if refused else nullcontext():
        campaigns(few)


@pytest.mark.parametrize(
    ("lab", "field", "refused"),
    [
        (1.0, 100.0, True), (1.0, 99.0, False), (1.0, 0.01, True), (1.0, 0.0101, False),
        (-1.0, 99.0, False), (-1.0, -100.0, True), (0.0, 1.0, True),
    ],
)  # fmt: skip
def test_outputs_are_compared_by_their_typical_size(lab, field, refused):
    case = make_case(models=PULL_ONLY)
    tables = []
    for table, typical in ((case.lab, lab), (case.field, field)):
        pull = np.full(len(table), typical)
        pull[:2] = 3.0 * typical + 1.0
        tables.append(replace(table, columns={**table.columns, "drawbar_pull_kn": pull}))
    with pytest.raises(CalibError, match="typically") if refused else nullcontext():
        campaigns(Case("sized", *tables, PULL_ONLY))


@pytest.mark.parametrize(("size", "refused"), [(1.0, False), (1e-3, True), (1e3, True)])
def test_a_load_that_is_assumed_for_effects_and_the_pull_contradicts_is_refused(size, refused):
    case = make_case(models=PULL_ONLY)
    own = default_priors(PULL_ONLY["drawbar_pull"]).read_text().replace("relative_to", "#")
    own = re.sub(
        r"(median|sd|mean) = ([\d.]+)(?=[^\[]*unit = \"kN)",
        lambda m: f"{m[1]} = {5.0 * size * float(m[2])}",
        own.replace("default_reference", "#"),
    )
    lab, there = (
        replace(
            t,
            columns={
                **{name: v for name, v in t.columns.items() if name != "normal_load_kn"},
                "drawbar_pull_kn": size * t["drawbar_pull_kn"],
            },
            header=("slip_ratio", "drawbar_pull_kn (checked)"),
        )
        for t in (case.lab, case.field)
    )
    priors = {"drawbar_pull": DeclaredPriors("own.toml", own)}
    with pytest.raises(CalibError) if refused else nullcontext() as caught:
        campaigns(replace(case, lab=lab, field=there, priors=priors))
    if refused:
        assert "add the column normal_load_kn" in str(caught.value)


def test_the_calibration_itself_is_no_field():
    case = make_case()
    with pytest.raises(CalibError, match="every field row is a row of the calibration"):
        campaigns(replace(case, field=case.lab))


def test_both_campaigns_span_the_scale():
    data = campaigns(make_case(models=PULL_ONLY))
    slip = data.scaled(data.view, "slip")
    both = np.concatenate([data.case.lab["slip_ratio"], data.case.field["slip_ratio"]])
    expected = 2.0 * (data.case.field["slip_ratio"] - both.min()) / np.ptp(both) - 1.0
    np.testing.assert_allclose(slip, expected, atol=1e-12)


def test_speeds_are_even_in_ratios():
    data = campaigns(make_case(models=PULL_ONLY))
    both = np.concatenate([data.view.conditions["speed_m_s"], data.case.lab["speed_m_s"]])
    middle = np.full(27, np.sqrt(both.min() * both.max()))
    view = replace(data.view, conditions={**data.view.conditions, "speed_m_s": middle})
    scaled = data.scaled(view, "speed")
    np.testing.assert_allclose(scaled, 0.0, atol=1e-12)


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


NOISE = 0.03


def emulated(folder: Path, runs: int) -> Campaigns:
    """The same wheel in both campaigns, its emulator from some runs."""
    calib.register(
        calib.from_callable(
            pull, parameters=PRIORS, conditions=["slip_ratio", "normal_load_kn"],
            output="drawbar_pull_kn", name="wheel", emulate=True, folder=folder, runs=runs,
            first=min(runs, 20), checks=0,
        )
    )  # fmt: skip
    tables = [calib.table_from_arrays(lab(np.random.default_rng(s), NOISE)) for s in (1, 2)]
    prepare("wheel", tables[0], 1)
    return campaigns(Case("case", *tables, {"drawbar_pull": "wheel"}))


def test_a_crude_emulators_error_is_in_the_likelihood(tmp_path: Path) -> None:
    data = emulated(tmp_path, 12)
    (o,) = data.outputs
    simulated = data.simulated["drawbar_pull"]
    emulator = emulator_of(o.problem.bound.model)
    assert emulator is not None
    assert simulated.n_errors >= 1
    forward = Forward(data, Hypothesis("none"), {o.name: NOISE})
    names = [p.name for p in forward.priors.free]
    assert names.count("drawbar_pull.emulator") == simulated.n_errors

    # Its coefficients taken out by integration, it is the density of the calibration: normal with
    # the covariance that noise and emulator have, over the rows of both campaigns together.
    theta = emulator.axes.natural(emulator.regions[-1].centre[None])
    at = simulated.both
    curves = emulator.curves_at(at)[:, 1:]
    covariance = (curves * emulator.typical_variances) @ curves.T
    t = o.priors.to_internal(theta)
    psi = np.zeros((1 + simulated.n_errors, forward.n_dim))
    psi[:, forward.theta_slices[o.name]] = t
    psi[1:, forward.misfit_slices[o.name]] = np.eye(simulated.n_errors)
    predicted = np.concatenate([part[o.name] for part in forward.plain(psi)], axis=1)
    ours = (predicted[1:] - predicted[0]).T @ (predicted[1:] - predicted[0])
    scale = np.sqrt(np.diag(covariance).max())
    np.testing.assert_allclose(ours, covariance, atol=(0.02 * NOISE) ** 2 + 0.01 * scale**2)
    observed = data.observed
    residuals = observed - predicted[:1]
    scaled = curves * np.sqrt(emulator.typical_variances)
    marginal = log_normal(residuals, np.ones(1), scaled, np.array([NOISE]))
    found = np.linalg.slogdet(np.eye(len(observed)) * NOISE**2 + ours)[1]
    weighed = np.linalg.solve(np.eye(len(observed)) * NOISE**2 + ours, residuals[0])
    value = -0.5 * (residuals[0] @ weighed + found + len(observed) * np.log(2.0 * np.pi))
    assert value == pytest.approx(float(marginal[0]), abs=0.05)
    # Conditions of each vector's own, as an effect on a gauge gives, are taken as well.
    own = {name: np.tile(v, (len(psi), 1)) for name, v in at.items()}
    again = simulated.predict(
        psi[:, forward.theta_slices[o.name]], psi[:, forward.misfit_slices[o.name]], own
    )
    np.testing.assert_allclose(again, predicted, rtol=1e-9)


@pytest.mark.slow
def test_a_good_emulator_adds_next_to_nothing(tmp_path: Path) -> None:
    data = emulated(tmp_path, 60)
    simulated = data.simulated["drawbar_pull"]
    assert simulated.n_errors <= 2
    found = fitted(data, Hypothesis("none"))
    assert np.isfinite(found.log_evidence)
    assert np.isfinite(log_joint(found, found.psi[None])).all()
