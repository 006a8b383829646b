"""The oracle on sealed cases: right on what can be told, and honest about what cannot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from calib.challenge.figures import levels_figure
from calib.challenge.limit import LIMIT_NAME, find_limit, read_limit, rms_error
from calib.challenge.make import make
from calib.challenge.oracle.case import examine, read_item
from calib.challenge.oracle.combine import errors, log_kept, probabilities
from calib.challenge.oracle.designs import plan_shares
from calib.challenge.score import Score, confusion, score_tier
from calib.challenge.seal import open_key, publish, seal
from calib.challenge.table import text_table
from calib.errors import CalibError
from tests.challenge.oracle.stages import drawn, sealed


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Return cases, key and limit of a null and two cases with a large gap."""
    root = tmp_path_factory.mktemp("three")
    truths = [("none", "easy", 1), ("force_offset", "easy", 1), ("rate_effect", "hard", 3)]
    cases, key = sealed(root, [drawn(*each) for each in truths])  # type: ignore[arg-type]
    return cases, key, find_limit(cases, key, root / "limit")


def test_nulls_and_large_gaps_are_told(three: tuple[Path, Path, Path]) -> None:
    """The truth has nearly all the probability, for one who knows the soil and one who does not."""
    cases, key, path = three
    limit = read_limit(path, cases)
    assert {a.truth for a in limit.answers.values()} == {"none", "force_offset", "rate_effect"}
    for answers in (limit.answers, limit.known_soil):
        for answer in answers.values():
            assert sum(p for _, p in answer.ranked) == pytest.approx(1.0, abs=1e-4)
            assert answer.called == answer.truth
            assert answer.truth_probability > 0.97
    assert rms_error(limit) < 0.02
    assert limit.expected_first("easy") == pytest.approx(1.0, abs=0.02)
    part = limit.of({"case-000"})
    assert part.tier("easy").n_cases == 1
    assert part.tier("hard").n_cases == part.tier_known_soil("hard").n_cases == 0
    assert rms_error(part) == pytest.approx(limit.errors["case-000"])
    assert open_key(cases, key)["cases"]["case-000"]["stage"]["design"]["tier"] == "easy"


