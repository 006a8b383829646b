"""Free discrepancies: their shapes, and where they set in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.discrepancy import Discrepancy
from calib.gap.hypotheses import Hypothesis
from tests.gap.cases import campaigns_of, make_case

PULL = ("drawbar_pull",)


@pytest.fixture(scope="module")
def data() -> Campaigns:
    return campaigns_of(None)


def of(data: Campaigns, **kwargs) -> Discrepancy:
    lab_mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    h = Hypothesis("unknown", smooth=1.0, smooth_outputs=PULL, **kwargs)
    return Discrepancy(data, h, lab_mode)


def test_over_slip_it_is_cosines_of_slip_and_a_trend_with_pressure(data):
    found = of(data, smooth_over="slip")
    sds = found.sds("drawbar_pull")
    size = sds.size
    assert sds[0] == 1.0
    slip = found.covariates.scaled(data.view, "slip_ratio")
    second = np.zeros((1, size))
    second[0, 2] = 1.0
    curve = found.at(second, np.empty(0), data.view, "drawbar_pull")[0]
    np.testing.assert_allclose(curve, np.sqrt(2.0) * np.cos(np.pi * (slip + 1.0)), atol=1e-12)


def test_over_one_condition_alone_it_is_added_or_a_part_of_the_pull(data):
    found = of(data, smooth_over="pressure")
    pressures = np.unique(data.view.conditions["inflation_pressure_psi"]).size
    sds = found.sds("drawbar_pull")
    # A constant and as many cosines as tell the pressures apart, by themselves and times the pull.
    assert sds.size == 2 * pressures
    at = data.view.conditions["inflation_pressure_psi"] == np.median(
        data.view.conditions["inflation_pressure_psi"]
    )
    level = found._level(data.view, "drawbar_pull")
    basis = found.at(np.eye(sds.size), np.empty(0), data.view, "drawbar_pull").T
    for wanted in (at * 1.0, at * level):
        np.testing.assert_allclose(basis @ np.linalg.lstsq(basis, wanted)[0], wanted, atol=1e-9)


def test_ripples_are_of_any_length_down_to_a_twelfth_of_the_slips(data):
    found = of(data, smooth_over="ripple")
    sds = found.sds("drawbar_pull")
    assert sds.size == 25
    np.testing.assert_allclose(sds[1:], sds[1])
    np.testing.assert_allclose(np.sum(sds[1:] ** 2), 1.0)
    slip = found.covariates.scaled(data.view, "slip_ratio")
    shortest = np.zeros((1, 25))
    shortest[0, 24] = 1.0
    curve = found.at(shortest, np.empty(0), data.view, "drawbar_pull")[0]
    np.testing.assert_allclose(curve, np.sqrt(2.0) * np.cos(12.0 * np.pi * (slip + 1.0)))


@pytest.mark.parametrize(
    "over",
    ["slip", "ripple", "level", "sinkage", "order", "pressure", "speed", "passes", "water", "all"],
)
def test_it_is_the_same_function_at_other_conditions(data, over):
    found = of(data, smooth_over=over)
    amplitudes = np.random.default_rng(1).standard_normal((3, found.sds("drawbar_pull").size))
    whole = found.at(amplitudes, np.empty(0), data.view, "drawbar_pull")
    rows = np.array([4, 0, 17])
    some = replace(data.view, conditions={k: v[rows] for k, v in data.view.conditions.items()})
    part = found.at(amplitudes, np.empty(0), some, "drawbar_pull")
    np.testing.assert_allclose(part, whole[:, rows], atol=1e-12)


def test_it_sets_in_at_a_threshold_as_a_step_and_a_bend_of_what_it_was_before(data):
    found = of(data, onset_over="slip")
    np.testing.assert_array_equal(found.sds("drawbar_pull"), [1.0, 2.0, 0.5])
    u = found.onset_covariate(data.view, "drawbar_pull")
    step, bend, before = found.onset(data.view, "drawbar_pull", np.array([0.1]))
    far = abs(u - 0.1) > 0.6  # ten widths
    np.testing.assert_allclose(step[0, far], (u > 0.1)[far], atol=1e-4)
    np.testing.assert_allclose(bend[0, far], np.maximum(u - 0.1, 0.0)[far], atol=1e-4)
    np.testing.assert_array_equal(before, 1.0)
    all_three = found.at(np.array([[0.2, -0.3, 0.4]]), np.array([0.1]), data.view, "drawbar_pull")
    np.testing.assert_allclose(all_three, 0.2 * step - 0.3 * bend + 0.4)


def test_a_reading_that_keeps_part_of_the_run_before(data):
    found = of(data, smooth_over="before")
    o = next(o for o in data.outputs if o.name == "drawbar_pull")
    theta = o.priors.to_natural(found.lab_mode["drawbar_pull"][None])
    selected = o.problem.bound.model.select(data.view.conditions)
    pull = o.problem.bound.mean_response(theta, selected)[0]
    as_they_are = found.at(np.array([[0.3]]), np.empty(0), data.view, "drawbar_pull")[0]
    np.testing.assert_allclose(np.sqrt(np.mean(as_they_are**2)), 0.3)
    # The order of the runs counts, not that of the rows.
    runs = np.random.default_rng(2).permutation(pull.size)
    order = np.empty(pull.size)
    order[runs] = np.arange(pull.size)
    shuffled = replace(data.view, conditions={**data.view.conditions, "run_order": order})
    gap = found.at(np.array([[0.3]]), np.empty(0), shuffled, "drawbar_pull")[0]
    kept = gap[runs[1:]] / (pull[runs[:-1]] - pull[runs[1:]])
    np.testing.assert_allclose(kept, kept[0])
    assert kept[0] > 0.0
    assert gap[runs[0]] == 0.0


def test_without_an_order_nothing_is_kept_of_the_run_before(data):
    found = of(data, smooth_over="before")
    n = data.view.slip().size
    unknown = replace(data.view, conditions={**data.view.conditions, "run_order": np.full(n, 7.0)})
    assert not found.at(np.ones((1, 1)), np.empty(0), unknown, "drawbar_pull").any()


DECAY = 3.0


def cosines(u: np.ndarray, most: int, scale: float) -> list[tuple[np.ndarray, float]]:
    """cos(j pi (u + 1)/2) of rms about one, the less probable the shorter its waves."""
    return [
        (
            np.sqrt(2.0) * np.cos(j * np.pi * (np.clip(u, -1.2, 1.2) + 1.0) / 2.0),
            scale / (1.0 + (j / DECAY) ** 2),
        )
        for j in range(1, most + 1)
    ]


def written_again(found: Discrepancy, view, over: str) -> list[tuple[np.ndarray, float]]:
    """The terms of a discrepancy of the pull: functions of the rows, and their sds."""
    u = {
        what: found.covariates.over(view, what)
        for what in ("slip", "order", "pressure", "speed", "passes", "load")
    }
    levels = {
        what: np.unique(values).size
        for what in u
        if (values := found.covariates.over(found.data.view, what)) is not None
    }
    one = [(np.ones(len(u["slip"])), 1.0)]
    if over in ("level", "sinkage"):
        name = "drawbar_pull" if over == "level" else "rut_depth"
        o = next(o for o in found.data.outputs if o.name == name)
        theta = o.priors.to_natural(found.lab_mode[name][None])

        def predicted(at) -> np.ndarray:
            return o.problem.bound.mean_response(
                theta, o.problem.bound.model.select(at.conditions)
            )[0]

        reference = predicted(found.data.view)
        level = 2.0 * (predicted(view) - reference.min()) / np.ptp(reference) - 1.0
        return one + cosines(np.clip(level, -1.5, 1.5), 8, 0.8)
    if over == "order":
        return one + cosines(u["order"], 12, 0.7)
    if over in ("pressure", "speed", "passes"):
        terms = cosines(u[over], min(levels[over] - 1, 6), 0.8)
        level = written_level(found, view)
        return [*one, *terms, (level, 0.5), *((level * b, 0.6 * w) for b, w in terms)]
    slips = cosines(u["slip"], 10, 0.7)
    terms = list(slips)
    if over == "all":
        terms += cosines(u["order"], 6, 0.5)
    bends = 2 if over == "all" else 1
    for b, w in cosines(u["pressure"], min(levels["pressure"] - 1, bends), 0.5):
        terms += [(b, w), *((b * s, w * v) for s, v in slips[:4])]
    if over == "all":
        for what in ("speed", "passes", "load"):
            if u[what] is not None:
                terms += [*cosines(u[what], 3, 0.4), (u[what] * u["slip"], 0.4)]
    return one + terms


def written_level(found: Discrepancy, view) -> np.ndarray:
    o = next(o for o in found.data.outputs if o.name == "drawbar_pull")
    theta = o.priors.to_natural(found.lab_mode["drawbar_pull"][None])
    select = o.problem.bound.model.select
    at, reference = (
        o.problem.bound.mean_response(theta, select(v.conditions))[0]
        for v in (view, found.data.view)
    )
    return np.clip(2.0 * (at - reference.min()) / np.ptp(reference) - 1.0, -1.5, 1.5)


def test_a_run_keeps_one_part_of_the_run_before(data):
    np.testing.assert_array_equal(of(data, smooth_over="before").sds("drawbar_pull"), [1.0])


@pytest.mark.parametrize("over", ["slip", "pressure", "all"])
def test_of_many_pressures_a_few_waves_are_told_apart(over):
    """By themselves six at most, beside slip one, beside every condition two."""
    case = make_case()
    psi = np.resize(np.linspace(18.0, 42.0, 9), 27)
    field = replace(case.field, columns={**case.field.columns, "inflation_pressure_psi": psi})
    found = of(campaigns(replace(case, field=field)), smooth_over=over, smooth_decay=DECAY)
    view = found.data.view
    terms = written_again(found, view, over)
    sds = found.sds("drawbar_pull")
    np.testing.assert_allclose(sds, [w for _, w in terms])
    basis = found.at(np.eye(sds.size), np.empty(0), view, "drawbar_pull")
    np.testing.assert_allclose(basis, [b for b, _ in terms], atol=1e-12)


@pytest.mark.parametrize(("factor", "level"), [(1e-3, -1.5), (1e3, 1.5)])
def test_far_beyond_the_fields_range_the_level_ends(data, factor, level):
    found = of(data, smooth_over="sinkage")
    ground = factor * data.view.conditions["average_ground_pressure_kpa"]
    view = replace(
        data.view, conditions={**data.view.conditions, "average_ground_pressure_kpa": ground}
    )
    np.testing.assert_array_equal(found._level(view, "rut_depth"), level)


@pytest.mark.parametrize(("over", "output"), [("level", "drawbar_pull"), ("sinkage", "rut_depth")])
def test_it_may_set_in_over_what_is_predicted(data, over, output):
    """Over the output itself, or over the rut that goes with it: on the scale of the field's."""
    found = of(data, onset_over=over)
    u = found.onset_covariate(data.view, "drawbar_pull")
    np.testing.assert_allclose([u.min(), u.max()], [-1.0, 1.0])
    predicted = found._predicted(data.view, output)
    np.testing.assert_allclose(u, 2.0 * (predicted - predicted.min()) / np.ptp(predicted) - 1.0)


