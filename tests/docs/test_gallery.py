"""Every notebook of the gallery runs, and what it says in words is what its cells find."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.commands import Calib
from tests.docs.pages import DOCS, NOTEBOOKS, Notebook, blocks, run_notebook

pytestmark = pytest.mark.usefixtures("as_before")


@pytest.fixture
def notebook(
    request: pytest.FixtureRequest, run: Calib, monkeypatch: pytest.MonkeyPatch
) -> Notebook:
    """The notebook that a test is named after, run in an empty folder."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return run_notebook(NOTEBOOKS[request.node.name.removeprefix("test_")], run)


def said(name: str, *words: str) -> None:
    """Check that a notebook says something in its text."""
    text = re.sub(r"```.*?```", "", NOTEBOOKS[name].read_text(encoding="utf-8"), flags=re.S)
    text = " ".join(text.split())
    assert [part for part in words if part not in text] == []


def test_own_csv(notebook: Notebook) -> None:
    said(
        "own_csv", "The verdict is *fine*", "covers 12 of 15", "At 10 % slip it does not pull 5 kN"
    )
    assert "verdict: fine: Holds on unseen rows" in notebook.text
    covered = notebook["loo"].scores.coverage[0.9]
    assert (covered.hits, covered.n) == (12, 15)
    lower, upper = (
        ends[0.9]
        for ends in (
            notebook["prediction"].predictive.lower,
            notebook["prediction"].predictive.upper,
        )
    )
    assert lower[1] > 5.0 > upper[0]
    assert notebook.figures == 2


def test_priors(notebook: Notebook) -> None:
    said(
        "priors",
        "The widths of `C2` and `C3` are those of their priors",
        "within 0.005",
        "by 0.07",
        "twice the noise",
    )
    default, mine = notebook["default"].summary, notebook["mine"].summary
    assert {n for n in notebook["names"] if default[n].sd_ratio > 0.9} == {"C2", "C3"}
    assert all(default[n].sd_ratio < 0.2 for n in ("gamma_ref", "C4", "sigma"))
    assert mine["C2"].sd_ratio < 0.8
    inside, beyond = np.diff([*notebook["rows"].values()], axis=0)[0]
    assert abs(inside) < 0.005
    assert beyond == pytest.approx(0.07, abs=0.005)
    assert beyond > 2.0 * default["sigma"].median
    assert soil_water(notebook) == pytest.approx([1.0, 9.0], abs=0.3)


def soil_water(notebook: Notebook) -> list[float]:
    water = notebook["soil"]["gravimetric_water_content"]
    return [100.0 * float(end) for end in (water.min(), water.max())]


def test_diagnosis(notebook: Notebook) -> None:
    said(
        "diagnosis", "an effect: `slip_zero_shift`", "above 99 %", "by more than half",
        "about two percentage points", "Drift, passes, speed and water were not recorded",
    )  # fmt: skip
    diagnosis = notebook["diagnosis"]
    assert (diagnosis.verdict, diagnosis.ranking.order[0]) == ("effect", "slip_zero_shift")
    assert diagnosis.inclusion.causes["slip_zero_shift"].probability > 0.99
    assert "True slip is 1.8" in notebook.text
    untested = notebook["facts"]["Not tested"]
    assert all(word in untested for word in ("run_order", "pass_number", "speed", "water"))
    covered = notebook["in_field"].scores.coverage[0.9]
    assert covered.hits < 0.8 * covered.n
    before, after = re.findall(r"(?:before|after): ([\d.]+) kN rms", notebook.text)
    assert float(after) < 0.5 * float(before)
    assert notebook.figures == 2


@pytest.mark.slow
def test_own_simulator(notebook: Notebook) -> None:
    said("own_simulator", "inside the 95 % intervals", "at most 60 runs", "by more than a tenth")
    found, emulated = notebook["calibration"].summary, notebook["emulated"].summary
    for name, true in (("mu", 0.62), ("s0", 0.14), ("rr", 0.07)):
        assert found[name].hdi_lower < true < found[name].hdi_upper
    for name in notebook["calibration"].problem.names:
        for number in ("median", "hdi_lower", "hdi_upper"):
            moved = getattr(found[name], number) - getattr(emulated[name], number)
            assert abs(moved) < (0.1 if number == "median" else 0.2) * found[name].sd
    assert "verdict: fine: Holds on unseen rows" in notebook.text
    assert notebook.figures == 1


