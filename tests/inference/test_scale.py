"""Outputs of a size that the priors exclude are refused, with what was assumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.data import Table, read_table, table_from_arrays
from calib.errors import CalibError
from calib.inference.prior_files import DeclaredPriors, default_priors
from calib.inference.problem import build_problem

FIELD = Path(__file__).resolve().parents[3] / "shared" / "field"

SLIP = np.linspace(0.0, 0.9, 15)
# Of a wheel under 1 kN.
PULL = 0.3 * np.sin(1.6 * np.arctan(8.0 * SLIP)) - 0.05


def wheel(factor: float, **columns: np.ndarray) -> Table:
    table = table_from_arrays(
        {"slip_ratio": SLIP, "drawbar_pull_kn (checked)": factor * PULL, **columns}, source="my.csv"
    )
    return replace(table, source="my.csv")


@pytest.mark.parametrize("load", [0.02, 150.0])
def test_an_assumed_load_that_the_pulls_contradict_is_refused(load: float) -> None:
    with pytest.raises(CalibError) as caught:
        build_problem("magic_formula", wheel(load))
    said = str(caught.value)
    assert "normal load 5 kN was assumed" in said
    assert "my.csv: there is no column normal_load_kn" in said
    assert "add the column normal_load_kn" in said
    build_problem("magic_formula", wheel(load, normal_load_kn=np.full(15, load)))


def test_an_assumed_load_that_may_be_right_is_noted() -> None:
    (note,) = build_problem("magic_formula", wheel(5.0)).notes
    assert "no column normal_load_kn" in note


def test_any_column_that_priors_are_relative_to_may_be_the_missing_one() -> None:
    text = default_priors("bekker").read_text()
    text = text.replace(
        "median = 25.0", 'median = 0.1\nrelative_to = "tyre_width_m"\ndefault_reference = 250.0'
    )
    assert "tyre_width_m" in text
    own = DeclaredPriors("own.toml", text)
    pressure = np.linspace(50.0, 200.0, 12)

    def ruts(size: float) -> Table:
        return table_from_arrays(
            {"average_ground_pressure_kpa": pressure, "rut_depth_mm": size * pressure / 100.0}
        )

    assert build_problem("bekker", ruts(25.0), own).notes
    with pytest.raises(CalibError, match="tyre width 250 m was assumed"):
        build_problem("bekker", ruts(4e-4), own)


@pytest.mark.parametrize(("factor", "refused"), [(1e-3, True), (0.1, False), (10.0, False)])
def test_outputs_beyond_the_priors_by_an_order_of_magnitude_are_refused(
    factor: float, refused: bool
) -> None:
    table = wheel(factor, normal_load_kn=np.full(15, 1.0))
    if not refused:
        build_problem("magic_formula", table)
        return
    with pytest.raises(CalibError, match="column 'drawbar_pull_kn \\(checked\\)'") as caught:
        build_problem("magic_formula", table)
    assert "priors of magic_formula expect" in str(caught.value)
    # The scale that the priors take from the data may be the one that is wrong.
    assert "check the units of drawbar_pull_kn (checked), normal_load_kn" in str(caught.value)


def test_one_slip_of_the_pen_is_no_wrong_scale() -> None:
    table = wheel(5.0)
    pull = np.array(table["drawbar_pull_kn"])
    pull[3] *= 1000.0
    build_problem(
        "magic_formula", replace(table, columns={**table.columns, "drawbar_pull_kn": pull})
    )


@pytest.mark.skipif(not FIELD.is_dir(), reason="the shared field files are not here")
def test_the_field_file_of_a_small_wheel_without_its_load() -> None:
    with pytest.raises(CalibError, match="add the column normal_load_kn"):
        build_problem("magic_formula", read_table(FIELD / "rover_no_load.csv"))
    with pytest.raises(CalibError, match="the column normal_load_kn"):
        build_problem("magic_formula", read_table(FIELD / "rover_no_load_unchecked.csv"))
    assert not build_problem("magic_formula", read_table(FIELD / "rover_with_load.csv")).notes
