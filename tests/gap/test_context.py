"""What an engineer knows changes what is believed beforehand, and is told from what is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from calib.errors import CalibError
from calib.gap.case import Context, Size, read_case, read_context
from calib.gap.diagnose import diagnose_once
from calib.gap.hypotheses import (
    Hypothesis,
    parameter_units,
    unusual_sizes,
    with_known_size,
)
from calib.gap.odds import Odds
from calib.inference.priors import Prior, Priors
from calib.report.gap_words import gap_verdict
from tests.gap.cases import CHOICE, PULL_ONLY, make_case, write_case


def test_suspicion_multiplies_the_odds_of_every_explanation_with_the_cause():
    plain, given = Odds.of(10, Context()), Odds.of(10, Context(suspected={"lug_thrust": 0.5}))
    for name in ("lug_thrust", "lug_thrust+rate_effect", "lug_thrust+unknown"):
        gained = given.ln_prior(name) - plain.ln_prior(name)
        # From 0.036 to even odds.
        assert gained == pytest.approx(np.log((1.0 - 0.036) / 0.036))
    for name in ("none", "unknown", "rate_effect", "parameter_shift"):
        assert given.ln_prior(name) == plain.ln_prior(name)


def test_an_excluded_cause_is_not_tested_and_both_verdicts_are_told():
    case = make_case("sensor_drift", models=PULL_ONLY)
    found = diagnose_once(
        replace(case, context=Context(excluded=("sensor_drift",))), 1, effects=CHOICE
    )
    assert "sensor_drift" not in found.inclusion.causes
    assert "excluded" in found.ranking.not_testable["sensor_drift"]
    assert found.without_context is not None
    assert found.without_context["sensor_drift"] > 0.5
    facts = dict(gap_verdict(found).facts)
    assert facts["Known beforehand"].startswith(
        "Sensor drift excluded. Without this: sensor drift ("
    )
    assert diagnose_once(case, 1, effects=CHOICE).without_context is None


def test_a_known_size_takes_the_place_of_the_prior():
    case = make_case("force_offset", models=PULL_ONLY)
    context = Context(sizes={"force_offset": {"offset": Size(mean=0.02, sd=0.001)}})
    found = diagnose_once(replace(case, context=context), 1, effects=CHOICE)
    priors = found.ranking.fits["force_offset"][0].forward.hypothesis.effect_priors[0]
    (offset,) = priors.free
    assert (offset.loc, offset.scale) == (0.02, 0.001)
    # The truth is far outside: no variant with a wider prior takes what was put in back.
    every = [f.forward.hypothesis for group in found.ranking.fits.values() for f in group]
    own = [p for h in every for e, p in zip(h.effects, h.effect_priors, strict=True)
           if e.name == "force_offset"]  # fmt: skip
    assert {p.free[0].scale for p in own} == {0.001}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("suspected = {lug_thrust = 1.5}", "less than 1"),
        ('suspected = {lug_thrust = "yes"}', "is not a number"),
        ('excluded = "sensor_drift"', "is not a list"),
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


def test_of_a_misspelt_cause_the_one_most_like_it_is_named():
    case = make_case("force_offset", models=PULL_ONLY)
    for name, hint in (("sensr_drift", "did you mean sensor_drift"), ("parameter_shift", "leave")):
        with pytest.raises(CalibError, match=hint):
            diagnose_once(replace(case, context=Context(excluded=(name,))), 1)


def test_a_context_is_read_from_the_case(tmp_path):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    toml = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(
        toml + '\n[context]\nsuspected = {lug_thrust = 0.5}\nexcluded = ["sensor_drift"]\n'
    )
    context = read_case(folder).context
    assert context == Context(suspected={"lug_thrust": 0.5}, excluded=("sensor_drift",))
    assert context.words() == ["lug thrust suspected (0.5)", "sensor drift excluded"]
    assert read_context(None, "") == Context()


KNOWN = {"lug_thrust": {"thrust": Size(mean=-0.2, sd=0.05)}}


@pytest.mark.parametrize(
    "context",
    [
        Context(suspected={"lug_thrust": 0.5}),
        Context(excluded=("lug_thrust",)),
        Context(sizes=KNOWN),
    ],
)
def test_any_of_its_parts_makes_a_context(context):
    assert context
    assert context.names == ("lug_thrust",)
    assert not Context()


def digging(*, known) -> Hypothesis:
    """Lugs of a size that may have either sign, a scale that is positive, a digging held fixed."""
    entries = (
        Prior("thrust", "1", "why", "who", "", False, 0.1, 0.3, lower=-1.0),
        Prior("slip_scale", "1", "why", "who", "", True, -1.5, 0.4),
        Prior("digging", "1", "why", "who", "", False, 0.2, 0.0),
    )
    single = Hypothesis("lug_thrust", effect_priors=(Priors(entries, "text", "source"),))
    return with_known_size(single, Context(sizes={"lug_thrust": known}))


def test_what_is_known_of_a_size_replaces_that_and_nothing_else():
    """A positive one by its logarithm, of which the sd is sd over mean, to first order."""
    (before,) = digging(known={}).effect_priors
    for name, mean, sd, loc, scale in (
        ("thrust", -0.2, 0.05, -0.2, 0.05), ("thrust", 0.0, 2.0, 0.0, 2.0),
        ("slip_scale", 0.5, 0.2, np.log(0.5), 0.4), ("slip_scale", 1e-3, 1e-4, np.log(1e-3), 0.1),
    ):  # fmt: skip
        (after,) = digging(known={name: Size(mean=mean, sd=sd)}).effect_priors
        assert (after.text, after.source) == (before.text, before.source)
        for was, now in zip(before.entries, after.entries, strict=True):
            if was.name != name:
                assert now == was
                continue
            assert (now.loc, now.scale) == pytest.approx((loc, scale), rel=1e-12)
            assert replace(now, loc=was.loc, scale=was.scale) == was


def test_of_other_effects_nothing_is_known():
    single = Hypothesis("rate_effect", effect_priors=(Priors(()),))
    assert with_known_size(single, Context(sizes=KNOWN)) is single


def known_lugs(**known: Size) -> tuple[Context, Hypothesis]:
    return Context(sizes={"lug_thrust": known}), digging(known={})


@pytest.mark.parametrize(
    ("name", "mean", "sd", "words"),
    [
        # 0.1 ± 0.3 is usual.
        ("thrust", 1.3, 0.001, ""),
        ("thrust", 1.4, 0.001, "thrust 1.4 ± 0.001, 4 sds from what is usual (-0.2 to 0.4)"),
        ("thrust", 1.4, 0.3, ""),
        ("thrust", 30.0, 5.0, "thrust 30 ± 5, 6 sds from what is usual"),
        # exp(-1.5 ± 0.4): a fraction that was given in percent.
        ("slip_scale", 0.22, 0.02, ""),
        ("slip_scale", 22.0, 2.0, "slip_scale 22 ± 2, 11 sds from what is usual (0.15 to 0.333)"),
    ],
)
def test_a_size_in_another_unit_is_told(name, mean, sd, words):
    context, single = known_lugs(**{name: Size(mean=mean, sd=sd)})
    said = unusual_sizes([single], context)
    assert len(said) == bool(words)
    assert words in "".join(said)
    assert unusual_sizes([], context) == []


def test_sizes_that_were_put_in_have_their_units():
    context, single = known_lugs(thrust=Size(mean=0.4, sd=0.1))
    (entry,) = (p for p in single.effect_priors[0].entries if p.name == "thrust")
    priors = Priors((replace(entry, unit="kN"),), "text", "source")
    in_kn = replace(single, effect_priors=(priors,))
    assert context.words(parameter_units([in_kn])) == ["lug thrust: thrust 0.4 ± 0.1 kN"]
    assert (
        context.words(parameter_units([single]))
        == context.words()
        == ["lug thrust: thrust 0.4 ± 0.1"]
    )


def test_what_is_put_in_and_cannot_be_tested_is_said_to_change_nothing():
    case = make_case("force_offset", models=PULL_ONLY)
    context = Context(
        suspected={"rut_rebound": 0.9},
        sizes={"force_offset": {"offset": Size(mean=40.0, sd=5.0)}},
    )
    found = diagnose_once(replace(case, context=context), 1, effects=CHOICE)
    put_in = dict(gap_verdict(found).facts)["Known beforehand"]
    assert "offset 40 ± 5 kN" in put_in
    assert "rut rebound cannot be tested here (" in put_in
    assert any("force_offset is said to have offset 40 ± 5 kN" in note for note in found.warnings)


@pytest.mark.parametrize("mean", [0.0, -0.5])
def test_what_is_positive_is_not_said_to_be_zero_or_less(mean):
    with pytest.raises(CalibError, match="slip_scale is positive"):
        digging(known={"slip_scale": Size(mean=mean, sd=0.1)})


@pytest.mark.parametrize(("mean", "allowed"), [(-1.5, False), (-1.0, True), (7.0, True)])
def test_a_size_is_within_the_bounds_of_its_prior(mean, allowed):
    known = {"thrust": Size(mean=mean, sd=0.1)}
    if allowed:
        assert digging(known=known).effect_priors[0].entries[0].loc == mean
        return
    with pytest.raises(CalibError, match=r"thrust cannot be -1\.5") as refused:
        digging(known=known)
    assert refused.value.expected == "a mean from -1 to inf"


def test_what_is_fixed_has_no_size_to_be_known():
    with pytest.raises(CalibError, match="no parameter 'digging'") as refused:
        digging(known={"digging": Size(mean=0.1, sd=0.1)})
    assert refused.value.expected == "thrust, slip_scale"


@pytest.mark.parametrize(
    ("part", "last", "beyond"),
    [
        ("mean", 1e15, 1e15 + 0.25), ("mean", -1e15, -1e15 - 0.25),
        ("sd", 1e15, 1e15 + 0.25), ("sd", 1.1e-15, 1e-15),
    ],
)  # fmt: skip
def test_a_size_is_a_number_that_can_be_squared(part, last, beyond):
    def written(value):
        size = {"mean": 1.0, "sd": 1.0, part: value}
        return {"sizes": {"force_offset": {"offset": size}}}

    context = read_context(written(last), "case.toml")
    assert getattr(context.sizes["force_offset"]["offset"], part) == last
    with pytest.raises(CalibError, match=f"offset.{part}"):
        read_context(written(beyond), "case.toml")


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_what_is_suspected_is_not_certain(probability):
    with pytest.raises(CalibError, match=r"context\.suspected\.lug_thrust"):
        read_context({"suspected": {"lug_thrust": probability}}, "case.toml")


def test_a_size_that_was_given_stays_what_it_is():
    with pytest.raises(ValidationError, match="frozen"):
        KNOWN["lug_thrust"]["thrust"].mean = 3.0
