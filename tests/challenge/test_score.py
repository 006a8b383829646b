"""Scores of diagnoses made by hand, whose right answers are known."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from calib.errors import CalibError
from calib.gap.batch import INPUTS, case_hashes
from challenge.answers import CaseAnswer, CauseAnswer, _ranked, auc, read_answer
from challenge.figures import levels_figure, reliability_figure
from challenge.files import OUTPUT_COLUMNS
from challenge.format import Answer, Explanation
from challenge.levels import LEVELS
from challenge.score import Proportion, score, score_tier
from challenge.seal import open_answers, write_case
from challenge.table import text_table

Writer = Callable[[dict[str, Any]], dict[str, Any]]
TRUTHS = ("none", "none", "unknown", "rate_effect", "force_offset+rate_effect", "parameter_shift")


def entry(truth: str, tier: str) -> dict[str, Any]:
    """Return a key's entry with a gap of three noise sds in the first half of the rows."""
    gap = [0.0 if truth == "none" or i >= 5 else 0.3 for i in range(10)]
    base = [0.5] * 10
    return {
        "tier": tier,
        "truth": truth,
        "noise_sd": {"drawbar_pull": [0.1] * 10},
        "field_truth": {"drawbar_pull": [b + g for b, g in zip(base, gap, strict=True)]},
        "field_without": {"drawbar_pull": base},
        "fresh_truth": {"drawbar_pull": [b + g for b, g in zip(base, gap, strict=True)]},
        "fresh_without": {"drawbar_pull": base},
    }


def hidden(folder: Path, cases: dict[str, dict[str, Any]]) -> tuple[Path, Path]:
    """Write cases with their answers, and return both folders."""
    for name, answer in cases.items():
        files = {"case.toml": "", "lab.csv": f"lab of {name}", "field.csv": f"field of {name}"}
        write_case(folder / "cases" / name, files, folder / "answers", answer)
    return folder / "cases", folder / "answers"


def truths(answers: Path) -> dict[str, dict[str, Any]]:
    """Return the answers by case."""
    found = sorted(answers.glob("*/answer.json"))
    return {path.parent.name: json.loads(path.read_text(encoding="utf-8")) for path in found}


@pytest.fixture
def sealed(tmp_path: Path) -> tuple[Path, Path]:
    """Return the folders of cases and answers of a test with six cases per tier."""
    cases = {
        f"case-{i:03d}": entry(truth, tier)
        for i, (tier, truth) in enumerate((t, n) for t in ("easy", "hard") for n in TRUTHS)
    }
    return hidden(tmp_path, cases)


def perfect(case: dict[str, Any]) -> dict[str, Any]:
    """Answer as one who has read the key."""
    truth = case["truth"]
    gap = np.array(case["field_truth"]["drawbar_pull"]) - 0.5
    return {
        "verdict": truth if truth in ("none", "unknown") else "effect",
        "effects": [{"name": truth, "probability": 1.0}, {"name": "other", "probability": 0.0}],
        "where": [
            {"output": "drawbar_pull", "row": i, "probability": float(g > 0.1)}
            for i, g in enumerate(gap)
        ],
        "shrink": {"drawbar_pull": {"interval": [0.9, 1.0]}},
        "after": case["fresh_truth"]["drawbar_pull"],
    }


def worst(case: dict[str, Any]) -> dict[str, Any]:
    """Answer wrongly, and with certainty."""
    right = perfect(case)
    null = case["truth"] == "none"
    return {
        "verdict": "effect" if null or case["truth"] == "unknown" else "unknown",
        "effects": [
            {"name": "lug_thrust", "probability": 1.0},
            {"name": "load_transfer", "probability": 0.0},
            {"name": case["truth"], "probability": 0.0},
        ],
        "where": [{**w, "probability": 1.0 - w["probability"]} for w in right["where"]],
        "shrink": right["shrink"],
        "after": [0.5 - (x - 0.5) for x in right["after"]],
    }


