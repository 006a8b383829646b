"""The files of diagnoses: contract, verdicts, batches, track record."""

from __future__ import annotations

import csv
import json
import shutil
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import beta

from calib.data import read_table, table_from_arrays
from calib.errors import CalibError
from calib.gap import batch
from calib.gap.batch import case_folders, diagnose_cases
from calib.gap.campaigns import campaigns
from calib.gap.case import read_case
from calib.gap.diagnose import assumed, diagnose, diagnose_once, placebos, verdict
from calib.gap.document import track_record
from calib.gap.effects import EFFECTS
from calib.gap.files import document, write_diagnosis
from calib.gap.hypotheses import Hypothesis, joined, singles
from calib.gap.identifiability import NextMeasurement
from calib.gap.mixture import Region
from tests.gap.cases import (
    CHOICE,
    PULL_ONLY,
    diagnosis_of,
    make_case,
    pull_diagnosis,
    table_without,
    write_case,
)
from tests.gap.fits import fit_at


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
            ("none", "unknown"), {"operator": 0.0, "warmth": 0.0, "slip_ratio": 0.3}, 1.25,
            "rut_depth", ((20.0, 1.0), (22.0, 1.0)),
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


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        ({"none": 0.5, "a": 0.5}, "none"),
        ({"none": 0.49, "a": 0.5}, "effect"),
        ({"unknown": 0.5, "a": 0.5}, "unknown"),
        ({"a": 0.3, "a+unknown": 0.2, "unknown": 0.49}, "effect"),
        ({"a": 0.3, "a+unknown": 0.199, "unknown": 0.49}, "ambiguous"),
        # Something unlisted beside causes that are none probable by themselves names nothing.
        ({"a+unknown": 0.4, "b+unknown": 0.4}, "ambiguous"),
        ({}, "ambiguous"),
    ],
)
def test_a_verdict_needs_a_probability_of_one_half(probability, expected):
    assert verdict(probability) == expected


FEW = {
    "rate_effect": EFFECTS["rate_effect"],
    "multipass_compaction": EFFECTS["multipass_compaction"],
}


def test_conditions_to_predict_that_lack_what_the_field_has_are_named() -> None:
    """And one that the field lacks explains nothing there."""
    case = make_case("rate_effect", n_fresh=9)
    fresh = case.new_conditions
    assert fresh is not None
    columns = {n: v for n, v in fresh.columns.items() if n != "speed_m_s"}
    found = diagnose_once(replace(case, new_conditions=table_from_arrays(columns)), 1, FEW)
    assert any("lacks speed_m_s, which the field campaign has" in w for w in found.warnings)
    whole = diagnose_once(case, 1, FEW)
    assert not any("lacks" in w for w in whole.warnings)
    field = {n: v for n, v in case.field.columns.items() if n != "pass_number"}
    without = diagnose_once(replace(case, field=table_from_arrays(field)), 1, FEW)
    assert np.isfinite(without.shrink["drawbar_pull"].rmse_after)


@pytest.fixture(scope="module")
def cases(tmp_path_factory) -> list[Path]:
    root = tmp_path_factory.mktemp("cases")
    for i, effect in enumerate((None, "force_offset")):
        case = make_case(effect, models=PULL_ONLY, n_lab=15, n_field=12, n_fresh=3, seed=i)
        write_case(case, root / f"case-{i}")
    (root / "not-a-case").mkdir()
    return case_folders(root)


