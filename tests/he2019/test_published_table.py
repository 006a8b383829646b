"""Each table of the source beside the same computed again: its figures return, misprints do not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calib.he2019.audit import Audit, Verdict
from calib.he2019.tables import Row, published_table
from tests.he2019.altered import altered, printed_figures


def rows(number: int, audit: Audit) -> dict[str, Row]:
    return {f"{row.where}: {row.name}": row for row in published_table(number, audit).rows}


def test_table_4_returns_to_every_digit_and_lies_in_the_posterior(audit: Audit) -> None:
    found = rows(4, audit)
    assert len(found) == 15
    assert all(row.returns for row in found.values())
    assert all(row.inside for row in found.values() if row.name != "cost")
    # Of several findings the one that supports a figure least: digits are enough, the sign is open.
    assert found["Table 4, 18 psi: E"].finding == "table4_18_sign_of_E"
    assert found["Table 4, 18 psi: B"].judgement == (
        "same digits; inside the HDI; confirmed (table4_digits)"
    )


@pytest.mark.slow
def test_a_misprint_is_told(audit: Audit) -> None:
    wrong = altered({"Table 4, 30 psi: D": "1.2071"}, audit.published)
    found = rows(4, replace(audit, published=wrong))["Table 4, 30 psi: D"]
    assert (found.returns, found.inside) == (False, False)
    assert found.judgement.startswith("other digits; OUTSIDE THE HDI; ")


def test_every_figure_of_every_table_is_judged(audit: Audit) -> None:
    found = rows(2, audit) | rows(6, audit) | rows(1, audit)
    for number in (1, 2, 6):
        printed = {k for k in printed_figures(audit.published) if k.startswith(f"Table {number}")}
        assert printed == {k for k in found if k.startswith(f"Table {number}")}
    assert all(row.verdict in list(Verdict) and row.finding for row in found.values())
    # The regression as published returns Table 6; its goodness of fit is of another quantity.
    assert [found[f"Table 6: {name}"].returns for name in ("n0", "n1", "k")] == [True] * 3
    assert found["Table 6: rmse"].returns is None
    assert found["Table 1: rmse"].returns
    assert found["Table 2: NP"].judgement.startswith("confirmed")


@pytest.mark.slow
@pytest.mark.parametrize("number", [3, 5])
def test_tables_that_do_not_return_say_so(audit: Audit, number: int) -> None:
    found = rows(number, audit)
    assert not all(row.returns for row in found.values())
    assert sum(row.inside is False for row in found.values()) >= 3
    assert found["Table 3, 18 psi: D" if number == 3 else "Table 5: c3"].returns