def write(results: Path, key: Path, answer: Writer, skip: tuple[str, ...] = ()) -> None:
    """Write diagnoses and predictions of every case but some."""
    for name, case in truths(key).items():
        if name in skip:
            continue
        given = answer(case)
        after = given.pop("after")
        (results / name).mkdir(parents=True)
        (results / name / "diagnosis.json").write_text(json.dumps(given), encoding="utf-8")
        column = OUTPUT_COLUMNS["drawbar_pull"]
        with (results / name / "fresh_prediction.csv").open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["slip_ratio", f"{column}_before", f"{column}_after"])
            rows.writerows([0.1, 0.5, value] for value in after)


@pytest.mark.parametrize("best", [True, False])
def test_perfect_diagnoses_reach_every_level_and_the_worst_none(
    best: bool, sealed: tuple[Path, Path], tmp_path: Path
) -> None:
    write(tmp_path / "r", sealed[1], perfect if best else worst)
    right, wrong = (1, 0) if best else (0, 1)
    for tier in score(sealed[0], tmp_path / "r", sealed[1]).tiers.values():
        assert tier.top_1 == tier.top_2 == tier.shrink_coverage == Proportion(4 * right, 4)
        assert tier.truth_probability.value == tier.localisation_auc.value == right
        assert tier.false_alarm == Proportion(2 * wrong, 2)
        assert tier.unlisted_recognised == Proportion(right, 1)
        assert tier.listed_called_unknown == Proportion(3 * wrong, 3)
        assert tier.confidently_wrong == Proportion(6 * wrong, 6)
        assert tier.actual_shrink.value == pytest.approx(right - wrong)
        assert tier.brier.value == 2.0 * wrong
        assert tier.n_failed == 0
        if best:
            assert tier.top_1_all == Proportion(6, 6)
        met = [level.met(tier.tier, getattr(tier, level.name).value) for level in LEVELS]
        assert best or not any(met)


@pytest.mark.parametrize("broken", ["missing", "not json", "probability 3"])
def test_failed_cases_count_as_failures(
    sealed: tuple[Path, Path], tmp_path: Path, broken: str
) -> None:
    bad = ("case-000", "case-003")
    write(tmp_path / "r", sealed[1], perfect, skip=bad if broken == "missing" else ())
    text = {
        "not json": "{",
        "probability 3": '{"verdict": "none", "effects": [{"name": "none", "probability": 3}]}',
    }
    for name in bad if broken in text else ():
        (tmp_path / "r" / name / "diagnosis.json").write_text(text[broken], encoding="utf-8")
    got = score(sealed[0], tmp_path / "r", sealed[1])
    easy = got.tiers["easy"]
    assert (easy.n_cases, easy.n_failed) == (6, 2)
    assert easy.top_1 == Proportion(3, 4)
    assert easy.false_alarm == Proportion(1, 2)
    assert easy.listed_called_unknown == Proportion(1, 3)
    assert easy.localisation_auc.n == 4
    assert easy.no_shrink_interval == Proportion(1, 4)
    assert easy.brier.value == pytest.approx(2 / 6)
    assert "case-003" in text_table(got)


def test_names_of_a_pair_count_in_any_order(sealed: tuple[Path, Path], tmp_path: Path) -> None:

    def swapped(case: dict[str, Any]) -> dict[str, Any]:
        given = perfect(case)
        given["effects"][0]["name"] = "+".join(case["truth"].split("+")[::-1])
        return given

    def half(case: dict[str, Any]) -> dict[str, Any]:
        given = perfect(case)
        given["effects"][0]["name"] = case["truth"].split("+")[0]
        return given

    write(tmp_path / "a", sealed[1], swapped)
    write(tmp_path / "b", sealed[1], half)
    assert score(sealed[0], tmp_path / "a", sealed[1]).tiers["hard"].top_1 == Proportion(4, 4)
    assert score(sealed[0], tmp_path / "b", sealed[1]).tiers["hard"].top_1 == Proportion(3, 4)


