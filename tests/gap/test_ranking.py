"""Rankings of cases with known truth; prior odds, minimum sizes, designs."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS, physical_role
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import Case, Context
from calib.gap.constants import MIN_EFFECT_SIZE, PRIOR
from calib.gap.effects import EFFECTS
from calib.gap.hypotheses import singles
from calib.gap.identifiability import identifiability, next_measurements, smallest_shown
from calib.gap.mixture import inclusion_probability
from calib.gap.noise import Noise, noise_conditions
from calib.gap.odds import (
    Odds,
    likelihood_tempering,
    probabilities,
    sizes,
)
from calib.gap.plausibility import doubts
from calib.gap.ranking import calibrate_lab, rank
from calib.gap.screen import Screen
from calib.inference.mode import prior_widths
from tests.gap.cases import (
    CHOICE,
    LARGE,
    PULL_ONLY,
    campaigns_of,
    make_case,
    parameters,
    ranking_of,
)
from tests.gap.fits import SIGMA, draws_of, fit_at


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
            / ranking.shares[name]
        ) ** (1.0 / coarse)
        for name, value in ranking.log_evidence.items()
    }  # fmt: skip
    total = sum(odds.values())
    assert {n: v / total for n, v in odds.items()} == pytest.approx(ranking.probability)
    # Variants that the screen gave up are a part of what a name could have been.
    for name in ("none", "unknown", "parameter_shift", "lug_thrust"):
        assert ranking.shares[name] == pytest.approx(1.0)
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


CAUSES = ("rate_effect", "rut_rebound", "sensor_drift")


def mixed_case() -> Case:
    """Return a campaign in which three effects act, one on both outputs."""
    case = make_case("rate_effect")
    view = campaigns(case).view
    columns = dict(case.field.columns)
    for name in ("rut_rebound", "sensor_drift"):
        for output in case.models:
            if physical_role(output) in EFFECTS[name].outputs:
                column = OUTPUTS[output]
                phi = parameters(name, LARGE[name])
                log = output == "rut_depth"
                reading = np.log(columns[column]) if log else columns[column]
                read = EFFECTS[name].on_output(phi, physical_role(output), reading[None], view)[0]
                columns[column] = np.exp(read) if log else read
    return replace(case, name="mixed", field=table_from_arrays(columns))


def test_three_causes_are_found_whatever_comes_first_alone():
    ranking = rank(campaigns(mixed_case()), 1, effects=CHOICE)
    found = inclusion_probability(ranking.probability)
    assert [name for name in sorted(found) if found[name] >= 0.5] == list(CAUSES)
    # A set once, whatever it was made of: a second fit would count its evidence twice.
    assert len(ranking.fits["+".join(CAUSES)]) == 1


NAMES = [f"cause_{i}" for i in range(5)]


def prior(odds: Odds, name: str) -> float:
    return float(np.exp(odds.ln_prior(name)))


def test_none_one_cause_and_nothing_listed_share_all_the_probability():
    """With and without something unlisted beside a cause; several causes come on top."""
    odds = Odds(5, {})
    causes = ["parameter_shift", *NAMES]
    alone = [prior(odds, n) for n in causes]
    beside = [prior(odds, f"{n}+unknown") for n in causes]
    assert prior(odds, "none") + prior(odds, "unknown") + sum(alone + beside) == pytest.approx(1.0)
    assert prior(odds, "none") == pytest.approx(0.40)
    assert prior(odds, "unknown") == pytest.approx(0.12)
    assert alone[0] + beside[0] == pytest.approx(0.12)
    assert alone[1] + beside[1] == pytest.approx(0.36 / 5)
    # Something unlisted comes on top of a cause in 15 of 100 campaigns.
    assert beside == pytest.approx([0.15 / 0.85 * p for p in alone])


def test_each_cause_more_is_a_twenty_fifth_as_probable():
    odds = Odds(5, {})
    single = prior(odds, "cause_0")
    for n in (2, 3, 4):
        for some in combinations(NAMES, n):
            assert prior(odds, "+".join(some)) == pytest.approx(single / 25.0 ** (n - 1))
            beside = prior(odds, "+".join((*some, "unknown")))
            assert beside == pytest.approx(single / 25.0 ** (n - 1) * 0.15 / 0.85)


@pytest.mark.parametrize("p", [0.01, 0.3, 0.9])
@pytest.mark.parametrize(("name", "usual"), [("cause_0", 0.36 / 5), ("parameter_shift", 0.12)])
def test_a_suspicion_multiplies_the_odds_wherever_the_cause_is_a_part(name, usual, p):
    """By the ratio of the odds that it acts to what they are without a suspicion."""
    plain = Odds(5, {})
    suspecting = Odds.of(5, Context(suspected={name: p}))
    ratio = (p / (1.0 - p)) / (usual / (1.0 - usual))
    assert suspecting.n_single == 5
    for joint in (name, f"{name}+unknown"):
        assert prior(suspecting, joint) == pytest.approx(ratio * prior(plain, joint))
    both = f"cause_0+{NAMES[1]}"
    if name == "cause_0":
        assert prior(suspecting, both) == pytest.approx(ratio * prior(plain, both))
    for other in ("none", "unknown", NAMES[1], f"{NAMES[1]}+unknown"):
        assert suspecting.ln_prior(other) == plain.ln_prior(other)


def fit_of(case: str | None, name: str):
    return ranking_of(case).fits[name][0]


def test_size_is_in_noise_sds_of_the_output_where_it_is_largest():
    fit = fit_of("force_offset", "force_offset")
    psi = np.tile(fit.psi, (2, 1))
    part = fit.forward.phi_slices[0]
    psi[0, part], psi[1, part] = 0.0, 0.1
    size = sizes(fit.forward, fit.noise, psi)
    assert size.shape == (2, 1)
    assert size[0, 0] == pytest.approx(0.0, abs=1e-12)
    # Ruts, which an offset of the pull does not touch, make it no smaller.
    at = noise_conditions(fit.forward.data.view)
    in_noise = 0.1 / fit.noise["drawbar_pull"].sd(at)
    assert size[1, 0] == pytest.approx(np.sqrt(np.mean(np.square(in_noise))))


def test_the_prior_share_of_relevant_sizes_is_that_of_its_distribution():
    """Of an offset: a normal beyond 1.5 noise sds on either side, one in ten four times as wide."""
    data = campaigns_of("force_offset")
    lab_mode, noise = calibrate_lab(data, 1)
    (h,) = singles(data, {"force_offset": EFFECTS["force_offset"]})
    cause = Screen(data, lab_mode, noise, 1).cause(h)
    (prior,) = h.effect_priors[0].free
    at = noise_conditions(data.view).rows(data.outputs[0].rows)
    for bar, found in ((1.5, cause.ln_relevant), (1.0, cause.ln_relevant_in_set)):
        least = bar / np.sqrt(np.mean(np.square(1.0 / noise["drawbar_pull"].sd(at))))
        usual, wide = (
            norm.sf(least, prior.loc, sd) + norm.cdf(-least, prior.loc, sd)
            for sd in (prior.scale, 4.0 * prior.scale)
        )
        # Of a thousand draws of a Latin hypercube, the wide ones picked at random.
        assert np.exp(found) == pytest.approx(0.9 * usual + 0.1 * wide, abs=0.02)


def test_of_several_causes_the_size_of_each_is_what_goes_with_it():
    ranking = ranking_of("lug_thrust")
    name = next(n for n in ranking.order if n.count("+") == 1)
    fit = ranking.best(name)
    psi = fit.draws(np.random.default_rng(4), 5)
    found = sizes(fit.forward, fit.noise, psi)
    full = fit.forward.field(psi, fit.forward.data.view)
    for j, cause in enumerate(fit.forward.causes):
        rest = fit.forward.without(psi, fit.forward.data.view, cause)
        at = noise_conditions(fit.forward.data.view)
        written = np.max([
            np.sqrt(np.mean(np.square(
                (full[o.name] - rest[o.name])[:, o.rows] / fit.noise[o.name].sd(at.rows(o.rows))
            ), axis=1)) for o in fit.forward.data.outputs
        ], axis=0)  # fmt: skip
        np.testing.assert_allclose(found[:, j], written, rtol=1e-9)


def test_shares_sizes_and_cosines_are_in_their_ranges():
    design = ranking_of(None).identifiability
    names = set(design.absorbed)
    assert names == set(design.detectable)
    # Beside the effects only what the pull may depend on that no effect of these is about.
    assert names - set(CHOICE) == {"depends_on_pass_number"}
    for name in names:
        assert 0.0 <= design.absorbed[name] <= 1.0
        assert 0.05 < design.detectable[name] < 20.0
    for (a, b), cosine in design.cosine_similarity.items():
        assert a < b
        assert -1.0 - 1e-9 <= cosine <= 1.0 + 1e-9
    assert len(design.cosine_similarity) == len(names) * (len(names) - 1) // 2


def test_field_outcomes_do_not_matter():
    case = make_case(models={"drawbar_pull": "magic_formula"})
    columns = dict(case.field.columns)
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"][::-1] + 3.0
    other = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")}
    a, b = (rank(campaigns(c), 1, effects=few).identifiability for c in (case, other))
    assert a == b


def ranking_of_pull():
    few = {n: EFFECTS[n] for n in ("force_offset",)}
    return rank(campaigns_of(None, "pull"), 1, effects=few)


def test_what_parameters_can_imitate_is_absorbed():
    """The model of one pressure has a vertical shift: it takes up an offset, not a drift."""
    data = campaigns_of(None, "pull")
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    mode = {"drawbar_pull": ranking_of_pull().lab_mode["drawbar_pull"]}
    design = identifiability(data, singles(data, few), mode, {"drawbar_pull": Noise(0.03, 0.0)}, 1)
    assert design.absorbed["force_offset"] > design.absorbed["sensor_drift"]
    # With a laboratory that leaves more noise, everything is harder to see.
    noisy = identifiability(data, singles(data, few), mode, {"drawbar_pull": Noise(0.3, 0.0)}, 1)
    assert noisy.absorbed["force_offset"] != design.absorbed["force_offset"]


def test_more_rows_show_smaller_effects():
    few = {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")}
    models = {"drawbar_pull": "magic_formula"}
    sizes = []
    for n_field in (12, 48):
        data = campaigns(make_case(models=models, n_field=n_field))
        sizes.append(rank(data, 1, effects=few).identifiability.detectable)
    for name in few:
        ratio = sizes[0][name] / sizes[1][name]
        # Four times the rows halve the sd, but not the size from which on an effect counts.
        assert 1.05 < ratio < 2.0
    assert np.isfinite(list(sizes[1].values())).all()


def test_the_smallest_size_shown_is_that_of_the_bayes_factor():
    """Against a fine sum over a uniform prior from the relevant size on, and its limits."""
    prior = np.linspace(0.0, 10.0, 10_001)
    sd, ln_odds = 0.5, 5.0
    sizes = prior[prior >= MIN_EFFECT_SIZE]

    def ln_factor(estimate: float) -> float:
        with_effect = norm.pdf(estimate, sizes, sd).mean()
        return float(np.log(with_effect / norm.pdf(estimate, 0.0, sd)))

    threshold = brentq(lambda t: ln_factor(t) - ln_odds, 0.1, 5.0)
    found = smallest_shown(prior, sd, ln_odds)
    assert found == pytest.approx(threshold + norm.ppf(0.8) * sd, abs=0.01)
    assert smallest_shown(prior, 1e-3, ln_odds) == MIN_EFFECT_SIZE
    assert smallest_shown(prior[prior < MIN_EFFECT_SIZE], sd, ln_odds) == np.inf


def test_absorbed_is_what_the_calibrated_parameters_can_take_up():
    """Of an offset, by least squares: with J S J' worked out again by differences of differences.

    An offset d is d/sigma in every row; what is left of its square is g' (1 + J S J')^-1 g.
    """
    data = campaigns_of(None, "pull")
    (o,) = data.outputs
    mode, sigma = ranking_of_pull().lab_mode[o.name], 0.03
    scale = o.problem.priors.entries[-1]
    at = np.append(mode, np.log(sigma) if scale.log else sigma)
    width = 2e-3 * prior_widths(o.problem.priors)
    d = at.size

    def curvature(i, j):
        a, b = width[i] * np.eye(d)[i], width[j] * np.eye(d)[j]
        points = np.stack([at + a + b, at + a - b, at - a + b, at - a - b])
        return -(o.problem.log_prob(points) @ [1.0, -1.0, -1.0, 1.0]) / (4.0 * width[i] * width[j])

    covariance = np.linalg.inv([[curvature(i, j) for j in range(d)] for i in range(d)])
    conditions = o.problem.bound.model.select(data.view.conditions)

    def field(psi):
        return o.problem.bound.mean_response(o.priors.to_natural(psi[None]), conditions)[0, o.rows]

    steps = np.diag(width[:-1])
    jacobian = np.stack([(field(mode + s) - field(mode - s)) / (2.0 * s.sum()) for s in steps])
    jacobian = jacobian.T / sigma
    c = np.eye(o.rows.size) + jacobian @ covariance[:-1, :-1] @ jacobian.T
    one = np.ones(o.rows.size)
    left = one @ np.linalg.solve(c, one)
    single = singles(data, {"force_offset": EFFECTS["force_offset"]})
    design = identifiability(data, single, {o.name: mode}, {o.name: Noise(sigma, 0.0)}, 1)
    assert design.absorbed["force_offset"] == pytest.approx(1.0 - left / one.size, rel=0.01)
    # Smallest size: its estimate has the sd 1/sqrt(left), its size is |d|/sigma.
    prior = np.abs(single[0].effect_priors[0].sample(np.random.default_rng(3), 4096)[:, 0]) / sigma
    ln_odds = np.log(10.0) + np.log(PRIOR["none"] / PRIOR["single"])
    expected = smallest_shown(prior, left**-0.5, ln_odds)
    # Of one thousand draws against four thousand others.
    assert design.detectable["force_offset"] == pytest.approx(expected, rel=0.05)


def tied(case: str | None, *names: str):
    """Return a ranking in which only some hypotheses are probable."""
    ranking = ranking_of(case)
    p = dict.fromkeys(ranking.probability, 0.0) | {n: 1.0 / len(names) for n in names}
    return replace(ranking, probability=p)


def test_thrust_that_grows_with_slip_is_told_from_an_offset_at_an_end_of_the_slips():
    # The two were fitted to the same rows and cross in the middle of them.
    data = campaigns_of("lug_thrust")
    (found,) = next_measurements(data, tied("lug_thrust", "lug_thrust", "force_offset").in_play, 1)
    slip = found.conditions["slip_ratio"]
    assert slip < 0.15 or slip > 0.5


def test_at_most_three_in_play_are_told_apart_and_none_that_is_improbable():
    data = campaigns_of("sensor_drift")
    names = ["sensor_drift", "force_offset", "none", "lug_thrust"]
    ranking = ranking_of("sensor_drift")
    p = dict.fromkeys(ranking.probability, 0.0) | dict(
        zip(names, (0.5, 0.3, 0.15, 0.05), strict=True)
    )
    pairs = {
        m.separates for m in next_measurements(data, replace(ranking, probability=p).in_play, 1)
    }
    assert pairs == set(combinations(names[:3], 2))
    p |= {"force_offset": 0.03, "none": 0.029, "lug_thrust": 0.0}
    (one,) = next_measurements(data, replace(ranking, probability=p).in_play, 1)
    assert one.separates == ("sensor_drift", "force_offset")


def offset_of(data, offset: float, sd: float = 0.0):
    (single,) = singles(data, {"force_offset": CHOICE["force_offset"]})
    found = fit_at(data, single)
    part = found.forward.phi_slices[0]
    psi, root = found.psi.copy(), np.zeros_like(found.covariance)
    psi[part] = offset
    root[part, part] = sd
    return replace(found, sample=draws_of(psi, root))


def test_two_in_play_are_told_apart_where_their_gain_is_largest():
    """Offsets of known sizes: the same gain everywhere, that of two normals."""
    data = campaigns_of(None)
    fits = {"one": offset_of(data, 0.0), "other": offset_of(data, 0.3)}
    (found,) = next_measurements(data, fits, 1)
    assert found.separates == ("one", "other")
    assert np.isclose(found.gain_nats, 0.5 * (0.3 / SIGMA["drawbar_pull"]) ** 2)
    assert found.output == "drawbar_pull"
    (one, sd), (other, _) = found.expected
    assert np.isclose(other - one, 0.3)
    assert np.isclose(sd, SIGMA["drawbar_pull"])


def test_too_few_draws_of_an_explanation_in_play_are_said_first():
    ranking = ranking_of("force_offset")
    data = ranking.best("none").forward.data
    assert not any("converge" in remark.text for remark in doubts(data, ranking))
    few = tuple(replace(fit, effective=40.0) for fit in ranking.fits["force_offset"])
    starved = replace(ranking, fits={**ranking.fits, "force_offset": few})
    assert doubts(data, starved)[0].title == (
        "the sampler did not converge: too few effective draws of force_offset (40)"
    )