def test_comparison(notebook: Notebook) -> None:
    said("comparison", "prefer `modified_bekker` to `bekker`", "cannot tell it from `lyasko`")
    said("comparison", "more than five standard errors", "less than half", "are much wider")
    assert "The data prefer modified_bekker to bekker." in notebook.text
    assert "The data cannot tell lyasko and modified_bekker apart." in notebook.text
    behind = notebook["comparison"].differences["bekker"]
    assert behind.elpd > 5.0 * behind.se
    held = notebook["held"]
    assert held["modified_bekker"].scores.rmse < 0.5 * held["bekker"].scores.rmse
    assert all(one.scores.coverage[0.9].hits == one.scores.n == 9 for one in held.values())
    narrow, wide = re.findall(r"bekker ([\d.]+) mm", notebook.text)
    assert float(wide) > 2.0 * float(narrow)
    assert notebook.figures == 1


def test_next_measurement(notebook: Notebook) -> None:
    said("next_measurement", "88 % to 94 %", "five readings at 42 psi", "About one in ten")
    first, second = (
        notebook[name].to_dataframe()["probability"].round(2) for name in ("first", "second")
    )
    assert (first["slip_sinkage"], second["slip_sinkage"]) == (0.88, 0.94)
    assert second["unknown"] == pytest.approx(0.1, abs=0.03)
    plan = notebook["plan"].iloc[0]
    assert plan["separates"] == "slip_sinkage from slip_sinkage+unknown"
    assert (plan["readings"], plan["inflation_pressure_psi"]) == (5, 42.0)
    assert plan["slip_ratio"] < 0.001
    assert "add about 5 measurements at inflation pressure 42 psi, slip 0 %" in notebook.text
    assert [len(notebook[table]) for table in ("more", "rows")] == [7, 21]
    assert (notebook["verdict"].state, notebook.figures) == ("Cause named", 1)


@pytest.mark.slow
def test_review(notebook: Notebook) -> None:
    said("review", "the verdict is *with care*", "more than twice as much", "about two independent")
    assert "False" not in notebook.text
    assert notebook["outcome"].verdict.startswith("SAME")
    assert "DIFFERENT: data.csv" in notebook.text
    assert "90 % band covers 14 of 14" in notebook.text
    assert notebook["verdict"].level.value == "with care"
    assert "14 rows worth 1.8 independent rows" in notebook.text
    assert "the scatter differs with inflation pressure" in notebook.text
    sd = notebook["frame"].groupby("inflation_pressure_psi")["residual"].std()
    assert sd[18.0] > 2.0 * sd[42.0]
    assert notebook.figures == 1


def test_own_effect(notebook: Notebook) -> None:
    said("own_effect", "probability is above 90 %", "The free form keeps most of the rest")
    cause = notebook["diagnosis"].to_dataframe()["probability"]
    assert cause["warm_tread"] > 0.9
    assert cause["depends_on_tyre_temperature"] > 0.5 * (1.0 - cause["warm_tread"])
    assert cause.drop(["warm_tread", "depends_on_tyre_temperature"]).max() < 0.05
    assert "A warm tread grips less" in notebook.text
    assert notebook.figures == 1


def test_every_notebook_is_tested_listed_and_described() -> None:
    assert {f"test_{name}" for name in NOTEBOOKS} <= set(globals())
    index = (DOCS / "gallery" / "index.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\]\((\w+)\.md\)", index)) == sorted(NOTEBOOKS)
    hidden = next(block for block in blocks(index) if block.language == "toctree")
    assert sorted(hidden.text.split()) == sorted(NOTEBOOKS)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_every_figure_is_described_for_those_who_do_not_see_it(name: str) -> None:
    text = NOTEBOOKS[name].read_text(encoding="utf-8")
    drawn = len(re.findall(r"\.plot\(\)|plt\.subplots", text))
    assert drawn == len(re.findall(r'^mystnb: \{image: \{alt: "[A-Z]', text, re.M)) > 0