def test_it_is_resumed_and_repeatable(three: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """What is there is not done again; the same seed says the same, one process or another."""
    cases, key, path = three
    (parts,) = path.parent.glob("cases-*-1-1")
    before = {p: p.stat().st_mtime_ns for p in parts.glob("case-*.json")}
    assert len(before) == 3
    text = path.read_text(encoding="utf-8")
    find_limit(cases, key, path.parent)
    assert {p: p.stat().st_mtime_ns for p in parts.glob("case-*.json")} == before
    assert path.read_text(encoding="utf-8") == text
    entry = open_key(cases, key)["cases"]["case-001"]
    again = examine(read_item(cases / "case-001", entry), 1)
    assert json.loads((parts / "case-001.json").read_text(encoding="utf-8")) == again
    other = examine(read_item(cases / "case-001", entry), 2)
    assert other["states"]["sensor_drift"] != again["states"]["sensor_drift"]


def test_table_and_figure_show_the_limit(three: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """Beside every level that has one; by kind of truth; a mark in the figure."""
    cases, _, path = three
    limit = read_limit(path, cases)
    answers = tuple(limit.answers.values())
    tiers = {
        tier: score_tier(tier, [a for a in answers if a.tier == tier]) for tier in ("easy", "hard")
    }
    score = Score(tiers, {"easy": confusion(list(answers))}, answers)
    text = text_table(score, limit)
    assert text.count("limit  95 % interval") == 2
    (first, *_) = [line for line in text.splitlines() if "right hypothesis first" in line]
    assert first.split().count("1.000") == 2
    assert "hard, one listed effect" in text
    assert "Monte Carlo error" in text
    assert "limit" not in text_table(score)
    figure = levels_figure(list(tiers.values()), limit)
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert any(label.startswith("limit") for label in labels)


def test_limits_and_keys_of_other_cases_are_refused(
    three: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    """A limit belongs to its cases, lies outside them, and needs a key with their stages."""
    cases, key, path = three
    other, other_key = sealed(tmp_path / "other", [drawn("none", "easy", 1)], seed=5)
    with pytest.raises(CalibError, match="of other cases"):
        read_limit(path, other)
    with pytest.raises(CalibError, match="cannot be read"):
        read_limit(tmp_path / "none.json", cases)
    with pytest.raises(CalibError, match="must not lie with the cases"):
        find_limit(cases, key, cases / "limit")
    with pytest.raises(CalibError, match="SHA-256"):
        find_limit(cases, other_key, tmp_path / "limit")
    content = json.loads(other_key.read_text(encoding="utf-8"))
    del content["cases"]["case-000"]["stage"]
    publish(other, content, seal(content, other_key), ("easy",))
    with pytest.raises(CalibError, match="on what its cases were made"):
        find_limit(other, other_key, tmp_path / "limit")
    assert not (tmp_path / "limit" / LIMIT_NAME).exists()


def test_mechanics_that_changed_are_noticed(three: tuple[Path, Path, Path]) -> None:
    """A key whose readings the mechanics no longer give cannot be asked about."""
    cases, key, _ = three
    entry = open_key(cases, key)["cases"]["case-001"]
    entry["field_without"]["drawbar_pull"][3] *= 1.001
    with pytest.raises(CalibError, match="another drawbar_pull than the key holds"):
        examine(read_item(cases / "case-001", entry), 1)


def toy(log_evidence: dict[str, float], kept: float = 1.0) -> dict[str, object]:
    """Return a case as `examine` returns it, with two states besides none."""
    states = {
        name: {
            "log_evidence": value, "known_soil": value, "error": 0.1 * (name != "none"),
            "kept": 1.0 if name == "none" else kept, "log_design": 0.0,
        }
        for name, value in log_evidence.items()
    }  # fmt: skip
    return {"tier": "easy", "truth": "none", "outputs": ["drawbar_pull"], "states": states}


def test_probabilities_are_bayes_theorem() -> None:
    """Prior times evidence over the share kept, by hand; unlisted mechanisms are added up."""
    names = {"none": 0.0, "force_offset": 1.0, "unknown:ripple": 0.5, "unknown:lag": -0.5}
    cases = {"a": toy(names, 0.25), "b": toy(dict.fromkeys(names, 0.0), 0.75)}
    plan = plan_shares("easy")
    kept = dict(zip(plan, np.exp(log_kept(cases, "easy")), strict=True))
    assert kept["none"] == pytest.approx(1.0)
    assert 0.25 < kept["force_offset"] < 0.75
    weights = {
        name: plan[name] * np.exp(value) / (1.0 if name == "none" else kept[name])
        for name, value in names.items()
    }
    got = probabilities(cases, "easy")["a"]
    total = sum(weights.values())
    assert got["none"] == pytest.approx(weights["none"] / total)
    unlisted = weights["unknown:ripple"] + weights["unknown:lag"]
    assert got["unknown"] == pytest.approx(unlisted / total)
    slopes = [weights[n] / total * -weights["none"] / total for n in names if n != "none"]
    assert errors(cases, "easy")["a"] == pytest.approx(0.1 * np.sqrt(np.sum(np.square(slopes))))


def test_kept_shares_come_back_from_kept_stages() -> None:
    """Stages seen only because something was kept on them give the share kept over all stages."""
    rng, plan = np.random.default_rng(3), plan_shares("easy")
    shift = plan["parameter_shift"] / (plan["parameter_shift"] + plan["none"])
    cases: dict[str, dict[str, object]] = {}
    while len(cases) < 4000:
        wanted_shift = rng.uniform() < shift
        while True:  # as the generator draws again, stage and all, until it keeps one
            share = float(rng.choice([0.1, 0.9], p=[0.7, 0.3]))
            if not wanted_shift or rng.uniform() < share:
                break
        cases[str(len(cases))] = toy({"none": 0.0, "parameter_shift": 0.0}, share)
    got = dict(zip(plan, np.exp(log_kept(cases, "easy")), strict=True))
    assert got["none"] == pytest.approx(1.0)
    assert got["parameter_shift"] == pytest.approx(0.7 * 0.1 + 0.3 * 0.9, abs=0.03)
    naive = np.mean([case["states"]["parameter_shift"]["kept"] for case in cases.values()])  # type: ignore[index]
    assert naive > 0.40


@pytest.mark.slow
def test_probabilities_mean_what_they_say(tmp_path: Path) -> None:
    """On 100 blind cases the truth comes first as often as the oracle expects."""
    make(tmp_path / "cases", tmp_path / "key.json", seed=77, n_cases=100, workers=2)
    path = find_limit(tmp_path / "cases", tmp_path / "key.json", tmp_path / "limit", workers=2)
    limit = read_limit(path, tmp_path / "cases")
    expected = np.array([a.confidence for a in limit.answers.values()])
    right = np.array([a.called == a.truth for a in limit.answers.values()])
    spread = np.sqrt(np.sum(expected * (1.0 - expected)) + 0.5)
    assert abs(right.sum() - expected.sum()) < norm.ppf(0.999) * spread
    nulls = [a for a in limit.answers.values() if a.truth == "none"]
    assert np.mean([a.called == "none" for a in nulls]) > 0.95
    assert rms_error(limit) < 0.03
