"""The table of published figures: frozen, signed, and aware of its printed digits."""

from __future__ import annotations

import dataclasses

import pytest

from calib.he2019.published import PUBLISHED
from calib.report.reference import Figure
from tests.he2019.audit.altered import printed_figures


def test_a_figure_knows_its_printed_digits() -> None:
    figure = Figure("5.934e-10")
    assert figure.value == 5.934e-10
    assert figure.half_unit == pytest.approx(5e-14)
    assert figure.agrees(5.9344e-10)
    assert not figure.agrees(5.9346e-10)
    assert Figure("0.0083").agrees(0.00834)
    assert Figure("3.306e5").half_unit == pytest.approx(50.0)
    assert not Figure("2").agrees(3)


def test_nothing_can_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        PUBLISHED.bulk_density.source = "elsewhere"  # type: ignore[misc]
    with pytest.raises(TypeError):
        PUBLISHED.bulk_density.estimates["C1"] = Figure("1")  # type: ignore[index]
    with pytest.raises(TypeError):
        PUBLISHED.genetic[18] = PUBLISHED.genetic[30]  # type: ignore[index]
    with pytest.raises(TypeError):
        PUBLISHED.setup.genetic_settings["F"] = Figure("1")  # type: ignore[index]


def test_every_table_names_its_source() -> None:
    tables = [PUBLISHED.bulk_density, PUBLISHED.pressure, PUBLISHED.rut_depth]
    tables += [*PUBLISHED.geometric.values(), *PUBLISHED.genetic.values()]
    assert {table.source.split(",")[0] for table in tables} == {
        "Table 1", "Table 3", "Table 4", "Table 5", "Table 6",
    }  # fmt: skip


def test_every_negative_sign_says_what_it_was_inferred_from() -> None:
    tables = [PUBLISHED.bulk_density, PUBLISHED.pressure, PUBLISHED.rut_depth]
    tables += [*PUBLISHED.geometric.values(), *PUBLISHED.genetic.values()]
    for table in tables:
        for name, figure in table.estimates.items():
            assert figure.note or "-" not in figure.text, (table.source, name)


def test_every_printed_figure_is_listed_once() -> None:
    found = printed_figures(PUBLISHED)
    # Tables 1 and 6: 4 + 3 and 3 + 7; Tables 3 and 4: 5 for each pressure; Table 5: 10 + 1.
    tables = 7 + 10 + 2 * 3 * 5 + 11
    setup = len(PUBLISHED.setup.genetic_settings) + 3 + 2 + 8
    assert len(found) == tables + setup
    assert found["Table 4, 18 psi: E"].text == "-0.1026"
    assert found["Table 2: NP"].value == 50
    assert found["Setup: contact length, 42 psi"].unit == "mm"
