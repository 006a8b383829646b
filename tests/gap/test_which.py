"""Which: probabilities are probabilities, and large effects are named when they are there."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import Case
from calib.gap.constants import MIN_EFFECT_SIZE
from calib.gap.effects import EFFECTS
from calib.gap.hypotheses import dependences
from calib.gap.mixture import inclusion_probability
from calib.gap.odds import Odds, likelihood_tempering, probabilities, sizes
from calib.gap.ranking import _scores, calibrate_lab, rank
from tests.gap.cases import CHOICE, LARGE, PULL_ONLY, campaigns_of, make_case, ranking_of


@pytest.mark.parametrize("name", [None, *LARGE])
def test_probabilities_sum_to_one_over_all_hypotheses(name):
    ranking = ranking_of(name)
    assert sum(ranking.probability.values()) == pytest.approx(1.0, abs=1e-12)
    assert set(ranking.probability) == set(ranking.fits) == set(ranking.log_evidence)
    assert {"none", "unknown", "parameter_shift", *CHOICE} <= set(ranking.probability)
    assert min(ranking.probability.values()) >= 0.0
    p = [ranking.probability[n] for n in ranking.order]
    assert p == sorted(p, reverse=True)


def test_a_field_campaign_of_the_simulator_itself_has_no_gap():
    ranking = ranking_of(None)
    assert ranking.order[0] == "none"
    assert ranking.probability["none"] > 0.8


@pytest.mark.parametrize("name", LARGE)
def test_a_large_effect_comes_first(name):
    # Simulated by its own formula, at a size of four noise sds: not naming it would be a defect.
    ranking = ranking_of(name)
    assert ranking.order[0] == name
    assert ranking.probability[name] > 0.5
    assert ranking.probability["none"] < 0.01


def test_pairs_are_named_in_alphabetical_order_and_contain_good_singles():
    ranking = ranking_of("lug_thrust")
    sets = [n.removesuffix("+unknown") for n in ranking.fits if "+" in n]
    assert sets
    for n in sets:
        parts = n.split("+")
        assert parts == sorted(parts)
        assert set(parts) <= {*CHOICE, "parameter_shift", *dependences(campaigns_of("lug_thrust"))}


def test_untestable_effects_are_listed_and_not_fitted():
    data = campaigns_of("sensor_drift", "pull")
    few = {n: EFFECTS[n] for n in ("force_offset", "rut_rebound", "moisture_softening")}
    ranking = rank(data, 1, effects=few)
    assert set(ranking.not_testable) == {"rut_rebound", "moisture_softening"}
    assert not any("rut_rebound" in n for n in ranking.fits)


def test_a_large_gap_is_not_surer_than_shapes_are_known():
    evidence = {"none": -300.0, "a": 0.0, "b": -4.0}
    odds = Odds(2, {})
    assert likelihood_tempering(0.0) == 1.0
    assert likelihood_tempering(5.0) == pytest.approx(1.16)
    assert likelihood_tempering(7.5) == likelihood_tempering(30.0) == pytest.approx(1.36)
    plain, coarse = (probabilities(evidence, odds, likelihood_tempering(g)) for g in (0.0, 20.0))
    assert plain["a"] / plain["b"] == pytest.approx(np.exp(4.0))
    assert coarse["a"] / coarse["b"] == pytest.approx(np.exp(4.0 / 1.36))
    assert sum(coarse.values()) == pytest.approx(1.0)


def test_the_gap_is_as_large_as_the_best_explanation_has_it():
    ranking = ranking_of("force_offset")
    fit = ranking.best(ranking.order[0])
    assert ranking.order[0] == "force_offset"
    assert ranking.gap == pytest.approx(sizes(fit.forward, fit.noise, fit.psi[None])[0, 0])
    assert ranking.gap > MIN_EFFECT_SIZE
    assert ranking_of(None).gap == 0.0


def test_an_effect_that_changes_nothing_is_not_testable():
    # Plain Bekker has no slip, so that a wrong rolling radius cannot show in the rut.
    case = make_case(None, models={"rut_depth": "bekker"})
    few = {n: EFFECTS[n] for n in ("slip_zero_shift", "rut_rebound")}
    ranking = rank(campaigns(case), 1, effects=few)
    assert "changes nothing" in ranking.not_testable["slip_zero_shift"]
    assert "slip_zero_shift" not in ranking.probability


def test_a_warming_gauge_is_found_from_several_guesses():
    # From the middle of its prior the climb ends in another mode, a drift late in the campaign.
    size = {"drift": -0.35, "curvature": 0.35, "zero_at": 0.0}
    data = campaigns(make_case("sensor_drift", size=size, models=PULL_ONLY))
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    ranking = rank(data, 1, effects=few)
    (found,) = ranking.fits["sensor_drift"]
    phi = found.forward.hypothesis.effect_priors[0].to_natural(
        found.psi[None, found.forward.phi_slices[0]]
    )[0]
    assert phi[0] < -0.2
    assert phi[1] < 0.8
    assert ranking.order[0] == "sensor_drift"


# Of the size of five noise sds: a step of them, a drift of them in the rms from zero at its start.
OVER_ORDER = {
    "sensor_step": {"jump": 0.15, "zero_at": 0.0, "change_point": 0.5, "duration": 1e-9},
    "sensor_drift": {"drift": 0.26, "curvature": 1.0, "half_way": 10.0, "zero_at": 0.0},
    None: {},
}


@pytest.mark.parametrize("name", OVER_ORDER)
@pytest.mark.parametrize("seed", [1, *(pytest.param(s, marks=pytest.mark.slow) for s in (2, 3))])
def test_a_step_and_a_drift_are_told_apart(name, seed):
    case = make_case(name, size=OVER_ORDER[name], models=PULL_ONLY, seed=seed)
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "sensor_step", "lug_thrust")}
    ranking = rank(campaigns(case), 1, effects=few)
    assert ranking.order[0] == (name or "none")
    assert inclusion_probability(ranking.probability).get(name or "", 1.0) >= 0.8


# Eight noise sds from end to end, in forms that are no effect's own; seeds as they come.
FORMS = {
    "settling": ("sensor_drift", lambda u: -np.expm1(-u / 0.3)),
    "late": ("sensor_drift", lambda u: np.clip((u - 0.2) / 0.6, 0.0, 1.0)),
    "at once": ("sensor_step", lambda u: (u > 0.35) * 1.0),
    "slipping for three runs": ("sensor_step", lambda u: np.clip((u - 0.6) / 0.1, 0.0, 1.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(11, 15))
def test_whatever_its_form_no_change_over_the_runs_is_surely_called_another(form, seed):
    """Named is one of the two, and the other not with nine tenths."""
    name, shape = FORMS[form]
    case = make_case(None, models=PULL_ONLY, seed=seed, n_field=30)
    columns = {column: np.array(v) for column, v in case.field.columns.items()}
    u = columns["run_order"] / columns["run_order"].max()
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"] + 0.24 * shape(u)
    case = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "sensor_step", "lug_thrust")}
    acting = inclusion_probability(rank(campaigns(case), 1, effects=few).probability)
    drift, step = (acting.get(n, 0.0) for n in ("sensor_drift", "sensor_step"))
    assert drift + step >= 0.9
    assert (step if name == "sensor_drift" else drift) < 0.9


# Of ruts, whose noise is 0.05 on their logarithm.
RUTS_OVER_ORDER = {
    "rut_depth_step": lambda u: 0.25 * (u > 0.45),
    "rut_depth_drift": lambda u: 0.45 * u,
    None: lambda u: 0.0 * u,
}


def scaled_ruts(case, change):
    """Read the ruts of a field campaign wrong by a factor that changes over the runs."""
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    u = columns["run_order"] / columns["run_order"].max()
    columns["rut_depth_mm"] = columns["rut_depth_mm"] * np.exp(change(u))
    return replace(case, field=table_from_arrays(columns))


@pytest.mark.parametrize("name", RUTS_OVER_ORDER)
def test_a_gauge_of_ruts_that_jumps_or_drifts_is_named(name):
    case = scaled_ruts(make_case(None, n_field=30), RUTS_OVER_ORDER[name])
    few = {n: EFFECTS[n] for n in ("sensor_drift", "rut_rebound", "slip_zero_shift")}
    ranking = rank(campaigns(case), 1, effects=few)
    assert ranking.order[0] == (name or "none")
    assert inclusion_probability(ranking.probability).get(name or "", 1.0) >= 0.8
    # Where nothing follows the runs they are not worth a fit.
    assert ("rut_depth_step" in ranking.fits) == ("rut_depth_drift" in ranking.fits)
    assert ("rut_depth_step" in ranking.fits) == (name is not None)


def test_ground_that_changes_over_the_runs_is_no_instrument():
    """Pull and ruts change together: it is unlisted, and not the drift of one reading."""
    case = scaled_ruts(make_case(None, n_field=30), lambda u: 0.45 * u)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"] - 0.009 * columns["run_order"]
    case = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("sensor_drift", "sensor_step", "rut_rebound")}
    ranking = rank(campaigns(case), 1, effects=few)
    assert ranking.order[0] == "unknown"
    best = ranking.best("unknown").forward.hypothesis
    assert "order" in (best.smooth_over, best.onset_over)
    assert best.smooth_outputs == ("drawbar_pull", "rut_depth")
    acting = inclusion_probability(ranking.probability)
    assert max(p for name, p in acting.items() if name != "unknown") < 0.1


def wave(data, output: str, size: float):
    """Add three waves over the order of the runs to an output: nothing that is listed."""
    columns = {name: np.array(v) for name, v in data.field.columns.items()}
    u = columns["run_order"] / columns["run_order"].max()
    columns[OUTPUTS[output]] = columns[OUTPUTS[output]] + size * np.sin(6.0 * np.pi * u)
    return replace(data, field=table_from_arrays(columns))


@pytest.mark.parametrize("size", [0.15, 0.4, 0.6])
def test_waves_along_the_campaign_are_unknown(size):
    """The larger ones had been given up for noise after one step, before the noise was told."""
    case = wave(make_case(None, models=PULL_ONLY, n_field=36), "drawbar_pull", size)
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "lug_thrust")}
    ranking = rank(campaigns(case), 1, effects=few)
    assert ranking.order[0] == "unknown"
    best = int(np.argmax(ranking.scores["unknown"]))
    assert ranking.fits["unknown"][best].forward.hypothesis.smooth_over == "order"


def test_short_waves_over_slip_are_neither_noise_nor_listed():
    case = make_case(None, models=PULL_ONLY, n_field=36)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    wave = np.sin(2.0 * np.pi * columns["slip_ratio"] / 0.09)
    columns[OUTPUTS["drawbar_pull"]] = columns[OUTPUTS["drawbar_pull"]] + 0.15 * wave
    few = {n: EFFECTS[n] for n in ("force_offset", "post_peak_softening", "lug_thrust")}
    ranking = rank(campaigns(replace(case, field=table_from_arrays(columns))), 1, effects=few)
    assert ranking.order[0] == "unknown"
    assert ranking.probability["unknown"] > 0.9
    best = int(np.argmax(ranking.scores["unknown"]))
    assert ranking.fits["unknown"][best].forward.hypothesis.smooth_over == "ripple"


def test_a_wheel_that_hops_at_one_pressure_is_unknown():
    case = make_case(None, models=PULL_ONLY, n_field=36)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    pressure = columns["inflation_pressure_psi"]
    pull = columns[OUTPUTS["drawbar_pull"]]
    columns[OUTPUTS["drawbar_pull"]] = np.where(pressure == np.median(pressure), 0.85, 1.0) * pull
    few = {n: EFFECTS[n] for n in ("force_offset", "pressure_gauge_bias", "load_transfer")}
    ranking = rank(campaigns(replace(case, field=table_from_arrays(columns))), 1, effects=few)
    assert ranking.order[0] == "unknown"
    assert ranking.probability["unknown"] > 0.9
    best = int(np.argmax(ranking.scores["unknown"]))
    assert ranking.fits["unknown"][best].forward.hypothesis.smooth_over == "pressure"


def test_a_recorder_that_keeps_half_of_the_run_before_is_unknown():
    case = make_case(None, models=PULL_ONLY, n_field=36)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    pull = columns[OUTPUTS["drawbar_pull"]]
    columns["run_order"] = np.random.default_rng(4).permutation(pull.size).astype(float)
    runs = np.argsort(columns["run_order"])
    pull[runs[1:]] = 0.5 * (pull[runs[1:]] + pull[runs[:-1]])
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "slip_zero_shift")}
    ranking = rank(campaigns(replace(case, field=table_from_arrays(columns))), 1, effects=few)
    assert ranking.order[0] == "unknown"
    best = int(np.argmax(ranking.scores["unknown"]))
    assert ranking.fits["unknown"][best].forward.hypothesis.smooth_over == "before"


def test_what_a_listed_effect_leaves_is_unknown():
    case = wave(make_case("force_offset", models=PULL_ONLY, n_field=36), "drawbar_pull", 0.15)
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "lug_thrust")}
    ranking = rank(campaigns(case), 1, effects=few)
    assert ranking.order[0] == "unknown"


def test_prior_and_evidence_give_the_probabilities():
    ranking = ranking_of("lug_thrust")
    assert sum(ranking.prior.values()) == pytest.approx(1.0)
    coarse = 1.0 + min(0.08 * ranking.gap, 0.6) ** 2
    assert coarse > 1.02
    odds = {
        name: (
            ranking.prior[name] * np.exp(value - max(ranking.log_evidence.values()))
            / min(sum(f.forward.hypothesis.share for f in ranking.fits[name]), 1.0)
        ) ** (1.0 / coarse)
        for name, value in ranking.log_evidence.items()
    }  # fmt: skip
    total = sum(odds.values())
    assert {n: v / total for n, v in odds.items()} == pytest.approx(ranking.probability)
    assert ranking.prior["lug_thrust"] == pytest.approx(ranking.prior["force_offset"])
    assert ranking.prior["lug_thrust"] > ranking.prior["force_offset+lug_thrust"] > 0.0


@pytest.mark.parametrize(("braked", "lines"), [("lab", "lines 0"), ("field", "lines 11")])
def test_rows_without_a_value_are_refused_by_line(braked, lines):
    """A braked wheel (slip below zero) has no value in Wong and Reece's model."""
    n = 12
    slip = np.linspace(0.05, 0.4, n)
    columns = {
        "slip_ratio": slip, "normal_load_kn": np.full(n, 2.0), "tyre_width_m": np.full(n, 0.2),
        "tyre_diameter_m": np.full(n, 0.8), "drawbar_pull_kn": 0.6 * np.tanh(5.0 * slip),
    }  # fmt: skip
    tables = {"lab": columns, "field": columns | {"run_order": np.arange(n)}}
    below = {"lab": np.where(np.arange(n) == 0, -0.05, slip), "field": np.append(slip[:-1], -0.05)}
    tables[braked] = tables[braked] | {"slip_ratio": below[braked]}
    lab, field = (table_from_arrays(tables[k]) for k in ("lab", "field"))
    case = Case("braked", lab, changed(field), {"drawbar_pull": "wong_reece_pull"})
    with pytest.raises(CalibError, match=r"wong_reece_pull has no value there") as error:
        calibrate_lab(campaigns(case), 1)
    assert error.value.where.endswith(lines)


def changed(table):
    columns = {**table.columns, "drawbar_pull_kn": 1.1 * table["drawbar_pull_kn"]}
    return table_from_arrays(columns)


def test_a_score_is_evidence_times_relevance_times_share(monkeypatch):
    fit = ranking_of("force_offset").fits["force_offset"][0]
    hypothesis = replace(fit.forward.hypothesis, share=0.3)
    forward = copy(fit.forward)
    forward.hypothesis = hypothesis
    shared = replace(fit, forward=forward)
    monkeypatch.setattr(
        "calib.gap.ranking.ln_size_restriction", lambda asked, _: [-2.0 for _ in asked]
    )
    assert _scores([(shared, 100), (fit, 100)], 1) == pytest.approx(
        [fit.log_evidence - 2.0 + np.log(0.3), fit.log_evidence - 2.0]
    )
    monkeypatch.undo()
    # Whose relevance is not asked after, it is not restricted to.
    assert _scores([(shared, 0)], 1) == pytest.approx([fit.log_evidence + np.log(0.3)])
