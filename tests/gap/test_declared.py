"""Columns that a case declares: what goes with them is found, named and used for prediction."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from calib.data import Table, read_table
from calib.errors import CalibError
from calib.gap.batch import case_hashes, inputs_record
from calib.gap.case import (
    cells,
    declared_covariates,
    new_values,
    read_case,
    with_declared,
    words_of,
)
from calib.gap.corrected import load_corrected, predict_columns, save_corrected
from calib.gap.diagnose import diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.files import document
from tests.gap.cases import PULL_ONLY, make_case, write_case

FEW = {name: EFFECTS[name] for name in ("force_offset", "sensor_drift", "slip_zero_shift")}
PULL = "drawbar_pull_kn"


def case_with(folder, name, lab, field, kind, gap=None):
    """Write a case with one more column; a relative change of the field's pull goes with it."""
    made = make_case(None, models=PULL_ONLY, n_field=36)
    pull = np.array(made.field[PULL]) * np.exp(np.zeros(36) if gap is None else gap)
    columns = {**made.field.columns, PULL: pull}
    write_case(replace(made, field=replace(made.field, columns=columns)), folder)
    for file, values in (("lab.csv", lab), ("field.csv", field)):
        with (folder / file).open(newline="") as read:
            rows = list(csv.reader(read))
        cells = [name, *values(len(rows) - 1)]
        with (folder / file).open("w", newline="") as write:
            csv.writer(write).writerows([*row, cell] for row, cell in zip(rows, cells, strict=True))
    with (folder / "case.toml").open("a") as file:
        file.write(f"\n[covariates]\n{name} = {kind}\n")
    return folder


def temperatures(n):
    return np.linspace(12.0, 31.0, n)[np.random.default_rng(3).permutation(n)]


def operators(n):
    return [("Lind", "Berg", "Dahl")[i % 3] for i in range(n)]


def saved(found, tmp_path):
    (tmp_path / "out").mkdir()
    save_corrected(found.corrected, tmp_path / "out")
    return load_corrected(tmp_path / "out", FEW)


def test_a_number_that_the_simulator_ignores_is_found(tmp_path):
    u = (temperatures(36) - 20.0) / 10.0
    folder = case_with(
        tmp_path / "case", "tyre_temperature_c", lambda n: np.full(n, 20.0), temperatures,
        '"number"', 0.35 * u,
    )  # fmt: skip
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert found.inclusion.causes["depends_on_tyre_temperature_c"].probability > 0.9
    assert found.ranking.order[0] == "depends_on_tyre_temperature_c"
    regions = document(found)["regions"]
    stretches = [r["conditions"].get("tyre_temperature_c") for r in regions]
    # Warm tyres pull more than simulated; stretches are known to one of eight groups.
    assert any(s and 20.0 < s[0] < s[1] and s[1] > 28.0 for s in stretches)
    again = saved(found, tmp_path)
    assert again.data.case.covariates == {"tyre_temperature_c": ()}
    at = predict_columns(again, read_table(folder / "field.csv"))
    before, after = at[f"{PULL}_before"], at[f"{PULL}_after"]
    warm = temperatures(36) > 27.0
    assert (after[warm] > before[warm]).all()


def test_a_category_is_found_and_kept_by_its_names(tmp_path):
    gap = 0.5 * np.array([name == "Dahl" for name in operators(36)])
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"', gap)
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert found.data.case.covariates == {"operator": ("Berg", "Dahl", "Lind")}
    assert found.inclusion.causes["depends_on_operator"].probability > 0.9
    (effect,) = found.ranking.best("depends_on_operator").forward.hypothesis.effects
    assert set(effect.parameters) >= {"pull_factor_Dahl", "pull_offset_Dahl"}
    assert words_of(found.data.case.covariates, "operator", 1.0, 1.0) == "Dahl"
    assert words_of(found.data.case.covariates, "operator", 1.0, 2.0) == "Dahl, Lind"
    region, *others = document(found)["regions"]
    assert region["conditions"] == {"operator": ["Dahl"]}
    assert not any("operator" in r["conditions"] for r in others)
    recorded = json.loads(inputs_record(found.data.case, 1))
    assert recorded["covariates"] == case_hashes(folder)["covariates"] == {"operator": "category"}
    again = saved(found, tmp_path)
    at = predict_columns(again, read_table(folder / "field.csv"))
    assert at["operator"] == operators(36)
    ratio = at[f"{PULL}_after"] / at[f"{PULL}_before"]
    slips = again.data.view.slip() > 0.2
    dahl = np.array([name == "Dahl" for name in operators(36)])
    assert np.median(ratio[dahl & slips]) > 1.2 * np.median(ratio[~dahl & slips])


def test_what_nothing_goes_with_is_not_named(tmp_path):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert found.inclusion.causes["depends_on_operator"].probability < 0.2
    assert found.verdict == "none"


def test_a_category_that_differs_between_the_campaigns_only_cannot_be_separated(tmp_path):
    folder = case_with(
        tmp_path / "case", "site", lambda n: ["barn"] * n, lambda n: ["field"] * n, '"category"',
        np.full(36, 0.4),
    )  # fmt: skip
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert any("site: its condition is one value" in w for w in found.warnings) or any(
        "depends_on_site" in w and "cannot be separated" in w for w in found.warnings
    )


def test_an_empty_cell_is_no_value_of_a_category(tmp_path):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    text = (folder / "field.csv").read_text().replace("Lind", "", 1)
    (folder / "field.csv").write_text(text)
    with pytest.raises(CalibError, match="operator is ''") as refused:
        read_case(folder)
    assert refused.value.expected == "Berg, Dahl, Lind"


