"""Documents compared entry by entry, each within the tolerance of what it is."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.checking.compare import Item, Status, compare_entries, flatten, without_numbers

FILE = "summary.json"
POSTERIOR = (FILE, "models", "rut_depth", "posterior", "n1")


def compare(old: Any, new: Any, *place: str, drawn: Any = None) -> dict[str, Item]:
    """Entries by the last part of their name."""
    both = (dict(flatten(document, (FILE, *place))) for document in (old, new))
    items = compare_entries(*both, drawn)
    return {item.name.rpartition(".")[2].rpartition(" ")[2]: item for item in items}


def statuses(items: dict[str, Item]) -> dict[str, Status]:
    return {name: item.status for name, item in items.items()}


def test_equal_documents_are_identical() -> None:
    assert statuses(compare({"a": 1.5, "b": "x"}, {"a": 1.5, "b": "x"})) == {
        "a": Status.IDENTICAL, "b": Status.IDENTICAL,
    }  # fmt: skip


@pytest.mark.parametrize("others", [0, 40])
def test_the_last_bit_is_never_a_difference(others: int) -> None:
    """However many others are the same to the last bit."""
    same = {f"n{i}": 1.0 + i for i in range(others)}
    items = compare({"a": 0.1, **same}, {"a": math.nextafter(0.1, 1.0), **same})
    assert items["a"].status is Status.WITHIN
    assert {item.status for name, item in items.items() if name != "a"} <= {Status.IDENTICAL}


@pytest.mark.parametrize("value", [3.7e-12, 1.0, -8.2e15])
def test_arithmetic_may_differ_by_a_millionth(value: float) -> None:
    for by, status in ((0.9e-6, Status.WITHIN), (1.5e-6, Status.DIFFERENT)):
        assert compare({"a": value}, {"a": value * (1.0 + by)})["a"].status is status


def test_counts_and_seeds_must_be_equal() -> None:
    assert compare({"seed": 10**9}, {"seed": 10**9 + 1})["seed"].status is Status.DIFFERENT


@pytest.mark.parametrize(("apart", "status"), [(0.99, Status.WITHIN), (1.01, Status.DIFFERENT)])
def test_what_is_drawn_may_differ_by_its_monte_carlo_error(apart: float, status: Status) -> None:
    drawn = {(*POSTERIOR, "mean"): 0.3}
    item = compare({"mean": 1.0}, {"mean": 1.0 + 0.3 * apart}, *POSTERIOR[1:], drawn=drawn)["mean"]
    assert item.status is status
    assert item.share == pytest.approx(apart)


def test_what_has_no_monte_carlo_error_is_not_judged() -> None:
    drawn = {(*POSTERIOR, "mean"): None}
    item = compare({"mean": 1.0}, {"mean": 9.0}, *POSTERIOR[1:], drawn=drawn)["mean"]
    assert item.status is Status.UNJUDGED
    assert "tail" in item.note


def test_what_is_not_a_number_is_judged_without_one() -> None:
    drawn = {(*POSTERIOR, "mean"): None}
    found = compare({"mean": math.nan}, {"mean": 1.0}, *POSTERIOR[1:], drawn=drawn)
    assert statuses(found) == {"mean": Status.DIFFERENT}


def test_one_number_does_not_depend_on_the_others() -> None:
    """A number that moved within its error is the same beside numbers that did not move at all."""
    drawn = {(*POSTERIOR, key): 0.3 for key in ("mean", "sd", "median")}
    old = {"mean": 1.0, "sd": 1.0, "median": 1.0}
    items = compare(old, {**old, "mean": 1.2}, *POSTERIOR[1:], drawn=drawn)
    assert statuses(items) == {
        "mean": Status.WITHIN, "sd": Status.IDENTICAL, "median": Status.IDENTICAL,
    }  # fmt: skip


@pytest.mark.parametrize(("new", "status"), [(99.0, Status.WITHIN), (0.9, Status.DIFFERENT)])
def test_of_some_numbers_the_size_is_what_counts(new: float, status: Status) -> None:
    assert (
        compare({"ess_bulk": 10.0}, {"ess_bulk": new}, *POSTERIOR[1:])["ess_bulk"].status is status
    )


def test_entries_that_one_document_lacks_are_named() -> None:
    items = compare({"a": 1.0, "b": 2.0}, {"a": 1.0, "c": 3.0})
    assert items["b"].note == "not computed by this version"
    assert items["c"].note == "missing"
    assert statuses(items) == {
        "a": Status.IDENTICAL, "b": Status.DIFFERENT, "c": Status.DIFFERENT,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new"), [(1, 1.0), (True, 1), (None, 0.0), ("1", 1), ("a", "b"), (1.0, "nan")]
)
def test_other_kinds_are_not_equal(old, new) -> None:
    assert compare({"x": old}, {"x": new})["x"].status is Status.DIFFERENT


def test_nan_is_nan() -> None:
    assert compare({"x": math.nan}, {"x": math.nan})["x"].status is Status.IDENTICAL


@pytest.mark.parametrize(
    ("new", "status"),
    [("131 generations", Status.WITHIN), ("131 failures", Status.DIFFERENT)],
)
def test_text_may_differ_in_its_numbers_where_that_is_said(new: str, status: Status) -> None:
    place = ("models", "rut_depth", "fit", "genetic")
    assert compare({"note": "225 generations"}, {"note": new}, *place)["note"].status is status
    assert compare({"word": "225 rows"}, {"word": "226 rows"})["word"].status is Status.DIFFERENT


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
    assert (without_numbers(one) == without_numbers(other)) is same


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
    both = (dict(flatten(d, (FILE,))) for d in (document, copy))
    items = compare_entries(*both)
    assert all(item.status is Status.IDENTICAL for item in items)
