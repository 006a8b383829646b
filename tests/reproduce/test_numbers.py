"""Documents compared number by number: how strictly depends on what they show."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.reproduce.allowances import MONTE_CARLO, Allowance
from calib.reproduce.items import Item, Status
from calib.reproduce.numbers import Section, compare_section, flatten, same_words

RNG = np.random.default_rng(4)
BASE = {f"n{i}": float(v) for i, v in enumerate(RNG.normal(size=40))}
ALLOWED = {(name,): Allowance(1.0, why=MONTE_CARLO) for name in BASE}


def section(recorded, found) -> Section:
    return Section("s.json", ("here",), dict(flatten(recorded)), dict(flatten(found)))


def compare(recorded, found, allowed=ALLOWED, **kwargs) -> dict[str, Item]:
    items = compare_section(section(recorded, found), allowed, group_of=lambda _: "g", **kwargs)
    return {item.name.rpartition(".")[2]: item for item in items}


def counts(items: dict[str, Item]) -> dict[Status, int]:
    return {s: n for s in Status if (n := sum(i.status is s for i in items.values()))}


def test_equal_documents_are_identical() -> None:
    assert counts(compare(BASE, dict(BASE))) == {Status.IDENTICAL: 40}


def test_where_all_else_is_identical_the_last_bit_counts() -> None:
    found = {**BASE, "n7": math.nextafter(BASE["n7"], 9.0)}
    items = compare(BASE, found)
    assert counts(items) == {Status.IDENTICAL: 39, Status.DIFFERENT: 1}
    assert items["n7"].name == "s.json: here.n7"
    assert "last bit" in items["n7"].note


def test_rounding_everywhere_is_the_same_but_hides_nothing() -> None:
    found = {name: v * (1.0 + 1e-12) for name, v in BASE.items()}
    assert counts(compare(BASE, found)) == {Status.WITHIN: 40}
    found["n7"] += 0.1
    items = compare(BASE, found)
    assert counts(items) == {Status.WITHIN: 39, Status.DIFFERENT: 1}
    assert "agree far better" in items["n7"].note


def test_other_draws_have_their_allowance() -> None:
    found = {name: v + 0.3 * float(RNG.uniform(-1, 1)) for name, v in BASE.items()}
    assert counts(compare(BASE, found)) == {Status.WITHIN: 40}
    found["n7"] = BASE["n7"] + 1.1
    items = compare(BASE, found)
    assert [k for k, i in items.items() if i.status is Status.DIFFERENT] == ["n7"]
    assert items["n7"].share == pytest.approx(1.1)


def test_what_has_no_rule_is_not_judged_where_it_differs() -> None:
    found = {name: v + 0.3 for name, v in BASE.items()}
    items = compare(
        {**BASE, "a": 1.0, "b": 1.0, "c": 1.0}, {**found, "a": 1.0 + 1e-9, "b": 1.5, "c": 2.0},
        {**ALLOWED, ("c",): Allowance(why="heavy")},
    )  # fmt: skip
    assert [items[k].status for k in "abc"] == [Status.WITHIN, Status.UNJUDGED, Status.UNJUDGED]
    assert items["c"].note == "heavy"


def test_an_order_of_magnitude_is_no_outlier() -> None:
    found = {name: v * (1.0 + 1e-12) for name, v in BASE.items()}
    rule = {**ALLOWED, ("ess",): Allowance(factor=3.0)}
    for value, status in ((2900.0, Status.WITHIN), (3100.0, Status.DIFFERENT)):
        assert (
            compare({**BASE, "ess": 1000.0}, {**found, "ess": value}, rule)["ess"].status is status
        )


def test_entries_that_one_document_lacks_are_named() -> None:
    items = compare({"a": 1.0, "b": 2.0}, {"a": 1.0, "c": 3.0}, {})
    assert items["b"].note == "not computed by this version"
    assert items["c"].note == "missing"
    assert counts(items) == {Status.IDENTICAL: 1, Status.DIFFERENT: 2}


@pytest.mark.parametrize(
    ("old", "new"), [(1, 1.0), (True, 1), (None, 0.0), ("1", 1), ("a", "b"), (1.0, "nan")]
)
def test_other_kinds_are_not_equal(old, new) -> None:
    assert compare({"x": old}, {"x": new}, {}, exact=True)["x"].status is Status.DIFFERENT


def test_nan_is_nan() -> None:
    assert compare({"x": math.nan}, {"x": math.nan}, {})["x"].status is Status.IDENTICAL


def test_text_may_differ_in_its_numbers_where_that_is_said() -> None:
    shaken = {name: v + 0.3 for name, v in BASE.items()}
    rule = {**ALLOWED, ("note",): Allowance(words=True)}
    for new, status in (
        ("131 generations", Status.WITHIN),
        ("131 failures", Status.UNJUDGED),
    ):
        items = compare({**BASE, "note": "225 generations"}, {**shaken, "note": new}, rule)
        assert items["note"].status is status


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("median 3.2", "median 5", True),
        ("median 3.2", "median 3.2\u00d710\u207b\u2074", True),
        ("\u22121.5 to 2", "1.5 to 2", True),
        ("1,320 evaluations", "1339 evaluations", True),
        ("9 of 9 covered", "9 of 9 missed", False),
    ],
)
def test_words_are_compared_without_their_numbers(one: str, other: str, same: bool) -> None:
    assert same_words(one, other) is same


KEYS = st.text(max_size=3)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | KEYS
JSON = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=8,
)


@given(JSON)
def test_any_document_equals_its_copy(document) -> None:
    copy = json.loads(json.dumps(document))
    items = compare_section(section(document, copy), {}, group_of=lambda _: "g")
    assert all(item.status is Status.IDENTICAL for item in items)
