"""Numbers are what they were: a sample in every run of the tests, all with ``-m slow``."""

from __future__ import annotations

import pytest

from tests.golden.numbers import KINDS, SHARED, computed, moved, recorded

ENTRIES = [(kind, name) for kind, (_, names) in KINDS.items() for name in names]
SAMPLE = {
    ("posterior", "ayers_perumpral"), ("posterior", "magic_formula_pressure"),
    ("posterior", "modified_bekker"), ("posterior", "reece"), ("ranks", "bekker"),
    ("diagnosis", "bench/case-003"),
    ("diagnosis", "measured/hit_lugs"), ("diagnosis", "measured/kls_null_plate"),
    ("diagnosis", "shared/case-003"),
}  # fmt: skip


def test_every_entry_is_recorded() -> None:
    assert set(recorded()) == {f"{kind}/{name}" for kind, name in ENTRIES}


@pytest.mark.parametrize(
    ("kind", "name"),
    [pytest.param(*e, marks=() if e in SAMPLE else pytest.mark.slow) for e in ENTRIES],
)
def test_numbers_are_what_they_were(kind: str, name: str) -> None:
    if name.startswith("shared/") and not SHARED.is_dir():
        pytest.skip("the shared cases are not here")
    assert moved(recorded()[f"{kind}/{name}"], computed(kind, name)) == []