def test_a_sudden_one_needs_something_to_set_in_over(data):
    found = of(data, onset_over="cone")
    with pytest.raises(ValueError, match="cone"):
        found.onset_covariate(data.view, "drawbar_pull")


@pytest.mark.parametrize(
    "over", ["slip", "level", "sinkage", "order", "pressure", "speed", "passes", "all"]
)
@pytest.mark.parametrize("beyond", [False, True])
def test_terms_are_those_of_its_equations(data, over, beyond):
    """At the field's conditions and beyond them; what the terms are, and how large they may be."""
    found = of(data, smooth_over=over, smooth_decay=DECAY)
    view = data.view
    if beyond:
        wider = {c: v.mean() + 1.3 * (v - v.mean()) for c, v in view.conditions.items()}
        view = replace(view, conditions=wider)
    terms = written_again(found, view, over)
    sds = found.sds("drawbar_pull")
    np.testing.assert_allclose(sds, [w for _, w in terms])
    basis = found.at(np.eye(sds.size), np.empty(0), view, "drawbar_pull")
    np.testing.assert_allclose(basis, [b for b, _ in terms], atol=1e-12)


def test_below_a_pressure_it_is_a_step_and_a_part_of_the_pull(data):
    found = of(data, onset_over="low_pressure")
    psi = data.view.conditions["inflation_pressure_psi"]
    step, part = found.onset(data.view, "drawbar_pull", np.array([0.0]))
    # On a scale on which 18 psi is 1 and 42 psi is -1; half way at its threshold.
    np.testing.assert_allclose(step[0, psi < 20.0], 1.0, atol=1e-6)
    np.testing.assert_allclose(step[0, psi > 40.0], 0.0, atol=1e-6)
    level = written_level(found, data.view)
    np.testing.assert_allclose(part, step * level)
    u = found.onset_covariate(data.view, "drawbar_pull")
    there = found.onset(data.view, "drawbar_pull", u[:1])
    assert there[0][0, 0] == pytest.approx(0.5)


def test_an_onset_rises_by_its_width(data):
    """A logistic step of width 0.06, and a bend whose slope is that step."""
    found = of(data, onset_over="slip")
    u = found.onset_covariate(data.view, "drawbar_pull")
    for threshold in (-0.3, 0.2):
        step, bend, _ = found.onset(data.view, "drawbar_pull", np.array([threshold]))
        np.testing.assert_allclose(step[0], 1.0 / (1.0 + np.exp(-(u - threshold) / 0.06)))
        np.testing.assert_allclose(
            bend[0], 0.06 * np.log1p(np.exp((u - threshold) / 0.06)), rtol=1e-9, atol=1e-12
        )
