"""The cases are what they claim: the effect is withheld, and no row stands in both campaigns."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.data.files import write_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose
from calib.gap.files import document
from calib.he2019.embedded import load_he2019
from calib.he2019.gaps import PaperGap, paper_gaps, write_cases
from calib.he2019.published import PUBLISHED
from calib.models import get_model
from calib.models.bekker import rut_depth as eq_21

GAPS = {gap.name: gap for gap in paper_gaps()}
CASES = {case.name: case for gap in GAPS.values() for case in (gap.case, *gap.variants.values())}


def test_there_are_the_four_gaps_of_the_issue():
    assert list(GAPS) == ["plain_bekker", "nominal_slip", "held_out_pull", "post_peak_18_psi"]


# Slips of these fields are nominal: 2 percentage points below those of the embedded data.
NOMINAL = ("nominal_slip", "nominal_slip_swapped")


def embedded(case):
    """Outcome by pressure and (redefined) slip, of the whole data set."""
    data = load_he2019(next(iter(case.models)))
    outcome = data[OUTPUTS[next(iter(case.models))]]
    return dict(zip(rows(data), outcome.tolist(), strict=True))


def rows(table, shift=0.0):
    slip = np.round(table["slip_ratio"] + shift, 6)
    return list(zip(table["inflation_pressure_psi"].tolist(), slip.tolist(), strict=True))


@pytest.mark.parametrize("name", CASES)
def test_every_row_is_embedded_and_stands_once(name):
    case, known = CASES[name], embedded(CASES[name])
    shift = 0.02 if name in NOMINAL else 0.0
    lab, field = rows(case.lab), rows(case.field, shift)
    kept_out = [] if case.new_conditions is None else rows(case.new_conditions, shift)
    # Lab, field and kept-out rows share none, and together are the data set.
    assert sorted(lab + field + kept_out) == sorted(known)
    column = OUTPUTS[next(iter(case.models))]
    for table, keys in ((case.lab, lab), (case.field, field)):
        np.testing.assert_array_equal(table[column], [known[key] for key in keys])


@pytest.mark.parametrize("name", GAPS)
def test_the_outcomes_of_kept_out_rows_are_not_in_the_case(name):
    gap = GAPS[name]
    if gap.unfitted is None:
        assert gap.case.new_conditions is None
        return
    assert not set(gap.case.new_conditions) & set(OUTPUTS.values())
    for column in gap.case.new_conditions:
        np.testing.assert_array_equal(gap.case.new_conditions[column], gap.unfitted[column])
    known, shift = embedded(gap.case), 0.02 if name in NOMINAL else 0.0
    column = OUTPUTS[next(iter(gap.case.models))]
    keys = rows(gap.unfitted, shift)
    np.testing.assert_array_equal(gap.unfitted[column], [known[key] for key in keys])


def test_plain_bekker_knows_no_slip_and_was_calibrated_where_there_is_next_to_none():
    case = GAPS["plain_bekker"].case
    model = get_model(case.models["rut_depth"])
    assert "slip_ratio" not in model.conditions
    assert sorted(set(case.lab["slip_ratio"])) == [0.0, 0.025]
    assert case.field["slip_ratio"].min() == 0.05
    assert set(case.field["inflation_pressure_psi"]) == {18.0, 42.0}
    # At 2.5 % slip, Table 6 deepens the rut by less than its own scatter: next to nothing.
    k, n0, n1 = (PUBLISHED.rut_depth.values[p] for p in ("k", "n0", "n1"))
    deepening = eq_21(140.0, 0.025, k, n0, n1) / eq_21(140.0, 0.0, k, n0, n1) - 1.0
    assert deepening < PUBLISHED.rut_depth.quality["rmse"].value / n0


def test_nominal_slips_are_the_embedded_ones_and_given_back_they_are_redefined():
    """The shift itself is checked where every row is found again."""
    data = load_he2019("drawbar_pull")
    nominal, redefined = set(data["nominal_slip_ratio"]), set(data["slip_ratio"])
    for name in (*NOMINAL, "nominal_slip_given_back"):
        assert set(CASES[name].lab["slip_ratio"]) <= redefined
        field = set(CASES[name].field["slip_ratio"])
        assert field <= (nominal if name in NOMINAL else redefined)
    assert CASES["nominal_slip"].field["slip_ratio"].min() == 0.0


def test_the_halves_of_the_slips_are_swapped():
    one, other = CASES["nominal_slip"], CASES["nominal_slip_swapped"]
    assert set(rows(one.field, 0.02)) <= set(rows(other.lab))
    assert not set(rows(one.lab)) & set(rows(other.lab))


def test_30_psi_is_held_out_whole():
    case = GAPS["held_out_pull"].case
    assert set(case.lab["inflation_pressure_psi"]) == {18.0, 42.0}
    assert set(case.field["inflation_pressure_psi"]) == {30.0}
    assert len(case.field) == PUBLISHED.setup.slip_levels.value


@pytest.mark.parametrize(
    ("name", "later"), [("post_peak_18_psi", 0), ("post_peak_later", 1), ("post_peak_latest", 2)]
)
def test_the_field_past_the_peak_is_18_psi_beyond_the_largest_pull(name, later):
    case = CASES[name]
    at_18 = case.lab["inflation_pressure_psi"] == 18.0
    rising = case.lab["slip_ratio"][at_18]
    pull = case.lab["drawbar_pull_kn"][at_18]
    assert set(case.field["inflation_pressure_psi"]) == {18.0}
    assert case.field["slip_ratio"].min() > rising.max()
    assert case.field["drawbar_pull_kn"].max() < pull.max()
    assert pull.size - 1 - int(np.argmax(pull)) == later
    assert (~at_18).sum() == 2 * PUBLISHED.setup.slip_levels.value


def test_without_slip_in_the_ruts_slip_sinkage_is_not_found():
    """The finding hangs on the effect: taken out of the same rows by Eq 21, it is gone."""
    case = GAPS["plain_bekker"].case
    k, n0, n1 = (PUBLISHED.rut_depth.values[p] for p in ("k", "n0", "n1"))

    def flat(table):
        pressure, slip = table["average_ground_pressure_kpa"], table["slip_ratio"]
        ratio = eq_21(pressure, slip, k, n0, n1) / eq_21(pressure, 0.0, k, n0, n1)
        return table_from_arrays({**table.columns, "rut_depth_mm": table["rut_depth_mm"] / ratio})

    found = diagnose(replace(case, lab=flat(case.lab), field=flat(case.field)), 1)
    assert found.ranking.order[0] == "none"
    assert found.ranking.probability["slip_sinkage"] < 0.05


def file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_folders_hold_the_same_cases(tmp_path):
    folders = write_cases(list(GAPS.values()), tmp_path / "gaps")
    assert [f.name for f in folders] == list(GAPS)
    for folder, gap in zip(folders, GAPS.values(), strict=True):
        read = read_case(folder)
        assert read.models == gap.case.models
        for table, own, file in (
            (read.lab, gap.case.lab, "lab.csv"), (read.field, gap.case.field, "field.csv"),
            (read.new_conditions, gap.case.new_conditions, "fresh.csv"),
        ):  # fmt: skip
            if own is None:
                assert table is None
                continue
            assert set(table) == set(own)
            for column in own:
                np.testing.assert_array_equal(table[column], own[column])
            # What the page of a diagnosis calls the hash of a file is that of the file.
            assert file_hash(folder / file) == own.sha256 == table.sha256
            write_table(tmp_path / "again.csv", own.columns)
            assert file_hash(tmp_path / "again.csv") == own.sha256
        text = (folder / "case.toml").read_text()
        assert "reconstructed from published results" in " ".join(text.split("\n# "))
        assert (folder / "fresh_measured.csv").exists() is (gap.unfitted is not None)


def test_a_folder_is_diagnosed_as_the_report_does(tmp_path, found_gaps):
    gap = GAPS["plain_bekker"]
    (folder,) = write_cases([gap], tmp_path)
    own = found_gaps[gap.name].found
    again = document(diagnose(read_case(folder), own.seed))
    assert again == document(own)


def test_folders_are_replaced_on_request_only(tmp_path):
    gap: PaperGap = GAPS["held_out_pull"]
    write_cases([gap], tmp_path)
    with pytest.raises(CalibError, match="held_out_pull exist there already"):
        write_cases([gap], tmp_path)
    (tmp_path / gap.name / "lab.csv").write_text("changed")
    write_cases([gap], tmp_path, overwrite=True)
    assert read_case(tmp_path / gap.name).lab.sha256 == gap.case.lab.sha256