def test_changed_answer_is_refused(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    cases, answers = sealed
    path = answers / "case-003" / "answer.json"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("rate_effect", "lug_thrust"), encoding="utf-8")
    with pytest.raises(CalibError, match="SHA-256"):
        score(cases, tmp_path, answers)
    with pytest.raises(CalibError, match="there are no answers"):
        score(cases, tmp_path, tmp_path / "nowhere")
    path.write_text(text, encoding="utf-8")
    assert open_answers(cases, answers)["case-003"].truth == "rate_effect"
    with pytest.raises(CalibError, match="there is no diagnosis"):
        score(cases, tmp_path / "nowhere", answers)
    (cases / "case-003" / "case.toml").write_text("", encoding="utf-8")
    with pytest.raises(CalibError, match="published answer_sha256, None"):
        score(cases, tmp_path, answers)


def test_a_case_without_its_answer_is_told(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    cases, answers = sealed
    write(tmp_path / "r", answers, perfect)
    (answers / "case-003" / "answer.json").unlink()
    found = score(cases, tmp_path / "r", answers)
    assert len(found.answers) == 11
    assert "1 cases have no answer and are not scored, one is case-003" in found.warnings


def test_diagnoses_of_other_cases_are_refused(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    cases, key = sealed
    write(tmp_path / "r", key, perfect)
    assert "12 of 12 diagnoses cannot be held" in score(cases, tmp_path / "r", key).warnings[0]
    for name in truths(key):
        path = cases / name / "case.toml"
        text = 'calibration = "lab.csv"\nfield = "field.csv"\n[models]\ndrawbar_pull = "m"\n'
        path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")
        record = json.dumps(case_hashes(cases / name))
        (tmp_path / "r" / name / INPUTS).write_text(record, encoding="utf-8")
    assert score(cases, tmp_path / "r", key).warnings == ()
    (cases / "case-003" / "field.csv").write_text("changed", encoding="utf-8")
    with pytest.raises(CalibError, match=r"1 of 12 diagnoses .* case-003"):
        score(cases, tmp_path / "r", key)


def test_jeffreys_interval_of_a_known_case() -> None:
    assert Proportion(5, 20).interval == pytest.approx((0.1024, 0.4641), abs=2e-3)
    assert (Proportion(0, 4).interval[0], Proportion(4, 4).interval[1]) == (0.0, 1.0)
    # A few cases tell neither way.
    marks = {(40, 40): "met", (3, 4): "too few to tell", (0, 10): "MISSED", (28, 40): "MISSED"}
    for (successes, n), mark in marks.items():
        assert LEVELS[0].mark("easy", Proportion(successes, n)) == mark


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=2, max_size=40))
def test_auc_is_the_share_of_ordered_pairs(rows: list[tuple[int, bool]]) -> None:
    values = np.array([float(v) for v, _ in rows])
    positive = np.array([p for _, p in rows])
    got = auc(values, positive)
    pairs = [
        1.0 if a > b else 0.5 if a == b else 0.0
        for a in values[positive]
        for b in values[~positive]
    ]
    if pairs:
        assert got == pytest.approx(np.mean(pairs))
    else:
        assert got is None


def test_reliability_bins_hold_every_case(sealed: tuple[Path, Path], tmp_path: Path) -> None:

    def unsure(case: dict[str, Any]) -> dict[str, Any]:
        given = perfect(case)
        given["effects"] = [
            {"name": case["truth"], "probability": 0.45},
            {"name": "lug_thrust", "probability": 0.55},
        ]
        return given

    write(tmp_path / "r", sealed[1], unsure)
    tier = score(sealed[0], tmp_path / "r", sealed[1]).tiers["easy"]
    assert tier.reliability[5].correct == Proportion(0, 6)
    assert tier.reliability[5].confidence == pytest.approx(0.55)
    assert sum(b.correct.n for b in tier.reliability) == 6
    assert tier.top_2 == Proportion(4, 4)
    assert tier.brier.value == pytest.approx(0.55**2 + 0.55**2)


