"""What an engineer knows changes what is believed beforehand, and is told from what is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import CalibError
from calib.gap.case import read_case
from calib.gap.context import Context, Size, read_context
from calib.gap.diagnose import diagnose_once
from calib.gap.odds import Odds
from calib.report.gap_evidence import gap_evidence
from calib.report.gap_verdict import judge_gap
from tests.gap.cases import PULL_ONLY, make_case, write_case


def test_suspicion_multiplies_the_odds_of_every_explanation_with_the_cause():
    plain, given = Odds.of(10, Context()), Odds.of(10, Context({"lug_thrust": 0.5}))
    for name in ("lug_thrust", "lug_thrust+rate_effect", "lug_thrust+unknown"):
        gained = given.ln_prior(name) - plain.ln_prior(name)
        # From 0.036 to even odds.
        assert gained == pytest.approx(np.log((1.0 - 0.036) / 0.036))
    for name in ("none", "unknown", "rate_effect", "parameter_shift"):
        assert given.ln_prior(name) == plain.ln_prior(name)


def test_an_excluded_cause_is_not_tested_and_both_verdicts_are_told():
    case = make_case("sensor_drift", models=PULL_ONLY)
    found = diagnose_once(replace(case, context=Context(excluded=("sensor_drift",))), 1)
    assert "sensor_drift" not in found.inclusion.causes
    assert "excluded" in found.ranking.not_testable["sensor_drift"]
    assert found.without_context is not None
    assert found.without_context["sensor_drift"] > 0.5
    facts = dict(judge_gap(gap_evidence(found)).facts)
    assert facts["Put in"].startswith("Sensor drift excluded. Without that: sensor drift (")
    assert diagnose_once(case, 1).without_context is None


def test_a_known_size_takes_the_place_of_the_prior():
    case = make_case("force_offset", models=PULL_ONLY)
    context = Context(sizes={"force_offset": {"offset": Size(mean=0.02, sd=0.001)}})
    found = diagnose_once(replace(case, context=context), 1)
    priors = found.ranking.fits["force_offset"][0].forward.hypothesis.effect_priors[0]
    (offset,) = priors.free
    assert (offset.loc, offset.scale) == (0.02, 0.001)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("suspected = {lug_thrust = 1.5}", "less than 1"),
        ('suspected = {lug_thrust = "yes"}', "valid number"),
        ('excluded = "sensor_drift"', "valid list"),
        ("suspects = {}", "context.suspects"),
        (
            'suspected = {lug_thrust = 0.5}\nexcluded = ["lug_thrust"]',
            "both suspected and excluded",
        ),
        ("sizes = {force_offset = {offset = {mean = 1.0, sd = 0.0}}}", "greater than 0"),
        ("sizes = {force_offset = {offset = {mean = nan, sd = 1.0}}}", "finite number"),
        ("sizes = {force_offset = {offset = {mean = 1.0, sd = nan}}}", "finite number"),
        ("suspected = {lug_thrust = nan}", "finite number"),
    ],
)
def test_what_is_wrong_with_a_context_is_named(tmp_path, table, words):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    toml = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(f"{toml}\n[context]\n{table}\n")
    with pytest.raises(CalibError, match=words):
        read_case(folder)


@pytest.mark.parametrize(
    "context",
    [
        Context(excluded=("nobody_knows",)),
        Context(excluded=("parameter_shift",)),
        Context(sizes={"force_offset": {"size": Size(mean=1.0, sd=1.0)}}),
    ],
)
def test_names_that_nobody_knows_are_refused(context):
    case = make_case("force_offset", models=PULL_ONLY)
    with pytest.raises(CalibError, match=r"speaks of|no parameter"):
        diagnose_once(replace(case, context=context), 1)


def test_a_context_is_read_from_the_case(tmp_path):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    toml = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(
        toml + '\n[context]\nsuspected = {lug_thrust = 0.5}\nexcluded = ["sensor_drift"]\n'
    )
    context = read_case(folder).context
    assert context == Context({"lug_thrust": 0.5}, ("sensor_drift",))
    assert context.words() == ["lug thrust suspected (0.5)", "sensor drift excluded"]
    assert not read_context(None, "")
