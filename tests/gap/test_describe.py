"""What is computed of a diagnosis to be shown: sizes, parameters, changes over the runs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.describe import (
    gap_document,
    over_runs,
    parameter,
    repeats_needed,
    sizes,
)
from calib.gap.describe import (
    unlisted as unlisted_of,
)
from calib.gap.diagnose import Diagnosis, diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.effects.user import load_effects
from calib.gap.hypotheses import Hypothesis
from calib.gap.identifiability import NextMeasurement
from calib.inference.priors import Prior
from tests.gap.cases import PULL_ONLY, diagnosis_of, make_case, pull_diagnosis
from tests.gap.test_load_effects import CODE, write

FEW = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}


@pytest.fixture(scope="module")
def found():
    return diagnosis_of("sensor_drift")


@pytest.fixture(scope="module")
def document(found):
    return gap_document(found)


def changed(change, **kwargs):
    """Return a case whose field has other readings."""
    case = make_case(None, n_field=36, n_fresh=3, **kwargs)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    columns |= change(columns)
    return replace(case, field=table_from_arrays(columns))


def prior(**changes) -> Prior:
    base = {"name": "a", "unit": "kN", "reason": "", "source": "", "text": "", "log": False,
            "loc": 0.0, "scale": 1.0}  # fmt: skip
    return Prior(**(base | changes))


@pytest.mark.parametrize(
    ("given", "value", "sd", "form", "shown", "of_prior"),
    [
        (prior(), 0.13, 0.04, "value", (0.13, 0.04), False),
        (prior(lower=0.0), 0.0, 0.02, "limit", (0.0329,), False),
        (prior(lower=0.0), 0.1, 0.02, "value", (0.1, 0.02), False),
        (prior(), 0.1, 0.98, "value", (0.1, 0.98), True),
        (prior(log=True), math.log(2.0), 0.1, "value", (2.0, 0.2), False),
        (prior(log=True), math.log(2.0), 0.7, "range", (2.0, 0.632, 6.325), False),
        # Uniform from 0 to 1: as wide as before the data, or narrowed.
        (prior(scale=math.inf, lower=0.0, upper=1.0), 0.9, 1.8, "value", (0.5, 0.289), True),
        (prior(scale=math.inf, lower=0.0, upper=1.0), 0.2, 0.25, "limit", (0.611,), False),
        # A half-normal's sd is 0.60 of its scale: one of 0.58 has learnt nothing.
        (prior(lower=0.0), 0.0, 0.58, "limit", (0.954,), True),
    ],
)
def test_parameters_are_as_precise_as_they_are_known(given, value, sd, form, shown, of_prior):
    p = parameter("effect", given, value, sd)
    assert (p.form, p.of_prior) == (form, of_prior)
    assert p.shown == pytest.approx(shown, rel=2e-3)
    assert p.mean == pytest.approx(math.exp(value) if given.log else value)
    assert p.sd == pytest.approx(sd * p.mean if given.log else sd)


def test_the_size_is_that_of_the_drift(document):
    (size,) = document.sizes
    assert (size.kind, size.quantity, size.reads, size.place) == (
        "end",
        "drawbar_pull",
        True,
        "end",
    )
    # The last fifth of a drift of 0.25 kN: 0.9 of it on average.
    assert abs(size.mean - 0.225) < 4.0 * size.sd


def test_a_check_of_a_drift_has_both_ends(found, document):
    """What the reading has too much at the first run and at the last: the formula, by hand."""
    expected = next(c for c in document.causes if c.name == "sensor_drift").expected
    name = next(n for n in found.ranking.order if "sensor_drift" in n)
    fit = found.ranking.best(name)
    i = [e.name for e in fit.forward.hypothesis.effects].index("sensor_drift")
    psi = fit.draws(np.random.default_rng(1), 4000)[:, fit.forward.phi_slices[i]]
    natural = fit.forward.hypothesis.effect_priors[i].to_natural(psi)
    drift, curvature, half_way, zero_at = natural.T
    for u, (mean, sd) in ((1e-3, expected.first), (1.0, expected.last)):
        grown = (1 + half_way**curvature) * u**curvature / (u**curvature + half_way**curvature)
        by_hand = drift * (grown - zero_at)
        assert abs(mean - by_hand.mean()) < 0.35 * by_hand.std()
        assert sd == pytest.approx(by_hand.std(), rel=0.2)


def test_a_step_names_its_run():
    size = {"jump": -0.2, "zero_at": 0.0, "change_point": 12.5 / 26.0, "duration": 1e-9}
    case = make_case("sensor_step", size=size, models=PULL_ONLY)
    few = FEW | {"sensor_step": EFFECTS["sensor_step"]}
    (step,) = sizes(diagnose_once(case, 1, effects=few), "sensor_step")
    assert abs(step.mean + 0.2) < 4.0 * step.sd
    assert step.ends == (12, 12)


def test_a_step_that_takes_some_runs_is_between_two_and_relative_of_ruts():
    """Of ruts in parts of them, for their logarithm is compared."""

    def rising(columns):
        part = np.clip((columns["run_order"] - 17.0) / 6.0, 0.0, 1.0)
        return {"rut_depth_mm": columns["rut_depth_mm"] * 1.8**part}

    few = {n: EFFECTS[n] for n in ("sensor_drift", "rut_rebound")}
    (step,) = sizes(diagnose_once(changed(rising), 1, effects=few), "rut_depth_step")
    assert step.relative
    assert abs(step.mean - 0.8) < 4.0 * step.sd
    # From the seventeenth to the twenty-third, within two runs.
    assert step.ends == pytest.approx((17, 23), abs=2)


def test_sizes_of_other_kinds_of_effect(found):
    (size,) = sizes(diagnosis_of("slip_zero_shift"), "slip_zero_shift")
    assert (size.kind, size.quantity) == ("condition", "slip_ratio")
    # 5 % of (1 - slip), whose mean is 0.665.
    assert abs(size.mean - 0.0333) < 4.0 * size.sd
    assert [*sizes(found, "none")] == []
    pair, *_ = sizes(found, "force_offset+sensor_drift")
    assert (pair.kind, pair.together) == ("rms", True)


def test_what_comes_and_goes_has_no_size_at_an_end(tmp_path):
    # Wind on every other run: over the last runs its mean is half of what it is in a gust.
    code = CODE.replace("phi[:, :1]", 'phi[:, :1] * (view.of("order") % 2.0)')
    code = code.replace("    outputs =", '    covariates = ("order",)\n    outputs =')

    def gusts(columns):
        return {"drawbar_pull_kn": columns["drawbar_pull_kn"] + 0.2 * (columns["run_order"] % 2.0)}

    effects = load_effects(write(tmp_path, code))
    found = diagnose_once(changed(gusts, models=PULL_ONLY), 1, effects=effects)
    assert found.ranking.order[0] == "cross_wind"
    (size,) = sizes(found, "cross_wind")
    assert size.kind == "rms"
    assert size.mean == pytest.approx(0.2 * math.sqrt(0.5), abs=0.03)


def saturating(columns):
    """An amplifier that saturates: no reading above 0.9 kN."""
    return {"drawbar_pull_kn": np.minimum(columns["drawbar_pull_kn"], 0.9)}


def creeping(columns):
    """Below 24 psi the bead creeps on the rim: a third of the pull above 0.6 kN is lost."""
    pull, psi = columns["drawbar_pull_kn"], columns["inflation_pressure_psi"]
    lost = np.where(psi < 24.0, 0.35 * np.maximum(pull - 0.6, 0.0), 0.0)
    return {"drawbar_pull_kn": pull - lost}


def rocking(columns):
    """Lugs that pass one by one rock the pull by 0.15 kN; the noise is a fifth of that."""
    wave = np.sin(2.0 * np.pi * columns["slip_ratio"] / 0.09)
    return {"drawbar_pull_kn": columns["drawbar_pull_kn"] + 0.15 * wave}


@pytest.mark.parametrize(
    ("change", "models", "over", "column", "low", "high"),
    [
        (saturating, PULL_ONLY, "level", "drawbar_pull_kn", 0.8, 1.0),
        (creeping, None, "low_pressure", "inflation_pressure_psi", 18.0, 30.0),
        (rocking, PULL_ONLY, "ripple", "", 0.0, 0.0),
    ],
)
def test_what_is_unlisted_goes_along_with_something(change, models, over, column, low, high):
    case = changed(change, **({"models": models} if models else {}))
    few = FEW if models else FEW | {"pressure_gauge_bias": EFFECTS["pressure_gauge_bias"]}
    found = diagnose_once(case, 1, effects=few)
    assert found.verdict == "unknown"
    lead = unlisted_of(found)
    assert (lead.over, lead.column) == (over, column)
    if lead.threshold:
        assert low < lead.threshold[0] < high
    else:
        # Of the variant that is believed, not of one that takes the waves for noise.
        assert gap_document(found).outputs[0].noise.sigma < 0.08
    assert (lead.surest is None) is (over == "ripple")


def test_effects_that_a_missing_column_hides_are_found(found, document):
    assert not document.untested
    assert not document.assumed
    ranking = replace(
        found.ranking,
        not_testable={
            "moisture_softening": "the data lack gravimetric_water_content",
            "cone_index_bias": "no bulk_density output",
        },
    )
    lab = {n: v for n, v in found.data.view.lab.items() if n != "speed_m_s"}
    data = replace(found.data, view=replace(found.data.view, lab=lab))
    whole, *parts = gap_document(replace(found, ranking=ranking, data=data)).untested
    assert (whole.name, whole.reason) == (
        "moisture_softening", "the data lack gravimetric_water_content",
    )  # fmt: skip
    assert any((p.name, p.lacking) == ("rate_effect", ("speed_m_s",)) for p in parts)


@pytest.mark.parametrize(
    ("other", "matters", "last"),
    [
        ("lug_thrust", (), False),
        ("rate_effect", ("speed_m_s",), False),
        ("sensor_drift", (), True),
        ("unknown", ("speed_m_s",), True),
    ],
)
def test_conditions_that_neither_hypothesis_depends_on_are_not_asked_for(
    found, other, matters, last
):
    conditions = {
        "slip_ratio": 0.651, "normal_load_kn": 5.0, "inflation_pressure_psi": 42.0,
        "average_ground_pressure_kpa": 178.0, "speed_m_s": 2.0, "run_order": 26.0,
    }  # fmt: skip
    one = NextMeasurement(
        ("force_offset", other), conditions, 1.0, "drawbar_pull", ((1.0, 0.1), (1.2, 0.1))
    )
    (m,) = gap_document(replace(found, next_measurements=(one,))).next_measurements
    assert (m.matters, m.last) == (("slip_ratio", "inflation_pressure_psi", *matters), last)


def test_measurements_that_cannot_help_are_not_asked_for():
    needed = [repeats_needed(gain) for gain in (1.2, 5.0, 0.001, 0.0, math.nan)]
    assert needed == [3, 1, None, None, None]


def test_it_holds_what_was_found(found, document):
    assert document.probability == {n: found.ranking.probability[n] for n in found.ranking.order}
    assert document.judged_on == "new conditions"
    pull = document.outputs[0]
    np.testing.assert_array_equal(pull.measured, found.data.case.field["drawbar_pull_kn"])
    before, after = (np.array(pull.measured) - v for v in (pull.before, pull.after))
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    assert sum(e.prior for e in document.explanations) == pytest.approx(1.0)
    slip = np.concatenate([t["slip_ratio"] for t in (found.data.case.lab, found.data.case.field)])
    assert document.covered["slip_ratio"] == (slip.min(), slip.max())
    case = replace(found.data.case, new_conditions=None)
    own = gap_document(replace(found, data=replace(found.data, case=case)))
    assert (own.judged_on, own.parts) == ("rows left out", 5)
    assert len({(p.effect, p.name) for p in document.definitions}) == len(document.definitions)


# Changes over the order of the runs


def with_probabilities(found: Diagnosis, **p: float) -> Diagnosis:
    """The same diagnosis with explanations as probable as is said, all others impossible."""
    zero = dict.fromkeys(found.ranking.probability, 0.0)
    return replace(found, ranking=replace(found.ranking, probability=zero | p))


class OfHypothesis:
    """A forward model of which only the hypothesis is looked at."""

    def __init__(self, hypothesis: Hypothesis) -> None:
        self.hypothesis = hypothesis


def unlisted(outputs: tuple[str, ...], **over: str) -> Hypothesis:
    return Hypothesis("unknown", smooth=1.5, smooth_outputs=outputs, **over)


@pytest.fixture(scope="module")
def weighed() -> Diagnosis:
    """Pull and ruts, with every kind of explanation over the runs among those that were fitted."""
    base = diagnosis_of("sensor_drift")
    (drift, *_) = base.ranking.fits["sensor_drift"]
    pull, rut = ("drawbar_pull",), ("rut_depth",)
    variants = {
        unlisted(pull, smooth_over="order"): 0.5, unlisted(pull, smooth_over="slip"): 0.2,
        unlisted(pull + rut, onset_over="order"): 0.3,
    }  # fmt: skip
    step = Hypothesis("sensor_step", (EFFECTS["sensor_step"],))
    fits = dict(base.ranking.fits) | {
        "sensor_step": (replace(drift, forward=OfHypothesis(step)),),
        "unknown": tuple(replace(drift, forward=OfHypothesis(h)) for h in variants),
    }
    scores = dict(base.ranking.scores) | {"unknown": tuple(np.log([*variants.values()]) + 7.0)}
    return replace(base, ranking=replace(base.ranking, fits=fits, scores=scores))


def test_all_explanations_with_it_are_added_up_each_once(weighed):
    fact = over_runs(with_probabilities(
        weighed, none=0.05, sensor_drift=0.3, sensor_step=0.2, unknown=0.2,
        **{"force_offset+sensor_drift": 0.1, "sensor_drift+sensor_step": 0.15},
    ))  # fmt: skip
    assert fact is not None
    assert (fact.outputs, fact.together, fact.only) == (("drawbar_pull",), False, False)
    assert dict(fact.forms) == pytest.approx({
        "drift": 0.4, "step": 0.2, "both": 0.15, "neither": 0.1,
    })  # fmt: skip
    assert fact.probability == pytest.approx(0.85)
    assert fact.forms[0][0] == "drift"
    assert fact.surest == pytest.approx(0.55)


def test_of_several_outputs_only_what_is_unlisted_changes_them_together(weighed):
    fact = over_runs(with_probabilities(weighed, sensor_drift=0.2, unknown=0.8))
    assert fact is not None
    assert fact.together is False  # 0.2 and half of 0.8 beside 0.24
    scores = dict(weighed.ranking.scores) | {"unknown": (0.0, 0.0, 4.0)}
    other = replace(weighed, ranking=replace(weighed.ranking, scores=scores))
    fact = over_runs(with_probabilities(other, sensor_drift=0.2, unknown=0.8))
    assert fact is not None
    assert (fact.outputs, fact.together) == (("drawbar_pull", "rut_depth"), True)
    assert fact.probability == pytest.approx(0.8 * np.exp(4.0) / (2.0 + np.exp(4.0)))
    assert fact.forms == (("neither", fact.probability),)


def test_where_nothing_follows_the_runs_nothing_is_said(weighed):
    assert over_runs(with_probabilities(weighed, none=0.97, sensor_drift=0.03)) is None


def test_where_one_output_is_measured_it_is_said():
    fact = over_runs(pull_diagnosis("sensor_drift"))
    assert fact is not None
    assert fact.only
    assert fact.forms[0][0] == "drift"
    assert fact.probability > 0.9