def test_cases_of_some_outputs_are_scored_alone(tmp_path: Path) -> None:
    cases = {}
    for i, truth in enumerate(TRUTHS * 2):
        case = cases[f"case-{i:03d}"] = entry(truth, "easy")
        if i >= len(TRUTHS):
            for name in ("noise_sd", "field_truth", "field_without", "fresh_truth"):
                case[name]["rut_depth"] = [1.0] * 10
    hidden(tmp_path, cases)

    def answer(case: dict[str, Any]) -> dict[str, Any]:
        return perfect(case) if "rut_depth" in case["noise_sd"] else worst(case)

    write(tmp_path / "r", tmp_path / "answers", answer)
    where = tmp_path / "cases", tmp_path / "r", tmp_path / "answers"
    assert score(*where).tiers["easy"].top_1 == Proportion(4, 8)
    alone = score(*where, ["rut_depth", "drawbar_pull"])
    assert alone.tiers["easy"].top_1 == Proportion(4, 4)
    assert len(alone.answers) == 6
    assert score(*where, ["drawbar_pull"]).tiers["easy"].top_1 == Proportion(0, 4)
    with pytest.raises(CalibError, match="no case measures rut_depth alone") as caught:
        score(*where, ["rut_depth"])
    assert "drawbar_pull; drawbar_pull,rut_depth" in str(caught.value)


