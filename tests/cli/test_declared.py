"""What is registered is told from its declaration, shipped or of one's own."""

from __future__ import annotations

import json

import pytest

from calib.cli.app import app
from calib.data.quantities import QUANTITIES
from calib.gap.effects import EFFECTS
from calib.models import MODELS
from tests.commands import Calib


@pytest.mark.parametrize(
    ("what", "known"), [("models", MODELS), ("effects", EFFECTS), ("quantities", QUANTITIES)]
)
def test_all_are_listed_and_each_is_told(calib: Calib, what: str, known: dict) -> None:
    listed = calib(what)
    assert listed.code == 0
    assert all(f"{name}: " in listed.out for name in known)
    assert list(json.loads(calib(what, "--json").out)[what]) == list(known)
    for name in known:
        told = calib(what, name, "--json")
        assert told.code == 0
        assert json.loads(told.out)[what][name]["title"]


@pytest.mark.parametrize(
    ("what", "given", "near"),
    [
        ("models", "bekkr", "bekker"),
        ("effects", "slipzero", "slip_zero_shift"),
        ("quantities", "pressure", "inflation_pressure_psi or average_ground_pressure_kpa"),
        ("quantities", "rut_dept", "rut_depth_mm"),
    ],
)
def test_a_name_that_is_not_there_is_answered_by_one_like_it(
    calib: Calib, what: str, given: str, near: str
) -> None:
    refused = calib(what, given)
    assert refused.code == 2
    assert f"did you mean {near}? or name the file" in refused.err


def test_an_effect_is_told_with_equation_needs_and_priors(calib: Calib) -> None:
    told = calib("effects", "moisture_softening").out
    for words in ("equation: ", "The field records gravimetric_water_content.", "No formula is"):
        assert words in told
    facts = json.loads(calib("effects", "moisture_softening", "--json").out)
    priors = facts["effects"]["moisture_softening"]["priors"]
    assert list(priors) == list(EFFECTS["moisture_softening"].parameters)
    assert all(p["source"] and p["why"] for p in priors.values())


def test_a_quantity_is_found_by_whatever_a_column_may_be_called(calib: Calib) -> None:
    for name in ("normal_load_kn", "load", "wheel_load_lbf"):
        assert calib("quantities", name).out.startswith("normal_load_kn: Normal load")


@pytest.mark.parametrize("what", ["models", "effects", "quantities"])
def test_what_there_is_not_is_refused_with_what_there_is(calib: Calib, what: str) -> None:
    refused = calib(what, "nothing")
    assert refused.code == 2
    assert "there is no" in refused.err
    assert "expected: " in refused.err


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("fit --model magic", ["magic_formula", "magic_formula_pressure"]),
        ("effects slip_z", ["slip_zero_shift"]),
        ("quantities inflation", ["inflation_pressure"]),
        ("predict --without force", ["force_offset"]),
    ],
)
def test_the_tab_key_completes_names(monkeypatch, capfd, words: str, found: list[str]) -> None:
    monkeypatch.setenv("_CALIB_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"calib {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
    with pytest.raises(SystemExit):
        app(prog_name="calib")
    assert capfd.readouterr().out.split() == found
