"""The rules of the verdict, one by one and in their order."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

import calib
from calib.report.study import validated
from calib.report.verdict import (
    Evidence,
    Level,
    Verdict,
    Where,
    gather,
    judge_evidence,
)
from calib.validation.constants import LEVEL
from calib.validation.prediction import binomial_p
from calib.validation.residuals import Check, Range, Remark

FINE = Evidence(
    converged=True,
    reasons=(),
    held_out=True,
    hits=13,
    n=14,
    low_coverage_p=0.4,
    effective=9.0,
    rmse=0.04,
    unit="kN",
    max_relative_error=0.08,
    prior_set=(),
    two_pressures=False,
    null_rmse=0.13,
    linear_rmse=0.09,
    sign_changes=12,
    neighbours=26,
    along="slip",
    inside="slip 0 to 70 %",
)

RULES = {
    "not converged": {
        "converged": False,
        "reasons": ("R-hat of C is 1.2, at most 1.01 is needed",),
    },
    "not scored": {"rmse": float("nan")},
    "emulated badly": {"emulator_fails": ("the emulator is off by 0.3 noise sds (rms)",)},
    "miscovered": {"hits": 6, "low_coverage_p": 0.001},
    "misfit": {"sign_changes": 4},
    "unexpected": {"prior_hits": 2, "prior_n": 20},
    "extrapolated": {"two_pressures": True, "prior_set": ("K_bend", "D_bend")},
    "few": {"hits": 1, "n": 1},
    "weak": {"null_rmse": 0.042},
}


CASES = {
    "fine": {},
    **RULES,
    "at": RULES["extrapolated"] | {"held_out": False},
    "beyond": RULES["extrapolated"] | {"unseen_at": Where.BEYOND},
    "between": RULES["extrapolated"] | {"unseen_at": Where.BETWEEN, "effective": 1.8},
    "nothing unseen": {"n": 0, "rmse": float("nan")},
    "set by the prior": {"prior_set": ("C2",)},
    "in conflict": {"conflicts": ("n0",)},
    "lucky": {"loo_rmse": 0.52, "loo_max_relative_error": 0.9},
    "lucky and wrong": RULES["misfit"] | {"loo_rmse": 0.52},
    "unlucky": {"loo_rmse": 0.03, "loo_max_relative_error": 0.05},
    "no relative error": RULES["miscovered"] | {"max_relative_error": float("nan")},
    "unexpected load": RULES["unexpected"] | {"suspects": "the load", "notes": ("5 kN, say",)},
    "extrapolated and wrong": RULES["extrapolated"] | RULES["misfit"],
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_said(case, snapshot):
    """Each rule decides alone; its words are kept, and read back from a file as they were."""
    evidence = replace(FINE, **CASES[case], parabolic_in="inflation_pressure_psi",
                       fitted_at=(18.0, 42.0))  # fmt: skip
    found = judge_evidence(evidence)
    assert found.rule == case or case not in RULES
    assert (found.level is Level.FINE) == (
        case in ("fine", "set by the prior", "in conflict", "lucky", "unlucky")
    )
    document = json.loads(json.dumps(found.document(), allow_nan=False))
    assert Verdict.of(document) == found
    assert document == snapshot


@pytest.mark.parametrize("first", range(len(RULES)))
def test_the_graver_rule_decides(first):
    rules = list(RULES)
    evidence = FINE
    for rule in reversed(rules[first:]):
        evidence = replace(evidence, **RULES[rule])
    assert judge_evidence(evidence).rule == rules[first]


@pytest.mark.parametrize(("hits", "rule"), [(9, "unexpected"), (10, "fine"), (20, "fine")])
def test_priors_expect_at_least_half_of_the_points(hits, rule):
    assert judge_evidence(replace(FINE, prior_hits=hits, prior_n=20)).rule == rule


@pytest.mark.parametrize(
    ("psi", "told"), [(18.0, False), (30.0, True), (42.0, False), (50.0, True)]
)
def test_a_doubt_is_told_of_the_rows_that_it_concerns(psi, told):
    evidence = replace(
        FINE, **RULES["extrapolated"], unseen_at=Where.BETWEEN,
        parabolic_in="inflation_pressure_psi", fitted_at=(18.0, 42.0),
    )  # fmt: skip
    rows = {"inflation_pressure_psi": np.array([float(psi)])}
    assert bool(judge_evidence(evidence).for_rows(rows)) is told
    held = replace(judge_evidence(evidence), held_out="14 rows (inflation_pressure_psi = 30)")
    first = held.for_rows(rows)[0]
    assert "14 rows (inflation_pressure_psi = 30) were held out of this fit" in first
    assert "fit again without --hold-out" in first


def test_what_fails_at_one_pressure_is_told_there_alone():
    range_ = Range("inflation_pressure_psi", 18.0, 18.0)
    remark = Remark("one sigma is too small at 18 psi", "Scatter is uneven", where=(range_,))
    evidence = replace(FINE, checks=(Check(0.0024, remark),))
    found = judge_evidence(evidence)
    assert (found.rule, found.level, found.fails) == ("assumption", Level.CARE, (remark.text,))
    assert remark.text in found.for_rows({"inflation_pressure_psi": np.array([18.0, 30.0])})
    assert remark.text not in found.for_rows({"inflation_pressure_psi": np.array([42.0])})


def of(result) -> Evidence:
    return gather(result.calibration, result.validation, result.prior_predictive)


def test_data_in_another_unit_or_of_another_sign_conflict_with_the_priors(drawbar):
    problem = replace(drawbar.calibration.problem, notes=("5 kN is assumed",))
    calibration = replace(drawbar.calibration, problem=problem)
    off = 1000.0 + drawbar.prior_predictive
    evidence = of(replace(drawbar, calibration=calibration, prior_predictive=off))
    assert (evidence.prior_hits, evidence.prior_n) == (0, 28)
    assert evidence.notes == ("5 kN is assumed",)
    columns, pull = dict(problem.table.columns), problem.bound.model.output
    table = calib.table_from_arrays({**columns, pull: -columns[pull]})
    turned = calib.build_problem(problem.bound.model.name, table)
    found = calib.verdict(replace(drawbar.calibration, problem=turned))
    assert found.level is Level.CARE
    for fails in (judge_evidence(evidence).fails, found.fails):
        assert any("the normal load" in said for said in fails)


def test_evidence_of_the_held_out_pressure(drawbar):
    evidence = of(drawbar)
    assert evidence.two_pressures
    assert {"K_bend", "D_bend"} <= set(evidence.prior_set)
    assert (evidence.held_out, evidence.n, evidence.neighbours) == (True, 14, 26)
    assert evidence.effective < 7
    assert evidence.inside == "slip 2 to 72 % and inflation pressure 18 to 42 psi"
    assert evidence.prior_hits >= 14
    verdict = judge_evidence(evidence)
    # What fails comes before what the prior sets, which is doubted all the same.
    assert verdict.headline == "Scatter is uneven"
    assert "one sigma is too small at 18 psi" in verdict.fails[0]
    assert verdict.trust == "the median at 18 and 42 psi for slip 2 to 72 %"
    assert "two pressures do not determine a quadratic" in verdict.doubt
    assert judge_evidence(replace(evidence, checks=())).rule == "extrapolated"
    # In Python there is a verdict without a study, a page or a figure.
    found = calib.verdict(drawbar.calibration, drawbar.validation)
    assert (found.rule, found.trust, found.headline) == (
        verdict.rule, verdict.trust, verdict.headline
    )  # fmt: skip


@pytest.mark.parametrize(
    ("psi", "where"), [(30.0, Where.BETWEEN), (18.0, Where.AT), (50.0, Where.BEYOND)]
)
def test_where_the_held_out_rows_lie(drawbar, psi, where):
    table = drawbar.validation.table
    columns = dict(table.columns) | {"inflation_pressure_psi": np.full(len(table), psi)}
    held = replace(drawbar.validation, table=replace(table, columns=columns))
    assert of(replace(drawbar, validation=held)).unseen_at is where


def test_evidence_of_other_validations(density, rut, unconverged):
    evidence, scores = of(density), density.validation.scores
    assert not evidence.held_out
    assert evidence.unseen_at is Where.AT
    assert evidence.low_coverage_p == pytest.approx(binomial_p(scores.coverage[0.9].hits, 36))
    expected = 1 - scores.rmse**2 / np.var(density.validation.observed)
    assert evidence.skill == pytest.approx(expected)
    # Linear regressions, each without a row.
    problem = density.calibration.problem
    x = np.column_stack([np.ones(36), *problem.conditions.values()])
    y = problem.observed
    left_out = [
        x[i] @ np.linalg.lstsq(np.delete(x, i, 0), np.delete(y, i))[0] - y[i] for i in range(36)
    ]
    assert evidence.linear_rmse == pytest.approx(np.sqrt(np.mean(np.square(left_out))))
    scores = replace(rut.validation.scores, rmse=float("nan"))
    draws = np.full_like(rut.validation.draws, np.nan)
    broken = replace(rut, validation=replace(rut.validation, scores=scores, draws=draws))
    assert judge_evidence(of(broken)).rule == "not scored"
    assert judge_evidence(of(unconverged)).headline == "NOT CONVERGED"
    assert calib.verdict(rut.calibration).level is Level.CARE


def test_verdicts_draw_nothing():
    code = "import sys, calib.report.verdict, calib.report.gap_words"
    done = [sys.executable, "-c", f"{code}; print('matplotlib' in sys.modules)"]
    found = subprocess.run(done, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


@pytest.mark.slow
def test_rows_that_are_as_assumed_stay_green_as_often_as_is_said() -> None:
    """Fifty campaigns of plates, drawn from the model, with a column that means nothing."""
    rng = np.random.default_rng(8)
    at = {"average_ground_pressure_kpa": np.tile([5.0, 10.0, 20.0, 40.0], 9),
          "plate_width_mm": np.repeat([60.0, 80.0, 100.0], 12)}  # fmt: skip
    alarms = 0
    for seed in range(50):
        share, n, mean = rng.uniform(-0.5, 0.5), rng.uniform(0.8, 1.3), rng.uniform(10.0, 40.0)
        stiffer = 1.0 - share + share * 77.5 / at["plate_width_mm"]
        z = mean * (at["average_ground_pressure_kpa"] / 14.1 / stiffer) ** (1.0 / n)
        z *= np.exp(0.1 * rng.standard_normal(36))
        table = calib.table_from_arrays(
            {**at, "rut_depth_mm": z, "bin": rng.choice(["A", "B"], 36)}
        )
        problem = calib.build_problem("bekker_plate", table)
        point = calib.estimate(problem, "least_squares", np.random.default_rng(seed))
        calibration = calib.calibrate(problem, seed, estimates=(point,))
        found = calib.verdict(calibration, validated(calibration, None))
        alarms += found.level is not Level.FINE
    assert binom.sf(alarms - 1, 50, LEVEL) > 1e-3
