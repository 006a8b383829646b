"""Cases must follow the contract, be fair, and be the same for the same seed."""

from __future__ import annotations

import csv
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.errors import CalibError
from challenge.build import try_case
from challenge.design import NOISES, Noise
from challenge.effects import LISTED
from challenge.files import OUTPUT_COLUMNS
from challenge.make import make, make_case, plan
from challenge.seal import sha256
from tests.blind import BlindTest

CONTRACT_COLUMNS = (
    "run_order", "slip_ratio", "inflation_pressure_kpa", "inflation_pressure_psi",
    "normal_load_kn", "speed_m_s", "pass_number", "gravimetric_water_content",
    "average_ground_pressure_kpa", "cone_index_kpa", *OUTPUT_COLUMNS.values(),
)  # fmt: skip


def table(path: Path) -> tuple[list[str], np.ndarray]:
    """Return header and values of a CSV file."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    return header, np.array(rows, dtype=float)


def each_case(blind_test: BlindTest) -> list[tuple[Path, dict[str, Any]]]:
    """Return folders with their answers."""
    return [(blind_test.cases / name, answer) for name, answer in blind_test.answers.items()]


def test_folders_hold_exactly_the_contracts_files(blind_test: BlindTest) -> None:
    names = [f"case-{i:03d}" for i in range(6)]
    assert sorted(path.name for path in blind_test.cases.iterdir()) == names
    assert sorted(path.name for path in blind_test.key.iterdir()) == names
    for folder, _ in each_case(blind_test):
        files = sorted(path.name for path in folder.iterdir())
        assert files == ["case.toml", "field.csv", "fresh.csv", "lab.csv"]
        case = tomllib.loads((folder / "case.toml").read_text(encoding="utf-8"))
        answer = blind_test.key / folder.name / "answer.json"
        assert case["answer_sha256"] == sha256(answer.read_bytes())


def test_tables_have_the_contracts_columns(blind_test: BlindTest) -> None:
    for folder, entry in each_case(blind_test):
        (lab, _), (field, rows), (fresh, unseen) = (
            table(folder / f"{name}.csv") for name in ("lab", "field", "fresh")
        )
        outputs = [OUTPUT_COLUMNS[name] for name in entry["noise_sd"]]
        assert lab == field == [c for c in CONTRACT_COLUMNS if c in field]
        assert set(field) <= set(CONTRACT_COLUMNS)
        assert field[len(fresh) :] == outputs
        assert field[: len(fresh)] == fresh
        for name, sd in entry["noise_sd"].items():
            assert len(sd) == len(entry["field_truth"][name]) == len(rows)
            assert len(entry["fresh_truth"][name]) == len(unseen)
        assert len(rows) == 36 if entry["tier"] == "easy" else 14 <= len(rows) <= 36


def test_case_file_names_files_and_models(blind_test: BlindTest) -> None:
    allowed = {
        "drawbar_pull": {"magic_formula", "magic_formula_pressure"},
        "rut_depth": {"bekker", "modified_bekker"},
        "bulk_density": {"ayers_perumpral"},
    }
    for folder, entry in each_case(blind_test):
        case = tomllib.loads((folder / "case.toml").read_text(encoding="utf-8"))
        assert case["calibration"] == "lab.csv"
        assert (case["field"], case["predict"]) == ("field.csv", "fresh.csv")
        assert list(case["models"]) == list(entry["noise_sd"])
        assert all(model in allowed[output] for output, model in case["models"].items())


def test_readings_scatter_about_the_truth_by_the_stated_noise(blind_test: BlindTest) -> None:
    z = []
    for folder, entry in each_case(blind_test):
        header, rows = table(folder / "field.csv")
        for name, sd in entry["noise_sd"].items():
            reading = rows[:, header.index(OUTPUT_COLUMNS[name])]
            z.append((reading - np.array(entry["field_truth"][name])) / np.array(sd))
    pooled = np.concatenate(z)
    # Rounding adds a little, sampling more: five standard errors of the sd.
    assert np.std(pooled) == pytest.approx(1.0, abs=5.0 / np.sqrt(2 * pooled.size))
    assert abs(np.mean(pooled)) < 5.0 / np.sqrt(pooled.size)


def test_gaps_are_as_large_as_promised(blind_test: BlindTest) -> None:
    for _, entry in each_case(blind_test):
        parts = [
            (np.array(entry["field_truth"][n]) - np.array(entry["field_without"][n])) / np.array(sd)
            for n, sd in entry["noise_sd"].items()
        ]
        gap = float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
        assert gap == pytest.approx(entry["gap_over_noise"], abs=1e-9)
        assert gap == 0.0 if entry["truth"] == "none" else gap >= 2.0


def test_no_case_gives_its_answer_away(blind_test: BlindTest) -> None:
    answers = blind_test.answers.values()
    assert len({answer["salt"] for answer in answers}) == len(answers)
    words = {answer["truth"] for answer in answers} - {"none"}
    words |= {answer[key] for answer in answers for key in ("mechanism", "salt")}
    for path in blind_test.cases.rglob("*"):
        if path.is_file():
            text = path.read_text(encoding="utf-8")
            assert not any(word in text for word in words)


def test_nothing_is_its_own_rival(blind_test: BlindTest) -> None:
    for case in blind_test.answers.values():
        if case["truth"] != "none":
            assert case["rival"] not in case["truth"].split("+")
            assert (case["rival"] == "") == (case["rival_nats"] is None)


def test_same_seed_same_case() -> None:
    a, again, b = (make_case(np.random.SeedSequence(i), "hard", "none") for i in (1, 1, 2))
    assert (a.files, a.answer) == (again.files, again.answer)
    assert a.files["lab.csv"] != b.files["lab.csv"]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_same_seed_same_bytes(blind_test: BlindTest, tmp_path: Path, workers: int) -> None:
    make(tmp_path / "cases", tmp_path / "sealed", seed=5, n_cases=6, workers=workers)
    for root in (blind_test.cases, blind_test.key):
        for path in filter(Path.is_file, root.rglob("*")):
            other = tmp_path / root.name / path.relative_to(root)
            assert other.read_bytes() == path.read_bytes()


def test_plan_has_the_promised_shares() -> None:
    planned = plan(np.random.default_rng(0), 480, ("easy", "hard"))
    for tier in ("easy", "hard"):
        truths = Counter(truth for at, truth in planned if at == tier)
        assert truths["none"] == 80
        assert truths["unknown"] == 30
        assert truths["parameter_shift"] == 24
        assert all(truths[name] > 0 for name in LISTED)
        pairs = [name for name in truths if "+" in name]
        assert bool(pairs) == (tier == "hard")
        assert all(name == "+".join(sorted(name.split("+"))) for name in pairs)


def test_large_gaps_have_no_nulls_and_up_to_three_causes() -> None:
    planned = plan(np.random.default_rng(0), 80, ("large",))
    truths = Counter(truth for _, truth in planned)
    assert not truths["none"]
    assert not truths["parameter_shift"]
    assert {name.count("+") for name in truths} == {0, 1, 2}


def test_the_answer_says_what_each_of_several_causes_adds() -> None:
    truth = "force_offset+lug_thrust+sensor_drift"
    made = make_case(np.random.SeedSequence([5, 1]), "large", truth).answer
    assert made["gap_over_noise"] >= 5.0
    assert sorted(made["contributions"]) == sorted(made["truth"].split("+"))
    assert min(made["contributions"].values()) >= 1.0


@pytest.mark.parametrize("kind", NOISES)
def test_every_noise_has_its_sd_and_nothing_else_is_the_same(kind: str) -> None:
    sd, rng = np.full(40_000, 0.3), np.random.default_rng(1)
    noise = Noise(0.3, 0.05, 0.01, 0.0, kind)
    drawn = noise.draw(rng, sd)
    assert drawn.std() == pytest.approx(0.3, rel=0.05)
    successive = float(np.corrcoef(drawn[1:], drawn[:-1])[0, 1])
    assert successive == pytest.approx(0.5 if kind == "autocorrelated" else 0.0, abs=0.03)
    far = float(np.mean(np.abs(drawn) > 1.2))
    assert (far > 0.004) == (kind == "heavy")
    assert noise.step(sd) == (0.6 if kind == "rounded" else 0.0)


def test_answers_are_never_among_the_cases(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match="must not lie with the cases"):
        make(tmp_path / "c", tmp_path / "c" / "key", seed=1, n_cases=1)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "x").write_text("x", encoding="utf-8")
    with pytest.raises(CalibError, match="not empty"):
        make(tmp_path / "old", tmp_path / "key", seed=1, n_cases=1)
    for n_cases, tiers in ((0, ("easy",)), (1, ("middling",)), (1, ())):
        with pytest.raises(CalibError):
            make(tmp_path / "c", tmp_path / "k", seed=1, n_cases=n_cases, tiers=tiers)  # type: ignore[arg-type]
        assert not (tmp_path / "c").exists()
    with pytest.raises(CalibError, match="not empty"):
        make(tmp_path / "new", tmp_path / "old", seed=1, n_cases=1)


def test_drawn_lab_is_described_by_the_cases_models() -> None:
    rng = np.random.default_rng(12)
    drawn = [case for case in (try_case(rng, "hard", "none") for _ in range(3)) if case]
    assert drawn
    for case in drawn:
        scenario = case.scenario
        predicted = scenario.simulator.predict(scenario.field)
        for name, sd in scenario.field_sd.items():
            miss = (predicted[name] - scenario.field_without[name]) / sd
            assert np.sqrt(np.mean(miss**2)) < 0.35