def test_table_and_figures_show_the_score(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    write(tmp_path / "r", sealed[1], worst, skip=("case-002",))
    got = score(sealed[0], tmp_path / "r", sealed[1])
    text = text_table(got)
    assert all(text.count(level.label) >= 2 for level in LEVELS)
    assert "MISSED" in text
    summary = levels_figure(list(got.tiers.values()))
    assert len(summary.axes) == 2
    reliability = reliability_figure(got.tiers["easy"].reliability, "easy")
    for i, figure in enumerate((summary, reliability)):
        figure.savefig(tmp_path / f"{i}.png")
        assert (tmp_path / f"{i}.png").stat().st_size > 5000


def causes(*told: tuple[float, float, tuple[float, float]]) -> tuple[CauseAnswer, ...]:
    """Causes by stated probability, true contribution and stated interval of the share."""
    total = sum(size for _, size, _ in told)
    return tuple(
        CauseAnswer(f"cause {i}", p, size, size / total, interval)
        for i, (p, size, interval) in enumerate(told)
    )


def test_inclusion_and_shares_are_scored() -> None:
    told = causes(
        (0.9, 6.0, (0.5, 0.7)), (0.2, 2.8, (0.0, 0.1)), (0.1, 1.2, (0.0, 0.1)), (0.6, 0.0, (0, 0)),
        (0.0, 0.0, (0, 0)),
    )  # fmt: skip
    remainder = replace(told[3], name="unknown")
    answer = CaseAnswer(
        "case-000", "large", "a+b+c", "effect", (("a+b", 0.6), ("none", 0.4)), None, (), ("rut",),
        causes=(*told, remainder),
    )  # fmt: skip
    found = score_tier("large", [answer])
    assert found.included == Proportion(1, 2)
    assert found.wrongly_included == Proportion(1, 2)
    assert found.share_coverage == Proportion(1, 2)  # 0.6 in 0.5 to 0.7; 0.28 not below 0.1
    squares = (0.1**2, 0.8**2, 0.6**2, 0.0)
    assert found.inclusion_brier.value == pytest.approx(np.mean(squares))
    # Bins of 0.9 and 0.2 and 0.6 with one each: 0.1 + 0.8 + 0.6 of four.
    assert found.inclusion_error.value == pytest.approx(1.5 / 4)
    assert found.inclusion_auc.value == pytest.approx(3.0 / 4.0)
    assert LEVELS[0].mark("large", found.top_1) == "too few to tell"
    assert LEVELS[1].mark("large", found.top_2) == ""


def test_what_stated_probabilities_promise_is_what_comes_true_if_they_are_right():
    """By hand for one case; then truths drawn from what is stated, 800 times."""
    stated = (("a", 0.95), ("none", 0.04), ("b", 0.01))
    causes = (CauseAnswer("a", 0.9, 3.0, 1.0, (0.9, 1.1)), CauseAnswer("b", 0.3, 0.0, 0.0, (0, 0)))
    answer = CaseAnswer(
        "case-000", "easy", "a", "effect", stated, None, (), ("rut",), causes=causes
    )
    own = score_tier("easy", [answer]).by_itself
    assert own["top_1"] == pytest.approx(0.95 / 0.96)
    assert own["confidently_wrong"] == pytest.approx(0.05)
    assert own["included"] == pytest.approx(0.9 / 1.2)
    assert own["wrongly_included"] == pytest.approx(0.1 / 0.8)

    rng = np.random.default_rng(5)
    answers = []
    for i in range(800):
        p = rng.dirichlet([2.0, 0.4, 0.4])
        names = np.array(["a", "b", "c"])[rng.permutation(3)]
        truth = str(rng.choice(names, p=p))
        ranked = tuple(sorted(zip(map(str, names), p.tolist(), strict=True), key=lambda x: -x[1]))
        told = tuple(CauseAnswer(n, q, 3.0 * (n == truth), 0.0, (0, 0)) for n, q in ranked)
        answers.append(
            CaseAnswer(f"{i}", "easy", truth, "effect", ranked, None, (), ("rut",), causes=told)
        )
    found = score_tier("easy", answers)
    for name, expected in found.by_itself.items():
        value, n = getattr(found, name).value, getattr(found, name).n
        assert abs(value - expected) < 4.0 * (expected * (1.0 - expected) / n) ** 0.5
    assert found.by_itself["top_1"] < 0.97


def told_apart(tmp_path: Path, truth: str, **rival: Any) -> float | None:
    content = {"schema": "calib/answer/1", **entry(truth, "easy"), **rival}
    return read_answer("case-000", Answer.model_validate(content), tmp_path).told_apart


def test_a_nearest_rival_is_the_chance_to_choose_the_truth(tmp_path: Path) -> None:
    # Half the square of the distance is the expected log likelihood ratio.
    found = told_apart(tmp_path, "rate_effect", rival="lug_thrust", rival_nats=2.0)
    assert found == pytest.approx(norm.cdf(1.0))
    assert told_apart(tmp_path, "rate_effect", rival="lug_thrust", rival_nats=0.0) == 0.5
    assert told_apart(tmp_path, "parameter_shift", rival="", rival_nats=None) == 1.0
    # A null and keys that do not say are left out; keys of before named a shift as its own rival.
    assert told_apart(tmp_path, "none", rival="", rival_nats=0.0) is None
    assert told_apart(tmp_path, "rate_effect") is None
    own = {"rival": "parameter_shift", "rival_nats": 1.0}
    assert told_apart(tmp_path, "parameter_shift", **own) is None


def test_listed_causes_with_something_unlisted_besides_are_those_causes():
    said = {"lug_thrust+unknown": 0.4, "lug_thrust": 0.3, "b+a": 0.1, "unknown": 0.2}
    ranked = _ranked([Explanation(name=name, probability=p) for name, p in said.items()])
    assert dict(ranked) == pytest.approx({"lug_thrust": 0.7, "unknown": 0.2, "a+b": 0.1})
    assert ranked[0][0] == "lug_thrust"


def mixed(weak: float, ranked: dict[str, float]) -> CaseAnswer:
    """Return the answer to a case of two causes, the second of which adds so many noise sds."""
    causes = tuple(
        CauseAnswer(name, 0.5, sds, 0.5, (0.0, 1.0))
        for name, sds in (("lug_thrust", 8.0), ("rut_rebound", weak), ("force_offset", 0.0))
    )
    said = tuple(sorted(ranked.items(), key=lambda item: -item[1]))
    return CaseAnswer(
        "case-000", "large", "lug_thrust+rut_rebound", "effect", said, None, (), (), causes=causes
    )


def test_a_cause_too_weak_to_be_asked_for_may_be_left_out():
    ranked = {"lug_thrust": 0.9, "lug_thrust+rut_rebound": 0.06, "rut_rebound": 0.04}
    found = mixed(1.2, ranked)
    assert found.right == {"lug_thrust", "lug_thrust+rut_rebound"}
    assert found.among_first(1)
    assert not found.confidently_wrong()
    assert found.truth_probability == pytest.approx(0.96)
    assert found.brier == pytest.approx(2 * 0.04**2)
    # One that adds more may not, nor may one be named that does not act.
    missed = mixed(1.3, ranked)
    assert not missed.among_first(1)
    assert missed.confidently_wrong()
    assert mixed(1.2, {"force_offset+lug_thrust": 0.95}).confidently_wrong()