@pytest.fixture(scope="module")
def done(cases, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("done")
    assert diagnose_cases(cases, out, 1) == {}
    return out


def content(out: Path) -> dict[str, bytes]:
    return {
        p.relative_to(out).as_posix(): p.read_bytes()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.suffix in (".json", ".csv") and p.name != "seconds.csv"
    }


def test_folders_with_a_case_in_them_are_found(cases, tmp_path):
    assert [c.name for c in cases] == ["case-0", "case-1"]
    with pytest.raises(CalibError, match="no cases"):
        case_folders(tmp_path)


def test_every_case_has_its_diagnosis(done):
    assert json.loads((done / "case-0" / "diagnosis.json").read_text())["verdict"] == "none"
    assert json.loads((done / "case-1" / "diagnosis.json").read_text())["verdict"] != "none"
    assert sorted(p.name for p in done.iterdir()) == ["case-0", "case-1", "seconds.csv"]


@pytest.mark.slow  # `tests/batch/test_cluster.py` has what it rests on
def test_two_workers_write_the_same_bytes(cases, done, tmp_path):
    assert diagnose_cases(cases, tmp_path / "two", 1, workers=2) == {}
    assert content(tmp_path / "two") == content(done)
    assert {"case-0/diagnosis.json", "case-1/diagnosis.json"} <= set(content(done))


def test_what_is_there_is_not_done_again(cases, done, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("done again")

    monkeypatch.setattr(batch, "read_case", refuse)
    seen = []
    assert diagnose_cases(cases, done, 1, progress=lambda *p: seen.append(p)) == {}
    assert seen == [(2, 2)]


def test_it_takes_up_where_it_stopped(cases, done, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(done / "case-0", out / "case-0")
    before = (out / "case-0" / "diagnosis.json").stat().st_mtime_ns
    seen = []
    diagnose_cases(cases, out, 1, progress=lambda *p: seen.append(p))
    assert (out / "case-0" / "diagnosis.json").stat().st_mtime_ns == before
    assert seen == [(1, 2), (2, 2)]
    assert content(out) == content(done)


@pytest.fixture
def few_effects(monkeypatch) -> None:
    """Diagnose among one effect, where what is found does not matter."""
    few = {"force_offset": EFFECTS["force_offset"]}
    monkeypatch.setattr(batch, "diagnose", partial(diagnose, effects=few))


def test_a_case_that_fails_is_reported_and_leaves_nothing(cases, tmp_path, few_effects):
    bad = write_case(make_case(models=PULL_ONLY, n_lab=15, n_field=12), tmp_path / "bad")
    (bad / "lab.csv").unlink()
    failed = diagnose_cases([bad, cases[0]], tmp_path / "out", 1)
    assert list(failed) == ["bad"]
    assert "lab.csv" in failed["bad"]
    assert {p.name for p in (tmp_path / "out").iterdir() if p.is_dir()} == {"case-0"}
    assert json.loads((tmp_path / "out" / "failed.json").read_text()) == failed


def test_an_interruption_leaves_no_half_written_folder(cases, tmp_path, few_effects, monkeypatch):
    def stop(found, folder):
        (folder / "diagnosis.json").write_text("{")
        raise KeyboardInterrupt

    monkeypatch.setattr(batch, "write_diagnosis", stop)
    with pytest.raises(KeyboardInterrupt):
        diagnose_cases(cases[:1], tmp_path / "out", 1)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["seconds.csv"]


def test_diagnoses_of_other_cases_are_not_taken_for_these(cases, done, tmp_path):
    made = make_case(models=PULL_ONLY, n_lab=15, n_field=12, seed=9)
    other = write_case(made, tmp_path / "case-0")
    with pytest.raises(CalibError, match="of other cases"):
        diagnose_cases([other], done, 1)
    with pytest.raises(CalibError, match="--seed 1, not 2"):
        diagnose_cases(cases, done, 2)


ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "calib" / "gap" / "track_record.toml"


@pytest.mark.parametrize("probability", [0.0, 0.3, 0.5, 0.65, 0.899, 0.9, 0.95, 1.0])
def test_every_probability_has_the_record_of_its_bin(probability: float) -> None:
    found = track_record(probability)
    assert found.low <= probability <= found.high
    low, high = beta.ppf([0.025, 0.975], found.right + 0.5, found.cases - found.right + 0.5)
    assert found.interval == pytest.approx((low, high), rel=1e-9)
    assert found.share == found.right / found.cases


def test_the_bins_join_and_rise() -> None:
    bins = [track_record(p) for p in (0.1, 0.55, 0.65, 0.75, 0.85, 0.95)]
    assert [b.low for b in bins[1:]] == [b.high for b in bins[:-1]]
    assert bins[-1].cases > 1000
    assert 0.97 < bins[-1].share < 0.99


def test_a_bin_is_the_sum_of_all_records() -> None:
    records = tomllib.loads(RECORDS.read_text(encoding="utf-8"))["record"]
    bins = [b for record in records for b in record["bins"] if b[0] == 0.9]
    assert track_record(0.93).cases == sum(b[2] for b in bins)
    assert track_record(0.93).right == sum(b[3] for b in bins)


def data_without(*columns):
    case = make_case("rate_effect")
    lab = case.lab
    for column in columns:
        lab = table_without(lab, column)
    return campaigns(replace(case, lab=lab))


@pytest.mark.parametrize(
    ("lacking", "effects", "value"),
    [
        (("pass_number",), ("multipass_compaction",), {"pass_number": 1.0}),
        (("speed_m_s",), ("rate_effect",), {"speed_m_s": "median"}),
        (("pass_number", "speed_m_s"), ("multipass_compaction", "rate_effect"),
         {"pass_number": 1.0, "speed_m_s": "median"}),
        (("pass_number",), ("rate_effect",), {}),
        ((), ("multipass_compaction",), {}),
    ],
)  # fmt: skip
def test_only_what_the_hypothesis_rests_on_is_named(lacking, effects, value):
    data = data_without(*lacking)
    chosen = singles(data, {name: EFFECTS[name] for name in effects})
    hypothesis = chosen[0] if len(chosen) == 1 else joined(*chosen)
    median = float(np.median(data.case.field["speed_m_s"]))
    assert assumed(fit_at(data, hypothesis)) == {
        column: median if v == "median" else v for column, v in value.items()
    }


def test_without_effects_nothing_is_assumed():
    assert assumed(fit_at(data_without("pass_number"), Hypothesis("none"))) == {}


def test_placebos_are_on_one_noise():
    found = diagnosis_of("sensor_drift")
    placebo = placebos(found)
    best = found.ranking.order[0]
    residual = np.concatenate(list(found.ranking.best(best).field_residuals.values()))
    assert placebo.left[best] == pytest.approx(np.sqrt(np.mean(np.square(residual))))
    # A wrong hypothesis inflates its own noise: on its own scale it would look as good.
    assert placebo.left["none"] > 1.3 * placebo.left[best]
    assert placebo.before > placebo.left["none"] - 1e-9
    assert placebo.shrink(best) == pytest.approx(1.0 - placebo.left[best] / placebo.before)
    assert "unknown" in placebo.left
    assert not any("+" in n for n in placebo.left if n != best)
