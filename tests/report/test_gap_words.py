"""The verdict on a gap and all that is said of it: from fixed documents, one for each rule."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from calib.gap.document import GapDocument, RunTrend, load_document
from calib.gap.files import contract
from calib.report.gap_words import RULES, Tone, Words, chance, gap_verdict, judge, short_name
from calib.report.labels import odds_text
from calib.report.page.diagnosis import render_page
from tests.pages import Reader
from tests.report.gap_documents import DOCUMENTS, LUGS, PULL, RUNS, gap

MACROS = ("covered", "prior")


@pytest.mark.parametrize("name", DOCUMENTS)
def test_what_is_said(name, snapshot):
    d = DOCUMENTS[name]
    words = Words(d)
    card = words.verdict()
    said = [f"{card.tone} ({card.rule}): {card.state}", card.headline]
    said += [f"{label}: {text}" for label, text in card.facts]
    said += [words(macro) for macro in MACROS] + [words("simulator", o) for o in d.outputs]
    said += [words(kind, p) for e in d.explanations for kind, own in
             (("parameter", e.parameters), ("shift", e.shifts)) for p in own]  # fmt: skip
    said += [words("term", s) for s in d.suggestions]
    assert "\n".join([*said, words.terminal()]) == snapshot


def test_the_rules_are_ten_and_each_decides_once():
    rules = [rule for rule, _, _ in RULES]
    assert len(set(rules)) == 10
    assert {judge(d)[1] for d in DOCUMENTS.values()} == set(rules)
    assert all(judge(d)[1] == name.partition(":")[0] for name, d in DOCUMENTS.items())


@pytest.mark.parametrize(
    ("changes", "tone", "rule"),
    [
        ({}, Tone.FINE, "named"),
        ({"doubts": ("the field scatters",)}, Tone.CARE, "named"),
        # A change over the runs decides where it is probable, and no cause is certain.
        ({"runs": RUNS}, Tone.FINE, "named"),
        ({"runs": RUNS, "causes": ()}, Tone.CARE, "over runs"),
        ({"runs": replace(RUNS, probability=0.44), "causes": ()}, Tone.FINE, "named"),
        ({"runs": RunTrend(("drawbar_pull",), 0.95, (("drift", 0.85), ("step", 0.1)))},
         Tone.FINE, "named"),
        ({"runs": RUNS, "verdict": "none"}, Tone.FINE, "none"),
    ],
)  # fmt: skip
def test_what_decides(changes, tone, rule):
    d = replace(gap("effect", {"lug_thrust": 0.93}), **changes)
    assert judge(d) == (tone, rule)


@pytest.mark.parametrize(
    ("explanations", "cause", "rule"),
    [
        ({"lug_thrust": 0.6, "sensor_drift": 0.25}, 0.6, "likely"),
        ({"lug_thrust": 0.6, "sensor_drift": 0.35}, 0.6, "tie"),
        # Every explanation that is half as probable has the cause, or the cause is certain.
        ({"lug_thrust": 0.5, "lug_thrust+sensor_drift": 0.4}, 0.9, "named"),
        ({"lug_thrust": 0.4, "lug_thrust+sensor_drift": 0.15, "sensor_drift": 0.25}, 0.55, "tie"),
    ],
)
def test_a_cause_with_a_rival_about_as_probable_is_not_named(explanations, cause, rule):
    d = gap("effect", explanations, causes=(replace(LUGS, probability=cause),))
    assert judge(d)[1] == rule


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_saved_document_is_loaded_as_it_was(name, tmp_path):
    (tmp_path / "document.json").write_bytes(DOCUMENTS[name].json())
    loaded = load_document(tmp_path)
    assert loaded.json() == DOCUMENTS[name].json()
    assert gap_verdict(loaded) == gap_verdict(DOCUMENTS[name])


def test_a_document_of_before_is_loaded_and_has_its_page(tmp_path):
    old = json.loads(DOCUMENTS["named"].json())
    for name in ("false_discovery_rate", "laboratory_bias", "suggestions"):
        del old[name]
    (tmp_path / "document.json").write_text(json.dumps(old))
    loaded = load_document(tmp_path)
    assert gap_verdict(loaded) == gap_verdict(DOCUMENTS["named"])
    text = Reader(render_page(loaded, [], {})).text
    assert not re.search("false discovery|[Ii]gnoring the causes|Suggestions", text)


def test_programs_read_the_same_numbers():
    told = contract(DOCUMENTS["named"])
    assert [w.get("reason") for w in told["where"]] == [None] * 4 + ["there is no reading"]
    assert told["effects"][0]["parameters"]["thrust"] == {"mean": 0.09, "sd": 0.01}
    assert told["data_label"] == "reconstructed"


def test_small_pulls_are_in_newtons():
    small = replace(PULL, measured=tuple(1e-3 * v for v in PULL.measured))
    axes = [Words(gap("effect", {"lug_thrust": 0.9}, outputs=(o,))).n.axis("drawbar_pull")
            for o in (PULL, small)]  # fmt: skip
    assert [(a.unit, a.factor) for a in axes] == [("kN", 1.0), ("N", 1000.0)]


def test_categories_are_told_by_their_values():
    d: GapDocument = replace(DOCUMENTS["named"], covariates={"operator": ("Berg", "Lind"), "t": ()})
    n = Words(d).n
    assert n.stretch("operator", 1.0, 1.0) == "operator Lind"
    assert n.stretch("t", 3.0, 8.0) == "t 3 to 8"


def test_no_probability_is_certain():
    assert [odds_text(p) for p in (1.0, 0.5, 0.0)] == ["above 99 %", "50 %", "below 1 %"]
    assert [chance(p) for p in (0.999, 0.42, 0.004)] == ["> 99 %", "42 %", "< 1 %"]
    assert short_name("lug_thrust+unknown") == "lug thrust + something unlisted"
