"""Stated allowances: what they let pass, and what not."""

from __future__ import annotations

from typing import Any

import pytest

from calib.reproduce.items import Item, Status
from calib.reproduce.numbers import Section, compare_section, flatten
from calib.reproduce.stated import audit_allowances, gap_allowances, sensitivity_allowances


def sensitivity(**changed: Any) -> dict[str, Any]:
    n1 = {
        "contraction": 0.9, "prior": 0.3, "likelihood": 0.5,
        "identified": True, "reading": "data and prior",
    }  # fmt: skip
    return {"prior_sensitivity": {"parameters": {"n1": {**n1, **changed}}}}


def statuses(old: Any, new: Any, rules: Any) -> dict[str, Status]:
    section = Section("file", (), dict(flatten(old)), dict(flatten(new)))
    found: list[Item] = compare_section(section, rules, group_of=lambda _: "", exact=False)
    # Names of lists are not what is looked at.
    named = {item.name.removeprefix("file: ").rpartition(".")[2]: item.status for item in found}
    return {k: v for k, v in named.items() if k not in ("name", "key")}


@pytest.mark.parametrize(
    ("recorded", "computed", "name", "expected"),
    [
        ({"prior": 0.35}, {}, "prior", Status.WITHIN),
        ({"prior": 0.9}, {}, "prior", Status.DIFFERENT),
        ({"contraction": 0.5}, {}, "contraction", Status.DIFFERENT),
        # What is read off numbers may differ only where one of them is near its threshold.
        ({"identified": False}, {}, "identified", Status.DIFFERENT),
        ({"reading": "data"}, {}, "reading", Status.DIFFERENT),
        ({"reading": "data", "prior": 0.049}, {"prior": 0.051}, "reading", Status.UNJUDGED),
        ({"contraction": None}, {"contraction": None}, "contraction", Status.IDENTICAL),
        ({"contraction": 0.5}, {"contraction": None}, "contraction", Status.UNJUDGED),
    ],
)
def test_a_sensitivity(recorded: Any, computed: Any, name: str, expected: Status) -> None:
    new = sensitivity(**computed)
    rules = sensitivity_allowances(dict(flatten(new)))
    assert statuses(sensitivity(**recorded), new, rules)[name] is expected


def test_the_best_hypothesis_of_a_gap_is_judged_and_the_others_parameters_are_not() -> None:
    def diagnosis(best: float, other: float) -> dict[str, Any]:
        return {
            "verdict": "effect",
            "effects": [
                {"name": "a", "probability": 0.9, "parameters": {"size_a": {"mean": best}}},
                {"name": "b", "probability": 0.1, "parameters": {"size_b": {"mean": other}}},
            ],
        }

    new = diagnosis(1.0, 1.0)
    section = Section("file", (), dict(flatten(diagnosis(1.5, 1.5))), dict(flatten(new)))
    rules = gap_allowances(section.found, "a")
    found = {
        item.name: item.status
        for item in compare_section(section, rules, group_of=lambda _: "", exact=False)
    }
    assert found["file: effects.a.parameters.size_a.mean"] is Status.DIFFERENT
    assert found["file: effects.b.parameters.size_b.mean"] is Status.UNJUDGED


def test_a_figure_of_the_audit_that_nothing_moves_must_stay() -> None:
    def audit(cost: float, n0: float, seed: int = 1) -> dict[str, Any]:
        found = {"lower": 1.9, "upper": 3.5}
        return {
            "seed": seed,
            "findings": [
                {"key": "table5_joint_cost", "found": [{"name": "least", "cost": cost}]},
                {"key": "table6_likelihood", "found": [{"name": "n0", "mean": n0, **found}]},
            ],
        }

    new = audit(0.07, 2.7)
    rules = audit_allowances(dict(flatten(new)))
    assert statuses(audit(0.0701, 2.75, seed=2), new, rules) == {
        "seed": Status.DIFFERENT, "cost": Status.DIFFERENT, "mean": Status.WITHIN,
        "lower": Status.IDENTICAL, "upper": Status.IDENTICAL,
    }  # fmt: skip
