"""The files: diagnosis.json and fresh_prediction.csv exactly as the contract has them."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from calib.data import read_table
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose
from calib.gap.files import document, write_diagnosis
from tests.gap.cases import CHOICE, diagnosis_of, make_case, pull_diagnosis, write_case


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    write_diagnosis(diagnosis_of("sensor_drift"), folder)
    return folder


def no_constants(name: str):
    raise AssertionError(f"{name} is not JSON")


def numbers(value) -> list[float]:
    if isinstance(value, dict):
        return [n for v in value.values() for n in numbers(v)]
    if isinstance(value, list):
        return [n for v in value for n in numbers(v)]
    return [value] if isinstance(value, int | float) else []


def test_the_document_follows_the_contract(written):
    text = (written / "diagnosis.json").read_text()
    d = json.loads(text, parse_constant=no_constants)
    assert set(d) == {"schema", "verdict", "effects", "inclusion", "remainder", "not_testable",
                      "where", "regions", "shrink", "next_measurement"}  # fmt: skip
    parts = [*d["inclusion"].values(), d["remainder"]]
    for part in parts:
        low, high = part["share_interval"]
        assert 0.0 <= low <= part["share"] <= high <= 1.0
        assert 0.0 <= part["probability"] <= 1.0
    assert sum(part["share"] for part in parts) == pytest.approx(1.0)
    assert {"parameter_shift", *CHOICE} <= set(d["inclusion"])
    for place in d["remainder"]["where"]:
        assert set(place) == {"output", "conditions"}
    assert d["schema"] == "calib/diagnosis/1"
    assert d["verdict"] in ("effect", "none", "unknown", "ambiguous")
    for e in d["effects"]:
        assert set(e) == {"name", "probability", "parameters"}
        assert 0.0 <= e["probability"] <= 1.0
        for p in e["parameters"].values():
            assert set(p) == {"mean", "sd"}
            assert p["sd"] > 0.0
    assert sum(e["probability"] for e in d["effects"]) == pytest.approx(1.0, abs=1e-9)
    names = [e["name"] for e in d["effects"]]
    assert len(names) == len(set(names))
    assert {"none", "unknown", "parameter_shift", *CHOICE} <= set(names)
    for n in d["not_testable"]:
        assert set(n) == {"name", "reason"}
    for w in d["where"]:
        assert set(w) == {"output", "row", "gap", "gap_sd", "probability"}
        assert 0.0 <= w["probability"] <= 1.0
    for r in d["regions"]:
        assert set(r) == {"output", "conditions", "gap", "probability"}
        for low, high in r["conditions"].values():
            assert low <= high
    for s in d["shrink"].values():
        assert set(s) == {"rmse_before", "rmse_after", "fraction", "interval", "noise_floor"}
        assert s["interval"][0] <= s["fraction"] <= s["interval"][1]
    for m in d["next_measurement"]:
        assert set(m) == {"separates", "conditions", "gain_nats"}
        assert len(m["separates"]) == 2
    assert np.isfinite(numbers(d)).all()


def test_one_entry_for_each_row_and_output(written):
    where = json.loads((written / "diagnosis.json").read_text())["where"]
    assert len(where) == 2 * 27
    for output in ("drawbar_pull", "rut_depth"):
        assert [w["row"] for w in where if w["output"] == output] == list(range(27))


def test_parameters_of_a_pair_carry_their_effects_name(written):
    effects = json.loads((written / "diagnosis.json").read_text())["effects"]
    pair = next(e for e in effects if e["name"] == "force_offset+sensor_drift")
    assert set(pair["parameters"]) == {
        "force_offset.offset", "sensor_drift.drift", "sensor_drift.curvature",
        "sensor_drift.half_way", "sensor_drift.zero_at",
    }  # fmt: skip
    single = next(e for e in effects if e["name"] == "sensor_drift")
    assert single["parameters"]["drift"]["mean"] == pytest.approx(0.25, abs=0.1)


def test_fresh_predictions(written):
    fresh = make_case("sensor_drift", n_fresh=9).new_conditions
    with (written / "fresh_prediction.csv").open(newline="") as file:
        header, *rows = list(csv.reader(file))
    conditions = list(fresh.header)
    columns = [
        f"{c}_{part}"
        for c in ("drawbar_pull_kn", "rut_depth_mm")
        for part in ("before", "after", "after_lower", "after_upper")
    ]
    assert header == conditions + columns
    assert len(rows) == 9
    values = {h: np.array([float(r[j]) for r in rows]) for j, h in enumerate(header)}
    for name in conditions:
        np.testing.assert_allclose(values[name], fresh[name])
    for c in ("drawbar_pull_kn", "rut_depth_mm"):
        assert (values[f"{c}_after_lower"] < values[f"{c}_after"]).all()
        assert (values[f"{c}_after"] < values[f"{c}_after_upper"]).all()


def test_conditions_are_copied_as_they_were_written(tmp_path):
    """The reader's own columns and units, not the canonical ones."""
    folder = write_case(make_case(models={"drawbar_pull": "magic_formula"}), tmp_path / "case")
    (folder / "fresh.csv").write_text("run_order,slip_percent\n0,10.50\n1,20\n")
    toml = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text('predict = "fresh.csv"\n' + toml)
    from calib.gap.effects import EFFECTS

    found = diagnose(read_case(folder), effects={"force_offset": EFFECTS["force_offset"]})
    out = tmp_path / "out"
    out.mkdir()
    write_diagnosis(found, out)
    with (out / "fresh_prediction.csv").open(newline="") as file:
        header, *rows = list(csv.reader(file))
    assert header[:2] == ["run_order", "slip_percent"]
    assert [r[1] for r in rows] == ["10.50", "20"]
    assert read_table(folder / "fresh.csv")["slip_ratio"].tolist() == [0.105, 0.2]


def test_without_conditions_to_predict_there_is_no_prediction(tmp_path):
    write_diagnosis(pull_diagnosis(None), tmp_path)
    assert (tmp_path / "diagnosis.json").exists()
    assert not (tmp_path / "fresh_prediction.csv").exists()


def test_a_null_says_none():
    d = document(pull_diagnosis(None))
    assert d["verdict"] == "none"
    assert d["shrink"] == {}
    assert d["regions"] == []