def test_values_of_the_field_alone_are_named(tmp_path):
    folder = case_with(
        tmp_path / "case", "operator", lambda n: ["Berg", "Lind"] * (n // 2) + ["Lind"] * (n % 2),
        operators, '"category"',
    )  # fmt: skip
    case = read_case(folder)
    (said,) = new_values(case.covariates, case.lab, case.field)
    assert said.startswith("operator: Dahl in the field only")


def test_a_value_of_the_conditions_to_predict_is_a_value(tmp_path):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    fresh = "slip_ratio,operator\n0.1,Lind\n0.2,Ahl\n"
    (folder / "fresh.csv").write_text(fresh)
    toml = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text('predict = "fresh.csv"\n' + toml)
    case = read_case(folder)
    assert case.covariates == {"operator": ("Ahl", "Berg", "Dahl", "Lind")}
    assert case.new_conditions["operator"].tolist() == [3.0, 0.0]
    (folder / "fresh.csv").write_text(fresh.replace("operator", "driver"))
    with pytest.raises(CalibError, match="there is no column 'operator'") as refused:
        read_case(folder)
    assert "fresh.csv" in refused.value.where


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        ("operator", '"word"', '"number", "category"'),
        ("operator", '"number"', "operator is 'Lind'"),
        ("operator", '["Lind", "Berg"]', "operator is 'Dahl'"),
        ("speed_m_s", '"number"', "a quantity that is known"),
    ],
)
def test_what_is_declared_wrongly_is_refused(tmp_path, name, kind, said):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text.replace('operator = "category"', f"{name} = {kind}"))
    with pytest.raises(CalibError, match=said):
        read_case(folder)


def typed(**columns) -> Table:
    """Return a table of cells as they were typed, which the reader did not know."""
    header, text = tuple(columns), tuple(zip(*columns.values(), strict=True))
    return Table({}, "made.csv", np.arange(len(text)) + 2, header, text, "", ignored=header)


@pytest.mark.parametrize(("n", "refused"), [(1, True), (2, False), (12, False), (13, True)])
def test_a_category_has_from_two_to_twelve_values(n, refused):
    words = [f"w{i:02d}" for i in range(n)]
    tables = (typed(operator=words), typed(operator=[" w00 "]))
    if refused:
        with pytest.raises(CalibError, match=f"operator has {n} different values"):
            declared_covariates({"operator": "category"}, tables)
        with pytest.raises(CalibError, match=f"operator has {n} different values"):
            declared_covariates({"operator": words}, tables)
    else:
        assert declared_covariates({"operator": "category"}, tables) == {"operator": tuple(words)}
        given = words[::-1]
        assert declared_covariates({"operator": given}, tables) == {"operator": tuple(given)}


@pytest.mark.parametrize("name", ["speed_m_s", "speed_km_h", "speed_furlongs"])
def test_a_known_quantity_is_declared_by_its_name_alone(name):
    """In whatever unit, even one that nobody knows."""
    with pytest.raises(CalibError, match=f"{name} is a quantity that is known"):
        declared_covariates({name: "number"}, (typed(**{name: ["1"]}),))


DECLARED = {"operator": ("Lind", "Berg", "Dahl"), "tyre_temperature_c": ()}


def test_declared_columns_are_added_to_the_table():
    """Categories as their places in the list, numbers as they are; others stay ignored."""
    table = typed(
        tyre_temperature_c=[" 21.5", "-3", "1e1"], weather=["dry"] * 3,
        operator=["Berg", "Lind ", "Dahl"],
    )  # fmt: skip
    found = with_declared(table, DECLARED)
    assert found["operator"].tolist() == [1.0, 0.0, 2.0]
    assert found["tyre_temperature_c"].tolist() == [21.5, -3.0, 10.0]
    assert found.ignored == ("weather",)
    assert with_declared(table, {}) is table
    assert cells(found.columns, DECLARED)["operator"] == ["Berg", "Lind", "Dahl"]
    np.testing.assert_array_equal(
        cells(found.columns, DECLARED)["tyre_temperature_c"], [21.5, -3.0, 10.0]
    )


@pytest.mark.parametrize("cell", ["", "warm", "nan", "inf", "-inf", "1,5"])
def test_a_number_is_a_finite_one(cell):
    table = typed(tyre_temperature_c=["20", cell, "21"])
    with pytest.raises(CalibError, match=r"made\.csv, line 3"):
        with_declared(table, {"tyre_temperature_c": ()})


def test_a_table_too_long_to_keep_its_cells_has_no_categories():
    table = replace(typed(operator=["Lind", "Berg"]), text=())
    with pytest.raises(CalibError, match=r"made\.csv has 2 rows"):
        with_declared(table, {"operator": ("Berg", "Lind")})


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.0, 0.0, "Lind"), (1.0, 1.0, "Berg"), (2.0, 2.0, "Dahl"), (0.0, 1.0, "Lind, Berg"),
        (0.6, 2.4, "Berg, Dahl"), (0.0, 2.0, "Lind, Berg, Dahl"),
    ],
)  # fmt: skip
def test_values_between_two_places_are_said_in_words(low, high, words):
    assert words_of(DECLARED, "operator", low, high) == words
    assert words_of(DECLARED, "tyre_temperature_c", low, high) == ""
    assert words_of(DECLARED, "speed_m_s", low, high) == ""


def test_a_column_that_is_not_there_is_refused(tmp_path):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text.replace("operator =", "driver ="))
    with pytest.raises(CalibError, match="there is no column 'driver'"):
        read_case(folder)
