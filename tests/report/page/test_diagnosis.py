"""The page of a diagnosis: its rules, its words, and that it is complete in itself."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from matplotlib.text import Text

from calib.check import verify
from calib.check.outcome import Status
from calib.data import table_from_arrays
from calib.gap.case import Case, read_case
from calib.gap.diagnose import diagnose, diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.files import document, track_record, write_diagnosis
from calib.gap.identifiability import NextMeasurement
from calib.gap.mixture import Included, Inclusion, inclusion_probability
from calib.inference.priors import Prior
from calib.report.gap_evidence import covered_text, gap_evidence
from calib.report.gap_facts import (
    NEITHER,
    Candidate,
    CauseFact,
    GapEvidence,
    NextFact,
    RunsFact,
    ShrinkFact,
    WhereFact,
    shrink_place,
    track_record_text,
)
from calib.report.gap_sizes import size_sentences
from calib.report.gap_verdict import Tone, judge_gap, repeats_needed
from calib.report.labels import odds_text, short
from calib.report.page.diagnosis import (
    conditions_text,
    hypothesis_groups,
    parameter_rows,
    prior_text,
    render_diagnosis,
    write_page,
)
from calib.report.parameters import parameter_text
from tests.browser import faults
from tests.gap.cases import PULL_ONLY, diagnosis_of, make_case, pull_diagnosis, write_case
from tests.report.page.test_page import Reader


def candidates(**probabilities: float) -> list[Candidate]:
    return [
        Candidate(n, n.replace("_", " "), f"what {n} does", p) for n, p in probabilities.items()
    ]


def evidence(verdict: str, **probabilities: float) -> GapEvidence:
    return GapEvidence(
        verdict,
        candidates(**probabilities),
        ["pull reads 0.13 ± 0.04 kN high"],
        [WhereFact("drawbar pull at slip 30 to 60 %", "0.1 kN above the simulator", 0.97)],
        [ShrinkFact("drawbar pull", "0.11", "0.04 kN", "0.03 kN", 0.63, (0.45, 0.8))],
        "at new conditions, which were not fitted",
        [NextFact(("lug thrust", "drift"), "slip 65 %", 1.2)],
        smallest=0.7,
    )


@pytest.mark.parametrize(
    ("verdict", "probabilities", "rule", "tone"),
    [
        ("none", {"none": 0.97, "drift": 0.03}, "none", Tone.FINE),
        ("none", {"none": 0.6, "drift": 0.4}, "not shown", Tone.CARE),
        ("none", {"none": 0.4, "drift": 0.35, "lug_thrust": 0.25}, "not shown", Tone.CARE),
        ("unknown", {"unknown": 0.95, "none": 0.05}, "unknown", Tone.NO),
        ("ambiguous", {"lug_thrust": 0.45, "drift": 0.4, "none": 0.02}, "tie", Tone.CARE),
        ("effect", {"parameter_shift": 0.95, "none": 0.05}, "recalibrate", Tone.FINE),
        ("effect", {"parameter_shift": 0.6, "none": 0.4}, "recalibrate", Tone.CARE),
        ("effect", {"drift": 0.93, "lug_thrust": 0.07}, "named", Tone.FINE),
        ("effect", {"drift": 0.7, "lug_thrust": 0.3}, "likely", Tone.CARE),
    ],
)
def test_rules(verdict, probabilities, rule, tone):
    found = judge_gap(evidence(verdict, **probabilities))
    assert found.rule == rule
    assert found.tone is tone
    assert found.headline[0].isupper()
    assert all(value[0].isupper() or not value[0].isalpha() for _, value in found.facts)


def test_a_named_effect_says_everything_at_once():
    found = judge_gap(evidence("effect", drift=0.93, lug_thrust=0.04))
    facts = dict(found.facts)
    assert found.headline == "What drift does"
    assert facts["Which"] == "As a whole: drift, probability 93 %; nothing else reaches 5 %"
    assert facts["How large"] == "Pull reads 0.13 ± 0.04 kN high"
    assert facts["Where"].endswith("0.1 kN above the simulator (probability 97 %)")
    assert "0.11 to 0.04 kN rms (noise 0.03 kN): it shrinks by 63 %" in facts["How far"]
    assert "90 % interval 45 to 80 %" in facts["How far"]
    assert facts["Next"].startswith(
        "Predict with the cause in the model (drift): calib predict DIAGNOSIS --at NEW.csv"
    )


def test_several_causes_are_to_be_predicted_with_together():
    parts = [CauseFact(n, n, f"what {n} does", 0.95, 0.5, (0.1, 0.9)) for n in ("a", "b")]
    e = replace(evidence("effect", **{"a+b": 0.95}), causes=parts)
    assert "the causes in the model (a and b)" in dict(judge_gap(e).facts)["Next"]


def test_other_parameter_values_are_to_be_calibrated():
    text = dict(judge_gap(evidence("effect", parameter_shift=0.95, none=0.05)).facts)["Next"]
    assert text.startswith("Fit the field's rows too")


def test_a_sure_unknown_says_where_to_look():
    e = replace(evidence("unknown", unknown=0.95), look="repeat runs at high slip")
    assert dict(judge_gap(e).facts)["Next"] == "Repeat runs at high slip"


def test_less_than_sure_is_hedged_with_rivals_and_a_measurement():
    found = judge_gap(evidence("effect", drift=0.7, lug_thrust=0.25))
    facts = dict(found.facts)
    assert found.headline.startswith("Probably ")
    assert "also possible: lug thrust (25 %)" in facts["Which"]
    # ln 20 = 3.0 nats at 1.2 each.
    assert facts["Next"] == (
        "To separate lug thrust from drift: about 3 measurements at slip 65 %, added to the "
        "field's file, and diagnose again"
    )


def over_runs(*forms: tuple[str, float], **kind: bool) -> RunsFact:
    return RunsFact("drawbar pull", sum(p for _, p in forms), forms, **kind)


@pytest.mark.parametrize(
    ("verdict", "forms", "kind", "rule", "words"),
    [
        # What is sure is said, and what is not told apart.
        ("ambiguous", [("a drift", 0.48), ("a step", 0.45), (NEITHER, 0.03)], {}, "over runs",
         "Drawbar pull changes over the runs, but the data cannot tell a drift (48 %) and a step "
         "(45 %) apart"),
        ("effect", [("a step", 0.6), ("a drift", 0.2)], {}, "over runs",
         "Probably drawbar pull changes over the runs, but the data cannot tell a step (60 %) and"),
        ("effect", [("a drift", 0.85), ("a step", 0.1)], {}, "likely", "Probably what drift does"),
        ("ambiguous", [("a drift", 0.24), ("a step", 0.2)], {}, "tie", "There is a gap"),
        ("unknown", [(NEITHER, 0.95), ("a step", 0.04)], {}, "wander",
         "Drawbar pull changes over the runs, neither as a drift nor as a step"),
        ("unknown", [(NEITHER, 0.8)], {"together": True}, "trend",
         "Probably drawbar pull change together over the runs: rather the ground"),
        ("unknown", [(NEITHER, 0.3), ("a step", 0.04)], {}, "unknown", "There is a real gap"),
        ("none", [("a drift", 0.2), ("a step", 0.2)], {}, "not shown", "The data show no gap"),
    ],
)  # fmt: skip
def test_of_a_change_over_the_runs_is_said_what_is_sure_of_it(verdict, forms, kind, rule, words):
    shown = {"none": {"none": 0.6, "drift": 0.2}, "unknown": {"unknown": 0.95, "drift": 0.04}}
    usual = {"drift": dict(forms).get("a drift", 0.0) or 0.5, "lug_thrust": 0.3}
    e = replace(evidence(verdict, **shown.get(verdict, usual)), runs=over_runs(*forms, **kind))
    found = judge_gap(e)
    assert found.rule == rule
    assert found.headline.startswith(words)


def test_causes_that_may_act_besides_and_what_is_sure_over_the_runs_are_said():
    """What is as probable as a third is not left to the table below."""
    causes = [
        CauseFact("slip_sinkage", "slip sinkage", "deeper", 0.99, 0.9, (0.8, 1.0)),
        CauseFact("sensor_step", "sensor step", "a jump", 0.6, 0.06, (0.0, 0.2), "its zero"),
        CauseFact("sensor_drift", "sensor drift", "a drift", 0.34, 0.03, (0.0, 0.2), "its zero"),
        CauseFact("parameter_shift", "other parameters", "others", 0.31, 0.3, (0.0, 0.9)),
        CauseFact("gauge", "gauge", "reads wrong", 0.09, 0.1, (0.0, 0.2), "another gauge"),
    ]
    runs = replace(over_runs(("a step", 0.6), ("a drift", 0.35)), surest=0.6)
    e = replace(evidence("effect", slip_sinkage=0.6), causes=causes, runs=runs)
    text = dict(judge_gap(e).facts)["Causes"]
    assert "or instead, there may be sensor drift (34 %) and other parameters (31 %)" in text
    assert "that drawbar pull changes over the runs, in whichever form, has 95 %" in text
    assert "gauge" not in text
    told = dict(judge_gap(replace(e, runs=replace(runs, surest=0.93))).facts)["Causes"]
    assert "in whichever form" not in told
    # What none of which acts is told by itself already.
    none = dict(judge_gap(replace(e, causes=causes[2:])).facts)["Causes"]
    assert "besides" not in none


def test_a_sure_form_is_named_whatever_else_may_be():
    sure = CauseFact("sensor_step", "sensor step", "a jump", 0.93, 0.9, (0.8, 1.0), "its zero")
    runs = over_runs(("a step", 0.6), ("a drift and a step at once", 0.33))
    e = replace(evidence("effect", sensor_step=0.6), causes=[sure], runs=runs)
    assert judge_gap(e).rule == "named"


def test_where_the_form_is_not_told_the_reading_is_to_be_checked_all_the_same():
    runs = over_runs(("a step", 0.45), ("a drift", 0.4))
    step = CauseFact("sensor_step", "sensor step", "a jump", 0.45, 0.9, (0.0, 1.0), "its zero")
    e = replace(evidence("ambiguous", sensor_step=0.45, sensor_drift=0.4), runs=runs, causes=[step])
    text = dict(judge_gap(e).facts)["Next"]
    assert text.startswith("(1) Check the instrument before the model: drawbar pull (zero and")
    assert "alone cannot tell" not in text
    alone = dict(judge_gap(replace(e, runs=replace(runs, only=True))).facts)["Next"]
    assert alone.endswith("the ground changed over the runs: drawbar pull alone cannot tell")


def test_where_an_instrument_is_at_fault_it_is_to_be_checked_first():
    step = CauseFact("sensor_step", "sensor step", "a jump", 0.97, 0.9, (0.8, 1.0), "its zero")
    soil = CauseFact("lug_thrust", "lug thrust", "more thrust", 0.6, 0.1, (0.0, 0.2))
    e = replace(evidence("effect", sensor_step=0.97), causes=[step, soil])
    text = dict(judge_gap(e).facts)["Next"]
    assert (
        "the instrument before the model: sensor step (its zero). (2) Correct the field's readings "
        "by what the check showed, be it all that is expected, a part or nothing; put excluded = "
        '["sensor_step"] under [context]' in text
    )
    assert "(3) Only if it showed all that is expected, readings may stay as they are" in text
    assert (
        "(4) If it can no longer be checked, predict from this folder with --without sensor_step"
        in text
    )
    assert "(5) What is no fault, lug thrust, belongs in the simulator" in text
    assert "suspected" not in text  # it is sure already
    others = dict(judge_gap(replace(e, causes=[replace(step, instrument="")])).facts)
    assert "instrument" not in others.get("Next", "")


def test_beside_a_faulty_instrument_the_other_causes_and_a_measurement_are_said():
    step = CauseFact(
        "sensor_step", "sensor step", "a jump", 0.97, 0.9, (0.8, 1.0), "its zero", "jump 2 kN"
    )
    soil = CauseFact("lug_thrust", "lug thrust", "more thrust", 0.6, 0.1, (0.0, 0.2))
    gauge = CauseFact("gauge", "gauge", "reads wrong", 0.08, 0.1, (0.0, 0.2), "another gauge")
    sure = replace(evidence("effect", sensor_step=0.97), causes=[step, soil])
    facts = dict(judge_gap(sure).facts)
    assert "sensor step (its zero; expect jump 2 kN)" in facts["Next"]
    assert "What is no fault, lug thrust, belongs in the simulator" in facts["Next"]
    assert facts["How far"].endswith("what the instrument reads, sensor step in it")
    assert "Then" not in facts
    alone = dict(judge_gap(replace(sure, causes=[step])).facts)
    assert "no fault" not in alone["Next"]
    two = [step, replace(gauge, probability=0.95)]
    both = dict(judge_gap(replace(sure, causes=two)).facts)["Next"]
    assert both.startswith("(1) Check the instruments before the model: sensor step (its zero")
    assert 'put excluded = ["sensor_step", "gauge"] under [context]' in both
    assert "save what was not checked, with all faults of it, and diagnose again" in both
    assert "(3) Only if every one of them showed all that is expected" in both
    assert (
        "(4) If one of them can no longer be checked, do (2) for the others, then predict" in both
    )
    faulty = [replace(step, faults=("force_offset", "sensor_step")), two[1]]
    grouped = dict(judge_gap(replace(sure, causes=faulty)).facts)["Next"]
    assert "with all faults of it (sensor step with force_offset, sensor_step), and" in grouped
    # One check settles all faults of the same instrument.
    cell = replace(step, faults=("force_offset", "sensor_step"))
    assert 'put excluded = ["force_offset", "sensor_step"] under [context]' in dict(
        judge_gap(replace(sure, causes=[cell])).facts)["Next"]  # fmt: skip
    assert "as well" not in alone["Next"]
    unsure = replace(
        evidence("effect", sensor_step=0.6, lug_thrust=0.3),
        causes=[replace(step, probability=0.6), soil, gauge],
    )
    facts = dict(judge_gap(unsure).facts)
    # Found at fault, explanations without it no longer count: what is known goes in.
    assert "put suspected = {sensor_step = 0.99} under [context]" in facts["Next"]
    assert "Worth a check as well: gauge (8 %; another gauge)" in facts["Next"]
    assert facts["Then"].startswith(
        "After (2) the new page says what is next; where no check is possible, to separate lug "
        "thrust from drift: about 3 measurements at")  # fmt: skip
    # Mended readings beside faulty ones would be a change at some run.
    assert "with the instrument as it was, or all readings corrected alike" in facts["Then"]
    before = dict(judge_gap(replace(sure, causes=[step], excluded=("sensor_drift",))).facts)
    assert 'put excluded = ["sensor_drift", "sensor_step"] under [context]' in before["Next"]


def test_a_tie_names_its_members_and_not_the_rest():
    found = judge_gap(evidence("ambiguous", lug_thrust=0.45, drift=0.4, none=0.02))
    assert "cannot tell lug thrust and drift apart" in found.headline
    assert "none" not in found.headline


def test_a_tie_with_no_gap_at_all_does_not_claim_one():
    tied = judge_gap(evidence("ambiguous", unknown=0.35, none=0.3, drift=0.2))
    assert tied.headline.startswith("There may be a gap, but")
    sure = judge_gap(evidence("ambiguous", unknown=0.45, drift=0.4, none=0.02))
    assert sure.headline.startswith("There is a gap, but")


def test_two_effects_are_said_to_be_two():
    parts = [CauseFact(n, n, f"what {n} does", p, s, (0.1, 0.9)) for n, p, s in
             (("a", 0.95, 0.3), ("b", 0.96, 0.6), ("c", 0.2, 0.02))]  # fmt: skip
    e = replace(evidence("effect", **{"a+b": 0.95}), causes=parts)
    found = judge_gap(e)
    assert found.headline == "Two causes at once: what b does, and what a does"
    # Where the best explanation has one more, nobody can say that there are two.
    more = judge_gap(replace(evidence("effect", **{"a+b+c": 0.4, "a+b+d": 0.4}), causes=parts))
    assert more.headline == "At least two causes at once: what b does, and what a does"
    causes = dict(found.facts)["Causes"]
    assert causes.startswith("B acts (96 %) and is 60 % (10 to 90 %) of the gap; a acts (95 %)")
    assert "c acts" not in causes
    rest = CauseFact("unknown", "something unlisted", "", 0.8, 0.08, (0.0, 0.2))
    left = judge_gap(replace(e, remainder=rest, remainder_where="drawbar pull at slip 60 to 70 %"))
    assert left.headline.endswith("; something that is not listed probably acts besides")
    assert (
        "what is of no listed shape, drawbar pull at slip 60 to 70 %, is there with 80 %"
        in (dict(left.facts)["Causes"])
    )


def test_a_shrink_that_may_be_nothing_says_so():
    e = evidence("effect", drift=0.95)
    shaky = replace(e, shrink=[replace(e.shrink[0], interval=(-0.3, 0.7))])
    text = dict(judge_gap(shaky).facts)["How far"]
    assert "\N{MINUS SIGN}30 to 70 %" in text
    assert "may not shrink at all" in text
    assert text.endswith(", as expected at new conditions, which were not fitted")


def test_nothing_to_show_is_said():
    bare = replace(evidence("unknown", unknown=0.9), sizes=[], where=[], shrink=[], next_facts=[])
    facts = dict(judge_gap(bare).facts)
    assert "How large" not in facts
    assert facts["Where"].startswith("In no stretch")
    assert facts["How far"] == "No output has a gap that could shrink"


@pytest.mark.parametrize(("probability", "stated"), [(0.97, "0.9 or more"), (0.62, "0.6 to 0.7")])
def test_a_probability_has_its_track_record(probability, stated):
    text = track_record_text(probability)
    record = track_record(probability)
    assert text.startswith(f"Of {record.cases:,} blind cases whose first explanation was stated at")
    assert f" {stated}, {record.right / record.cases:.2f} (95 % interval" in text
    assert "simulated campaigns of calib's own bench" in text


def test_a_null_says_what_would_have_been_seen():
    facts = dict(judge_gap(evidence("none", none=0.97)).facts)
    assert "0.7 noise sd" in facts["Which"]
    assert set(facts) == {"Which"}


def test_measurements_that_cannot_help_are_not_asked_for():
    assert repeats_needed(1.2) == 3
    assert repeats_needed(5.0) == 1
    assert repeats_needed(0.001) is None
    assert repeats_needed(0.0) is None
    assert repeats_needed(math.nan) is None
    e = replace(
        evidence("ambiguous", a=0.4, b=0.4), next_facts=[NextFact(("a", "b"), "slip 1 %", 1e-4)]
    )
    assert dict(judge_gap(e).facts)["Next"].startswith("No single condition")


def test_no_probability_is_certain():
    assert odds_text(1.0) == "above 99 %"
    assert odds_text(0.0) == "below 1 %"
    assert odds_text(0.5) == "50 %"


def prior(**changes) -> Prior:
    base = {"name": "a", "unit": "kN", "reason": "", "source": "", "text": "", "log": False,
            "loc": 0.0, "scale": 1.0}  # fmt: skip
    return Prior(**(base | changes))


@pytest.mark.parametrize(
    ("given", "value", "sd", "text"),
    [
        (prior(), 0.1312, 0.041, "0.131 ± 0.041 kN"),
        (prior(unit="1"), 0.1312, 0.041, "0.131 ± 0.041"),
        (prior(lower=0.0), 0.0, 0.02, "< 0.033 kN"),
        (prior(lower=0.0), 0.1, 0.02, "0.100 ± 0.020 kN"),
        (prior(), 0.1, 0.98, "0.10 ± 0.98 kN (prior)"),
        (prior(log=True, loc=0.0), math.log(2.0), 0.1, "2.00 ± 0.20 kN"),
        (prior(log=True, loc=0.0), math.log(2.0), 0.7, "2.0 (0.63 to 6.3) kN"),
        # Uniform from 0 to 1: as wide as before the data, or narrowed.
        (prior(scale=math.inf, lower=0.0, upper=1.0), 0.9, 1.8, "0.50 ± 0.29 kN (prior)"),
        (prior(scale=math.inf, lower=0.0, upper=1.0), 0.7, 0.05, "0.700 ± 0.050 kN"),
        (prior(scale=math.inf, lower=0.0, upper=1.0), 0.2, 0.25, "< 0.61 kN"),
        # A half-normal's sd is 0.60 of its scale: one of 0.58 has learnt nothing.
        (prior(lower=0.0), 0.0, 0.58, "< 0.95 kN (prior)"),
    ],
)
def test_parameters_are_as_precise_as_they_are_known(given, value, sd, text):
    assert parameter_text(given, value, sd) == text


@pytest.fixture(scope="module")
def found():
    return diagnosis_of("sensor_drift")


@pytest.fixture(scope="module")
def page(found, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    write_page(found, folder, {"command": ["calib", "diagnose", "a b"], "versions": {"numpy": "2"}})
    html = (folder / "index.html").read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(html)
    return folder, html, reader


def test_the_verdict_has_the_track_record_beside_it(page):
    assert "blind cases whose first explanation was stated at" in page[1]


def test_it_is_well_formed_and_makes_no_request(page):
    _, html, reader = page
    assert reader.open == []
    assert not re.search(r"https?://|@import|url\(", html)
    assert all(a.startswith(("#", "data:")) for a in reader.addresses)


# Columns as a file has them, and how much of the canonical unit one of theirs is.
OWN = {
    "drawbar_pull_kn": ("Drawbar pull [N]", 1e-3),
    "rut_depth_mm": ("Sinkage [inch]", 25.4),
    "inflation_pressure_psi": ("Inflation pressure [kPa]", 1.0 / 6.894757293168361),
    "average_ground_pressure_kpa": ("Average ground pressure [psi]", 6.894757293168361),
    "speed_m_s": ("Speed [ft/s]", 0.3048),
}


def in_own_units(case: Case, folder: Path) -> Case:
    """Return a case as it is read from files of other words and units."""
    write_case(case, folder)
    for file in folder.glob("*.csv"):
        with file.open() as lines:
            head, *rows = csv.reader(lines)
        scale = [OWN.get(column, ("", 1.0))[1] for column in head]
        lines = [",".join(OWN.get(column, (column,))[0] for column in head)]
        lines += [",".join(repr(float(c) / f) for c, f in zip(r, scale, strict=True)) for r in rows]
        file.write_text("\n".join(lines) + "\n")
    return read_case(folder)


def test_it_is_in_the_units_of_the_files_and_checks(tmp_path):
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    found = diagnose(in_own_units(make_case("sensor_drift", n_fresh=3), tmp_path / "own"), 1,
                     effects=few)  # fmt: skip
    out = tmp_path / "gaps" / "drift"
    out.mkdir(parents=True)
    write_diagnosis(found, out)
    drawn = []
    with patch("calib.report.figures.style.png", lambda p: drawn.append(p.figure) or b""):
        write_page(found, out, {})
    told = json.loads((out / "diagnosis.json").read_text())
    reader = Reader()
    reader.feed((out / "index.html").read_text(encoding="utf-8"))
    shrink = told["shrink"]["drawbar_pull"]
    before, after, noise = (
        short(1e3 * shrink[key]) for key in ("rmse_before", "rmse_after", "noise_floor")
    )
    assert f"from {before} to {after} N rms" in reader.text
    assert f"noise sd of a reading {noise} N" in reader.text
    # Parameters are in their own units, here kN; their definitions name a pressure.
    assert set(re.findall(r"[\d.]+ (mm|psi|kPa|m/s|kN)\b", reader.text)) == {"kN", "kPa", "psi"}
    # The ground pressure is in the file's psi.
    assert re.findall(r".{7}[\d.]+ psi\b", reader.text) == ["18 and 42 psi", "8.5 to 28.2 psi"]
    assert "ground pressure 18.5 to 28.2 psi" in reader.text
    labels = {text.get_text() for f in drawn for text in f.findobj(Text)}
    assert {"Gap in drawbar pull (N)", "Gap in rut depth (inch)", "Speed\n(ft/s)"} <= labels
    assert not [t for t in labels if re.search(r"\((kN|mm|psi|m/s)\)", t)]

    # What it keeps is canonical: it is diagnosed as before, and its model predicts what it states.
    again = document(diagnose(read_case(out / "case"), 1, effects=few))
    assert again["verdict"] == told["verdict"] == "effect"
    for new, old in zip(again["effects"], told["effects"], strict=True):
        assert new["name"] == old["name"]
        assert new["probability"] == pytest.approx(old["probability"], abs=1e-4)
    best = told["effects"][0]
    said = {
        "verdict": told["verdict"], "best": best["name"], "parameters": best["parameters"],
        "probability": {e["name"]: e["probability"] for e in told["effects"]},
        "shrink": told["shrink"],
    }  # fmt: skip
    checked = verify.gaps(tmp_path, {"paper_gaps": {"drift": said}}, same_code=True)
    assert [item.status for item in checked] == [Status.IDENTICAL] * 2


def test_it_holds_in_a_browser(page, browser):
    assert faults(browser, page[0] / "index.html") == []


def test_every_link_has_its_target_and_ids_are_unique(page):
    _, _, reader = page
    targets = {a[1:] for a in reader.addresses if a.startswith("#")}
    assert targets == {"before", "where", "which", "how-far", "next", "reproduce"}
    assert targets <= set(reader.ids)
    assert len(reader.ids) == len(set(reader.ids))


def test_figures_are_in_the_page_and_beside_it(page):
    folder, _, reader = page
    files = sorted(p.name for p in (folder / "figures").iterdir())
    assert len(files) == len(reader.images) == 7
    assert all((folder / "figures" / f).read_bytes().startswith(b"\x89PNG") for f in files)
    assert all(int(image["width"]) > 800 and image["alt"] for image in reader.images)


def test_the_verdict_comes_first_with_the_whole_story(found, page):
    _, _, reader = page
    opening = reader.text[: reader.text.index("Before the outcomes")]
    for words in ("drawbar reading drifts", "probability", "by the end of the campaign", "rms"):
        assert words in opening
    assert reader.ids[0] == "verdict"


def test_what_to_do_is_on_the_card_and_under_next(page):
    assert page[2].text.count("Check the instrument before the model: sensor drift (zero") == 2


def test_of_a_drift_it_is_said_what_a_check_of_either_end_shows(found, page):
    """What the reading has too much at the first run and at the last: the formula, by hand."""
    _, _, reader = page
    said = re.search(r"expect (\S+) ± (\S+) kN at the first run and (\S+) ± (\S+) kN at the last",
                     reader.text)  # fmt: skip
    name = next(n for n in found.ranking.order if "sensor_drift" in n)
    fit = found.ranking.best(name)
    i = [e.name for e in fit.forward.hypothesis.effects].index("sensor_drift")
    psi = fit.draws(np.random.default_rng(1), 4000)[:, fit.forward.phi_slices[i]]
    natural = fit.forward.hypothesis.effect_priors[i].to_natural(psi)
    drift, curvature, half_way, zero_at = natural.T
    for u, mean, sd in ((0.0, *said.groups()[:2]), (1.0, *said.groups()[2:])):
        u = max(u, 1e-3)
        grown = (1 + half_way**curvature) * u**curvature / (u**curvature + half_way**curvature)
        expected = drift * (grown - zero_at)
        at = float(mean.replace("\N{MINUS SIGN}", "-"))
        assert abs(at - expected.mean()) < 0.35 * expected.std()
        assert float(sd) == pytest.approx(expected.std(), rel=0.2)


def test_every_hypothesis_is_in_the_table(found, page):
    _, _, reader = page
    rows = [r["name"] for g in hypothesis_groups(found) for r in g["rows"]]
    assert sorted(rows) == sorted(found.ranking.probability)
    for words in ("none (noise)", "unknown effect", "parameter shift", "lug thrust"):
        assert words in reader.text
    evidence_of = {r["name"]: r["evidence"] for g in hypothesis_groups(found) for r in g["rows"]}
    assert evidence_of["none"] == "0"
    assert evidence_of["sensor_drift"].startswith("+")


def test_the_footer_says_how_to_get_it_again(found, page):
    _, _, reader = page
    for words in ("calib diagnose 'a b'", found.data.case.field.sha256, "numpy 2", "Seed"):
        assert words in reader.text


def test_the_size_is_that_of_the_drift(found):
    (sentence,) = size_sentences(found, "sensor_drift")
    match = re.fullmatch(
        r"drawbar pull reads ([\d.]+) ± ([\d.]+) kN high by the end of the campaign", sentence
    )
    assert match
    # The last fifth of a drift of 0.25 kN: 0.9 of it on average.
    assert abs(float(match[1]) - 0.225) < 4.0 * float(match[2])


def test_the_size_of_a_step_names_its_run():
    size = {"jump": -0.2, "zero_at": 0.0, "change_point": 12.5 / 26.0, "duration": 1e-9}
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "sensor_step")}
    case = make_case("sensor_step", size=size, models=PULL_ONLY)
    (sentence,) = size_sentences(diagnose_once(case, 1, effects=few), "sensor_step")
    match = re.fullmatch(
        r"drawbar pull reads ([\d.]+) ± ([\d.]+) kN lower after run (\d+) than before", sentence
    )
    assert match
    assert abs(float(match[1]) - 0.2) < 4.0 * float(match[2])
    assert match[3] == "12"


def test_of_a_step_that_takes_some_runs_it_is_said_between_which():
    """Of ruts in parts of them, for their logarithm is compared."""
    case = make_case(None, n_field=40)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    rising = np.clip((columns["run_order"] - 17.0) / 6.0, 0.0, 1.0)
    columns["rut_depth_mm"] = columns["rut_depth_mm"] * 1.8**rising
    case = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("sensor_drift", "rut_rebound")}
    found = diagnose_once(case, 1, effects=few)
    (sentence,) = size_sentences(found, "rut_depth_step")
    match = re.fullmatch(
        r"rut depth reads ([\d.]+) ± ([\d.]+) % deeper after run (\d+) than up to run (\d+), and "
        r"changes in between",
        sentence,
    )
    assert match
    assert abs(float(match[1]) - 80.0) < 4.0 * float(match[2])
    # From the seventeenth to the twenty-third, within two runs.
    assert abs(int(match[4]) - 17) <= 2
    assert abs(int(match[3]) - 23) <= 2


def test_sizes_of_other_kinds_of_effect():
    (sentence,) = size_sentences(diagnosis_of("slip_zero_shift"), "slip_zero_shift")
    match = re.fullmatch(
        r"true slip is ([\d.]+) ± ([\d.]+) percentage points above the recorded one on average",
        sentence,
    )
    assert match
    # 5 % of (1 - slip), whose mean is 0.665.
    assert abs(float(match[1]) - 3.3) < 4.0 * float(match[2])
    assert size_sentences(diagnosis_of(None), "none") == []
    pair = size_sentences(diagnosis_of("sensor_drift"), "force_offset+sensor_drift")
    assert pair[0].startswith("together: drawbar pull changes by ")


def test_parameters_say_of_which_effect_they_are(found):
    rows = {r["name"]: r["sizes"] for g in hypothesis_groups(found) for r in g["rows"]}
    pair = rows["force_offset+sensor_drift"]
    assert pair[0].startswith("force offset: offset ")
    assert pair[1].startswith("sensor drift: drift ")
    assert pair[2].startswith("curvature ")  # said once
    assert rows["force_offset"][0].startswith("offset ")


def test_what_the_parameters_are_can_be_read_on_the_page(found, page):
    _, _, reader = page
    rows = {(row[0], row[1]): row[2:] for row in parameter_rows(found)}
    assert len(rows) == len(parameter_rows(found))
    meaning, prior, source = rows["sensor drift", "curvature"]
    assert meaning.startswith("1 is linear in run order")
    assert prior == "lognormal(1, 1)"
    assert rows["sensor drift", "drift"][1].endswith(" \N{MULTIPLICATION SIGN} 5 (normal load) kN")
    assert all(row[2] for row in rows.values())
    for words in (meaning, source, "sampled through its values at the lowest (", "psi"):
        assert words in reader.text
    ruled_out = {n for n, p in found.ranking.probability.items() if p < 0.01 and "+" not in n}
    in_play = {
        part for n, p in found.ranking.probability.items() if p >= 0.01 for part in n.split("+")
    }
    assert not {name.replace("_", " ") for name in ruled_out - in_play} & {e for e, _ in rows}


def test_mean_gaps_have_intervals_and_noise_is_said_to_be_whose(page):
    _, _, reader = page
    assert re.search(r"the simulator \(90 % interval \S+ to \S+\)", reader.text)
    assert "(both campaigns, the most probable hypothesis)" in reader.text
    assert "sd of one reading there, from both campaigns, over all hypotheses" in reader.text


def test_a_null_has_a_quiet_page():
    reader = Reader()
    reader.feed(render_diagnosis(pull_diagnosis(None), [], {}, manifest={}))
    assert "The calibrated simulator holds" in reader.text
    assert "No output has a gap that could shrink." in reader.text
    assert reader.open == []


def test_warnings_and_names_of_the_case_are_shown_and_escaped(found):
    case = replace(found.data.case, name="a <b>")
    other = replace(found, data=replace(found.data, case=case), warnings=("mind the <gap>",))
    html = render_diagnosis(other, [], {}, manifest={})
    assert "mind the &lt;gap&gt;" in html
    assert "a &lt;b&gt;" in html
    assert "<b>" not in html


@pytest.mark.parametrize(
    ("verdict", "best", "words"),
    [
        ("ambiguous", "lug_thrust", "the data cannot tell"),
        # Of what is unlisted here, most would follow the order of the runs: it is a drift.
        ("unknown", "unknown", "change together over the runs"),
        ("effect", "parameter_shift", "the same model with other parameter values"),
        ("effect", "force_offset+lug_thrust", "wo causes at once"),
    ],
)
def test_every_verdict_has_its_page(found, verdict, best, words):
    p = dict.fromkeys(found.ranking.probability, 0.0) | {"rate_effect": 0.3}
    p |= {best: 0.6} if verdict != "ambiguous" else {best: 0.35}
    ranking = replace(found.ranking, probability=p)
    if best not in ranking.fits:  # this pair was not promising enough to be fitted
        fits = dict(ranking.fits) | {best: ranking.fits["force_offset+sensor_drift"]}
        evidence_of = dict(ranking.log_evidence) | {best: 0.0}
        ranking = replace(ranking, fits=fits, log_evidence=evidence_of)
    causes = {name: Included(p, p, (0.0, 1.0)) for name, p in inclusion_probability(p).items()}
    rest = causes.pop("unknown", Included(0.0, 0.0, (0.0, 0.0)))
    other = replace(found, verdict=verdict, ranking=ranking, inclusion=Inclusion(causes, rest, ()))
    reader = Reader()
    reader.feed(render_diagnosis(other, [], {}, manifest={}))
    opening = reader.text[: reader.text.index("Before the outcomes")]
    assert words in opening
    assert reader.open == []


def test_evidence_is_gathered_from_the_records(found):
    e = gap_evidence(found)
    assert e.verdict == found.verdict
    assert [c.probability for c in e.ranked] == sorted(
        found.ranking.probability.values(), reverse=True
    )
    assert len(e.where) <= len(found.data.outputs)
    assert e.shrink_place.startswith("at the new conditions")
    assert [s.fraction for s in e.shrink] == [s.fraction for s in found.shrink.values()]


def test_it_is_told_on_which_rows_the_shrink_was_judged(found):
    case = replace(found.data.case, new_conditions=None)
    own = replace(found, data=replace(found.data, case=case))
    assert "each row predicted without it (the rows are left out in 5 parts)" in shrink_place(own)
    # Of six rows none are left out: four would not be enough.
    few = replace(case, field=case.field.take(range(6)))
    outputs = tuple(replace(o, rows=o.rows[:6]) for o in own.data.outputs)
    assert "which were fitted: they are too few" in shrink_place(
        replace(own, data=replace(own.data, case=few, outputs=outputs))
    )


def test_effects_that_a_missing_column_hides_are_named_beside_the_cause(found):
    assert not gap_evidence(found).untested
    ranking = replace(
        found.ranking,
        not_testable={
            "moisture_softening": "the data lack gravimetric_water_content",
            "cone_index_bias": "no bulk_density output",
        },
    )
    lab = {n: v for n, v in found.data.view.lab.items() if n != "speed_m_s"}
    data = replace(found.data, view=replace(found.data.view, lab=lab))
    e = gap_evidence(replace(found, ranking=ranking, data=data))
    whole, *parts = e.untested
    assert whole == "moisture softening (the data lack gravimetric_water_content)"
    words = "rate effect in part (the calibration has no speed_m_s, so that a constant"
    assert any(part.startswith(words) for part in parts)
    told = dict(judge_gap(e).facts)["Not tested"]
    assert told.startswith("Moisture softening (the data lack")
    assert told.endswith("If any acts, its trace is put down to what is named")


def test_what_is_assumed_of_the_calibration_stands_beside_the_cause(found):
    e = replace(gap_evidence(found), verdict="effect", assumed=["pass 1"])
    told = dict(judge_gap(e).facts)["Assumed"]
    assert told.startswith("Pass 1, which the calibration does not record. If it was otherwise")
    assert "Assumed" not in dict(judge_gap(replace(e, assumed=())).facts)
    # As its hypotheses have it, whose own campaigns are asked.
    assert not gap_evidence(found).assumed


def test_conditions_that_neither_hypothesis_depends_on_are_not_asked_for(found):
    conditions = {
        "slip_ratio": 0.651, "normal_load_kn": 5.0, "inflation_pressure_psi": 42.0,
        "average_ground_pressure_kpa": 178.0, "speed_m_s": 2.0, "run_order": 26.0,
    }  # fmt: skip

    def text(*separates: str) -> str:
        return conditions_text(found, NextMeasurement(separates, conditions, 1.0))

    assert text("force_offset", "lug_thrust") == "slip 65 %, inflation pressure 42 psi"
    assert text("force_offset", "rate_effect").endswith("42 psi, speed 2 m/s")
    assert text("force_offset", "sensor_drift").endswith("42 psi, after the last run")
    assert text("force_offset", "unknown").endswith("speed 2 m/s, after the last run")


def test_what_is_unknown_is_described_by_what_it_goes_along_with():
    from dataclasses import replace

    import numpy as np

    from calib.gap.diagnose import diagnose
    from calib.gap.effects import EFFECTS
    from calib.report.gap_sizes import size_sentences
    from tests.gap.cases import PULL_ONLY, make_case

    # An amplifier that saturates: no reading above 0.9 kN.
    case = make_case(None, models=PULL_ONLY, n_field=36, n_fresh=3)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    columns["drawbar_pull_kn"] = np.minimum(columns["drawbar_pull_kn"], 0.9)
    case = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    found = diagnose(case, 1, effects=few)
    assert found.verdict == "unknown"
    lead = size_sentences(found, "unknown")[0]
    assert lead.startswith("what is missing sets in beyond a predicted drawbar pull of")
    assert 0.8 < float(lead.split(" of ")[1].split()[0]) < 1.0
    look = gap_evidence(found).look
    assert look.startswith("repeat runs where the gap is surest (")
    assert "in small steps about a predicted drawbar pull of" in look
    reader = Reader()
    reader.feed(render_diagnosis(found, [], {}, manifest={}))
    assert reader.text.count(f"R{look[1:]}") == 2
    assert "no measurement is needed" not in reader.text


def test_what_sets_in_at_low_pressure_is_said_so():
    from dataclasses import replace

    import numpy as np

    from calib.gap.diagnose import diagnose
    from calib.gap.effects import EFFECTS
    from calib.report.gap_sizes import size_sentences
    from tests.gap.cases import make_case

    # Below 24 psi the bead creeps on the rim: a third of the pull above 0.6 kN is lost.
    case = make_case(None, n_field=36, n_fresh=3)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    low = columns["inflation_pressure_psi"] < 24.0
    lost = np.where(low, 0.35 * np.maximum(columns["drawbar_pull_kn"] - 0.6, 0.0), 0.0)
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"] - lost
    case = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "pressure_gauge_bias")}
    found = diagnose(case, 1, effects=few)
    assert found.verdict == "unknown"
    lead = size_sentences(found, "unknown")[0]
    assert lead.startswith("what is missing sets in below an inflation pressure of")
    assert 18.0 < float(lead.split(" of ")[1].split()[0]) < 30.0
    assert "in small steps about an inflation pressure of" in gap_evidence(found).look


def test_short_waves_are_said_so_beside_the_noise_that_is_left():
    from dataclasses import replace

    import numpy as np

    from calib.gap.diagnose import diagnose
    from calib.gap.effects import EFFECTS
    from calib.report.gap_sizes import size_sentences
    from tests.gap.cases import PULL_ONLY, make_case

    # Lugs that pass one by one rock the pull by 0.15 kN; the noise is a fifth of that.
    case = make_case(None, models=PULL_ONLY, n_field=36, n_fresh=3)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    wave = np.sin(2.0 * np.pi * columns["slip_ratio"] / 0.09)
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"] + 0.15 * wave
    case = replace(case, field=table_from_arrays(columns))
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    found = diagnose(case, 1, effects=few)
    assert found.verdict == "unknown"
    lead = size_sentences(found, "unknown")[0]
    assert lead == "what is missing goes along with slip, in short waves"
    look = gap_evidence(found).look
    assert look.startswith(
        "repeat runs, and add runs over slip in steps much smaller than the waves"
    )
    reader = Reader()
    reader.feed(render_diagnosis(found, [], {}, manifest={}))
    # Of the variant that is believed, not of one that takes the waves for noise.
    noise = re.search(r"noise sd of a reading ([0-9.]+) kN", reader.text)
    assert noise is not None
    assert float(noise[1]) < 0.08


def test_what_comes_and_goes_is_not_told_by_its_end(tmp_path):
    from dataclasses import replace

    import numpy as np

    from calib.gap.diagnose import diagnose
    from calib.gap.effects.user import load_effects
    from calib.report.gap_sizes import size_sentences
    from tests.gap.cases import PULL_ONLY, make_case
    from tests.gap.test_load_effects import CODE, write

    # Wind on every other run: over the last runs its mean is half of what it is in a gust.
    code = CODE.replace("phi[:, :1]", 'phi[:, :1] * (view.of("order") % 2.0)')
    code = code.replace("    outputs =", '    covariates = ("order",)\n    outputs =')
    effects = load_effects(write(tmp_path, code))
    case = make_case(None, models=PULL_ONLY, n_field=36, n_fresh=3)
    columns = {name: np.array(v) for name, v in case.field.columns.items()}
    gusts = 0.2 * (columns["run_order"] % 2.0)
    columns["drawbar_pull_kn"] = columns["drawbar_pull_kn"] + gusts
    found = diagnose(replace(case, field=table_from_arrays(columns)), 1, effects=effects)
    assert found.ranking.order[0] == "cross_wind"
    (sentence,) = size_sentences(found, "cross_wind")
    size = re.search(r"changes by ([0-9.]+) ± [0-9.]+ kN rms over the field rows", sentence)
    assert size is not None, sentence
    assert float(size[1]) == pytest.approx(np.sqrt(np.mean(gusts**2)), abs=0.03)


def test_prior_probabilities_are_said():
    said = prior_text(pull_diagnosis(None))
    assert said.startswith("none (noise) ")
    assert "each of 3 effects by themselves" in said
    for words in ("dependences on a condition", "pairs that were tried", "something unlisted"):
        assert words in said
    prior = pull_diagnosis(None).ranking.prior
    assert sum(prior.values()) == pytest.approx(1.0)
    assert prior["none"] > prior["force_offset"] > prior["force_offset+sensor_drift"]


def test_what_the_campaigns_cover_is_said_where_a_correction_is_judged(found, page):
    said = covered_text(found)
    assert f"the two campaigns cover: {said}." in page[2].text
    slip = np.concatenate([t["slip_ratio"] for t in (found.data.case.lab, found.data.case.field)])
    assert f"slip {100.0 * slip.min():.0f} to {100.0 * slip.max():.0f} %" in said
    assert "run order" not in said


def test_a_large_gap_says_how_far_its_probabilities_are_coarsened(found, page):
    left = min(0.08 * found.ranking.gap, 0.6)
    coarse = 1.0 + left**2
    assert coarse > 1.01
    said = " ".join(page[2].text.split())
    assert f"Of this gap of {found.ranking.gap:.1f} noise sd" in said
    assert f"the logarithms of all odds are divided by 1 + {left:.2g}² = {coarse:.2f}." in said
