"""The steps of a diagnosis, each by itself: what follows what, and what is said."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import calib.gap.diagnose as module
from calib.batch.pool import HERE
from calib.data import table_from_arrays
from calib.gap.campaigns import campaigns
from calib.gap.case import Context
from calib.gap.diagnose import (
    _beyond,
    _confounded,
    _left_out,
    _without_context,
    diagnose_once,
    screened_ranking,
    verdict,
    with_unseen_rows,
)
from calib.gap.effects import EFFECTS
from calib.gap.mixture import Included
from tests.gap.cases import PULL_ONLY, make_case


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        ({"none": 0.5, "a": 0.5}, "none"),
        ({"none": 0.49, "a": 0.5}, "effect"),
        ({"unknown": 0.5, "a": 0.5}, "unknown"),
        ({"a": 0.3, "a+unknown": 0.2, "unknown": 0.49}, "effect"),
        ({"a": 0.3, "a+unknown": 0.199, "unknown": 0.49}, "ambiguous"),
        # Something unlisted beside causes that are none probable by themselves names nothing.
        ({"a+unknown": 0.4, "b+unknown": 0.4}, "ambiguous"),
        ({}, "ambiguous"),
    ],
)
def test_a_verdict_needs_a_probability_of_one_half(probability, expected):
    assert verdict(probability) == expected


def test_rows_are_set_aside_and_all_is_ranked_again_three_times_at_most(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "screen", lambda case, seed: ("data 0", "lab", ["far"]))
    monkeypatch.setattr(module, "left_over", lambda data, ranking: [f"left {data} {ranking}"])

    def rank(data, seed, *, effects, lab):
        asked.append((data, seed, effects, lab))
        return f"ranking of {data}"

    def outliers_until(last):
        def outliers(data, ranking):
            assert ranking == f"ranking of {data}"
            n = int(data[-1])
            return (data, []) if n == last else (f"data {n + 1}", [f"row {n}"])

        return outliers

    monkeypatch.setattr(module, "rank", rank)
    for last, rounds in ((0, 0), (1, 1), (9, 3)):
        asked.clear()
        monkeypatch.setattr(module, "without_field_outliers", outliers_until(last))
        data, ranking, said = screened_ranking("case", 7, {})
        assert asked == [(f"data {i}", 7, {}, "lab") for i in range(rounds + 1)]
        assert (data, ranking) == (f"data {rounds}", f"ranking of data {rounds}")
        rows = [f"row {i}" for i in range(rounds)]
        assert said == ["far", *rows, f"left {data} {ranking}"]


def found_with(**parts):
    case = SimpleNamespace(new_conditions=None)
    view = SimpleNamespace(conditions="conditions")
    corrected = SimpleNamespace(calibrated=lambda conditions: f"before at {conditions}")
    defaults = {
        "data": SimpleNamespace(case=case, view=view), "truth": "truth", "corrected": corrected,
        "shrink": {"pull": "as seen"},
    }  # fmt: skip
    return SimpleNamespace(**{**defaults, **parts})


def test_a_shrink_is_judged_on_rows_left_out_if_there_are_no_other_conditions(monkeypatch):
    monkeypatch.setattr(module, "_left_out", lambda found, effects, pool: "unseen")
    monkeypatch.setattr(module, "shrink", lambda *of: of)
    monkeypatch.setattr(module, "replace", lambda found, **new: (found, new))
    found = found_with()
    again, new = with_unseen_rows(found)
    assert again is found
    assert new == {"shrink": (found.data, "truth", "before at conditions", "unseen")}
    without = found_with(shrink={})
    assert with_unseen_rows(without) is without
    fresh = found_with()
    fresh.data.case.new_conditions = "fresh"
    assert with_unseen_rows(fresh) is fresh


@pytest.mark.parametrize(("rows", "few"), [(6, True), (7, False), (23, False)])
def test_every_row_is_predicted_by_a_diagnosis_that_has_not_seen_it(rows, few, monkeypatch):
    """In five parts; with fewer than five rows left of any they are predicted as seen."""
    case = make_case(None, models=PULL_ONLY, n_field=rows)
    data = campaigns(case)
    seen: list[set[int]] = []

    def unseen(case, view, seed, effects, lab, design):
        assert (seed, lab, design) == (3, "lab", "design")
        here = np.flatnonzero(np.isfinite(case.field["drawbar_pull_kn"]))
        seen.append(set(here.tolist()))
        values = np.full(rows, 100.0)
        values[here] = -1.0
        return {"drawbar_pull": values}

    monkeypatch.setattr(module, "_unseen", unseen)
    monkeypatch.setattr(module, "calibrate_lab", lambda data, seed: "lab")
    truth = SimpleNamespace(means={"drawbar_pull": np.zeros(rows)})
    ranking = SimpleNamespace(isolability="design")
    found = SimpleNamespace(data=data, truth=truth, seed=3, ranking=ranking)
    predicted = _left_out(found, {}, HERE)["drawbar_pull"]
    least = rows - -(-rows // 5)
    assert (least < module.MIN_FIELD_ROWS) == few
    assert predicted.tolist() == [0.0 if few else 100.0] * rows
    assert len(seen) == (0 if few else 5)
    if not few:
        assert sorted(i for s in seen for i in set(range(rows)) - s) == list(range(rows))


def test_what_was_not_covered_or_has_no_value_is_said(monkeypatch):
    case = make_case(None, models=PULL_ONLY, n_fresh=4)
    corrected = SimpleNamespace(data=SimpleNamespace(case=case))
    monkeypatch.setattr(module, "conditions_outside", lambda corrected, new: {"speed_m_s": 3})
    values = np.array([1.0, np.nan, np.nan, 2.0])
    outside, empty = _beyond(corrected, {"drawbar_pull": values, "rut_depth": np.ones(4)})
    assert "speed_m_s: 3 of 4 rows" in outside
    assert "has no drawbar pull at 2 of 4 rows" in empty
    corrected.data.case = replace(case, new_conditions=None)
    assert _beyond(corrected, {"drawbar_pull": values}) == []


@pytest.mark.parametrize(
    ("probability", "declared", "inseparable", "said"),
    [
        (0.05, False, True, True), (0.049, False, True, False), (0.0, True, True, True),
        (0.9, True, False, False), (0.9, False, False, False), (None, True, True, False),
    ],
)  # fmt: skip
def test_what_cannot_be_separated_is_said_of_what_is_probable_or_declared(
    probability, declared, inseparable, said, monkeypatch
):
    effect = SimpleNamespace(covariates=("crew",))
    monkeypatch.setattr(module, "inseparable", lambda data, effect: inseparable)
    covariates = {"crew": ("a", "b")} if declared else {"other": ()}
    data = SimpleNamespace(case=SimpleNamespace(covariates=covariates))
    causes = {} if probability is None else {
        "depends_on_crew": Included(probability, 0.1, (0.0, 0.2))
    }  # fmt: skip
    told = _confounded(data, SimpleNamespace(causes=causes), {"depends_on_crew": effect})
    assert [t.split(":")[0] for t in told] == (["depends_on_crew"] if said else [])


def test_a_context_is_taken_away_for_a_second_look(monkeypatch):
    asked = []

    def screened(case, seed, effects):
        asked.append((case.context, seed, effects))
        p = {"none": 0.3, "a": 0.2, "a+unknown": 0.5}
        return None, SimpleNamespace(probability=p), []

    monkeypatch.setattr(module, "screened_ranking", screened)
    case = make_case(None, models=PULL_ONLY)
    assert _without_context(case, 1, {}) is None
    told = replace(case, context=Context(suspected={"a": 0.9}))
    found = _without_context(told, 4, {})
    assert found == pytest.approx({"none": 0.3, "a": 0.7, "unknown": 0.5})
    assert asked == [(Context(), 4, {})]


FEW = {
    "rate_effect": EFFECTS["rate_effect"],
    "multipass_compaction": EFFECTS["multipass_compaction"],
}


def test_conditions_to_predict_that_lack_what_the_field_has_are_named() -> None:
    """And one that the field lacks explains nothing there."""
    case = make_case("rate_effect", n_fresh=9)
    fresh = case.new_conditions
    assert fresh is not None
    columns = {n: v for n, v in fresh.columns.items() if n != "speed_m_s"}
    found = diagnose_once(replace(case, new_conditions=table_from_arrays(columns)), 1, FEW)
    assert any("lacks speed_m_s, which the field campaign has" in w for w in found.warnings)
    whole = diagnose_once(case, 1, FEW)
    assert not any("lacks" in w for w in whole.warnings)
    field = {n: v for n, v in case.field.columns.items() if n != "pass_number"}
    without = diagnose_once(replace(case, field=table_from_arrays(field)), 1, FEW)
    assert np.isfinite(without.shrink["drawbar_pull"].rmse_after)
