"""The files: diagnosis.json and fresh_prediction.csv exactly as the contract has them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from calib.data import read_table
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose
from calib.gap.effects import EFFECTS
from calib.gap.files import document, write_diagnosis
from calib.gap.identifiability import NextMeasurement
from calib.gap.mixture import Region
from tests.gap.cases import CHOICE, PULL_ONLY, diagnosis_of, make_case, pull_diagnosis, write_case


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
    assert set(d) - {"warnings"} == {"schema", "verdict", "effects", "track_record", "inclusion",
                                     "remainder", "not_testable", "where", "regions", "shrink",
                                     "next_measurement"}  # fmt: skip
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


def test_rows_that_were_not_judged_by_have_an_entry_that_says_why():
    case = make_case("force_offset", models=PULL_ONLY)
    slip, pull = (np.array(case.field[n]) for n in ("slip_ratio", "drawbar_pull_kn"))
    slip[2], pull[4], pull[7] = -1.0, np.nan, 900.0
    spoilt = {**case.field.columns, "slip_ratio": slip, "drawbar_pull_kn": pull}
    few = {"force_offset": EFFECTS["force_offset"]}
    found = diagnose(replace(case, field=replace(case.field, columns=spoilt)), effects=few)
    where = document(found)["where"]
    assert [w["row"] for w in where] == list(range(27))
    unused = {w["row"]: w["reason"] for w in where if "used" in w}
    assert not any(w["used"] for w in where if w["row"] in unused)
    assert list(unused) == [2, 4, 7]
    assert "conditions" in unused[2]
    assert unused[4] == "there is no reading"
    assert "reading was set aside" in unused[7]
    # An offset is the same at every row, read or not.
    gaps = np.array([w["gap"] for w in where])
    np.testing.assert_allclose(gaps, gaps[0], atol=2.0 * where[0]["gap_sd"])
    assert all(w["gap_sd"] > 0.0 and w["probability"] > 0.9 for w in where)


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


def test_every_number_is_the_one_that_was_found():
    found = diagnosis_of("sensor_drift")
    d, ranking = document(found), found.ranking
    assert [e["name"] for e in d["effects"]] == ranking.order
    assert {e["name"]: e["probability"] for e in d["effects"]} == dict(ranking.probability)
    assert d["where"] == [
        {
            "output": g.output, "row": int(g.rows[i]), "gap": g.gap[i], "gap_sd": g.sd[i],
            "probability": g.probability[i],
        }
        for g in found.gaps for i in range(g.rows.size)
    ]  # fmt: skip
    for name, s in found.shrink.items():
        assert d["shrink"][name] == {
            "rmse_before": s.rmse_before, "rmse_after": s.rmse_after, "fraction": s.fraction,
            "interval": list(s.interval), "noise_floor": s.noise_floor,
        }  # fmt: skip
    assert d["shrink"]
    for name, cause in [
        *found.inclusion.causes.items(),
        ("", found.inclusion.residual_discrepancy),
    ]:
        part = d["inclusion"].get(name, d["remainder"])
        told = (part["probability"], part["share"], tuple(part["share_interval"]))
        assert told == (cause.probability, cause.share, cause.share_interval)
    assert [(n["name"], n["reason"]) for n in d["not_testable"]] == [*ranking.not_testable.items()]


def test_conditions_are_told_by_ends_or_by_the_name_of_a_category():
    """Of regions, of what is left, and of what to measure next; a zero is a number, too."""
    found = diagnosis_of("sensor_drift")
    case = replace(found.data.case, covariates={"operator": ("Berg", "Lind"), "warmth": ()})
    regions = tuple(
        Region("rut_depth", {name: ends}, 1.5, (1.0, 2.0), 0.9)
        for name, ends in (
            ("operator", (1.0, 1.0)), ("warmth", (0.0, 8.0)), ("slip_ratio", (0.2, 0.4)),
        )
    )  # fmt: skip
    told = document(replace(
        found, data=replace(found.data, case=case), regions=regions,
        inclusion=replace(found.inclusion, where=regions[::-1]),
        next_measurements=(NextMeasurement(
            ("none", "unknown"), {"operator": 0.0, "warmth": 0.0, "slip_ratio": 0.3}, 1.25
        ),),
    ))  # fmt: skip
    conditions = [{"operator": ["Lind"]}, {"warmth": [0.0, 8.0]}, {"slip_ratio": [0.2, 0.4]}]
    assert told["regions"] == [
        {"output": "rut_depth", "conditions": c, "gap": 1.5, "probability": 0.9} for c in conditions
    ]
    assert told["remainder"]["where"] == [
        {"output": "rut_depth", "conditions": c} for c in conditions[::-1]
    ]
    assert told["next_measurement"] == [{
        "separates": ["none", "unknown"], "gain_nats": 1.25,
        "conditions": {"operator": "Berg", "warmth": 0.0, "slip_ratio": 0.3},
    }]  # fmt: skip


def test_a_null_says_none():
    d = document(pull_diagnosis(None))
    assert d["verdict"] == "none"
    assert d["shrink"] == {}
    assert d["regions"] == []
