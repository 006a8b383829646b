"""Conditions that are known with an error, in a diagnosis."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from calib.data import Table, table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import Case
from calib.gap.corrected import load_corrected, save_corrected
from calib.gap.diagnose import Diagnosis, diagnose_once
from calib.gap.effects import EFFECTS
from calib.inference.prior_files import DeclaredPriors
from tests.gap.cases import MODELS, NOISE, PULL_ONLY, conditions, simulate

FEW = {n: EFFECTS[n] for n in ("force_offset", "lug_thrust", "rate_effect", "slip_zero_shift")}
SD, ROWS = 0.03, 40


def noisy_field(
    seed: int, *, told: bool, effect: str | None = None, models: dict[str, str] = PULL_ONLY
) -> Case:
    """A field whose slips are off by `SD`; those of the laboratory are exact."""
    rng = np.random.default_rng([seed, 5])
    both = [conditions(ROWS, seed + i, varied=i > 0) for i in (0, 1)]
    place = {OUTPUTS[o]: np.linspace(1.0, 2.0, ROWS) for o in models}
    draft = Case("", *(table_from_arrays({**c, **place}) for c in both), models)
    tables: list[Table] = []
    for name, c, location in zip(("lab", "field"), both, simulate(draft, effect), strict=True):
        columns = dict(c)
        for o, mean in location.items():
            drawn = mean + NOISE[o] * rng.standard_normal(ROWS)
            columns[OUTPUTS[o]] = np.exp(drawn) if o == "rut_depth" else drawn
        if name == "field":
            columns["slip_ratio"] = columns["slip_ratio"] + SD * rng.standard_normal(ROWS)
            if told:
                columns["slip_ratio_sd"] = np.full(ROWS, SD)
        tables.append(table_from_arrays(columns, source=f"{name}.csv"))
    return Case(effect or "null", *tables, models)


@cache
def diagnosed(seed: int, *, told: bool, effect: str | None = None) -> Diagnosis:
    return diagnose_once(noisy_field(seed, told=told, effect=effect), 1, FEW)


def test_a_noisy_slip_is_no_gap_once_it_is_said() -> None:
    told = [diagnosed(seed, told=True) for seed in range(3)]
    assert min(found.ranking.probability["none"] for found in told) > 0.9
    said = told[0].warnings
    assert any(w.startswith("field.csv: slip was read with an error that the column") for w in said)


@pytest.mark.slow
def test_unsaid_it_is_taken_for_a_gap() -> None:
    """Seen: one of twelve fields is taken for one without a gap; all are if the error is said."""
    untold, told = (
        [diagnosed(seed, told=told).verdict for seed in range(12)] for told in (False, True)
    )
    assert untold.count("none") <= 4
    assert told.count("none") >= 11


def test_a_cause_is_found_among_noisy_slips() -> None:
    found = diagnosed(2, told=True, effect="lug_thrust")
    assert found.ranking.order[0] == "lug_thrust"


def test_its_noise_and_its_conditions_have_the_errors_in_them() -> None:
    data = campaigns(noisy_field(1, told=True))
    (o,), field = data.outputs, data.case.field["slip_ratio"]
    variance = field.var(ddof=1)
    expected = field.mean() + (1.0 - SD**2 / variance) * (field - field.mean())
    np.testing.assert_allclose(data.view.conditions["slip_ratio"], expected)
    shift, added = o.by_errors
    np.testing.assert_array_equal(shift[:ROWS], 0.0)
    np.testing.assert_array_equal(added[:ROWS], 0.0)
    # The curve is steepest, and bends down, where slips are small.
    low, high = np.argmin(expected), np.argmax(expected)
    assert added[ROWS + low] > 10.0 * added[ROWS + high] > 0.0
    assert shift[ROWS:].min() < -0.1 * NOISE["drawbar_pull"]
    growth = data.at_rows["drawbar_pull"].growth(0.0, 0.0)
    np.testing.assert_allclose(growth, np.sqrt(1.0 + added))


def test_a_corrected_model_keeps_the_errors(tmp_path: Path) -> None:
    corrected = diagnosed(1, told=True).corrected
    save_corrected(corrected, tmp_path)
    again = load_corrected(tmp_path, FEW)
    np.testing.assert_allclose(
        again.data.view.conditions["slip_ratio"], corrected.data.view.conditions["slip_ratio"]
    )


def test_prior_files_of_a_case_state_one_error_of_each_condition() -> None:
    case = noisy_field(1, told=False, models=dict(MODELS))
    texts = {
        o: f'model = "{m}"\n[likelihood]\nerrors = {{slip_percent = {sd}}}\n'
        for (o, m), sd in zip(MODELS.items(), (2.0, 3.0), strict=True)
    }
    priors = {o: DeclaredPriors(f"{o}.toml", text) for o, text in texts.items()}
    with pytest.raises(CalibError, match="different errors of slip"):
        campaigns(replace(case, priors=priors))
    text = texts["rut_depth"].replace("modified_bekker", "magic_formula_pressure")
    same = replace(case, priors=priors | {"drawbar_pull": DeclaredPriors("p.toml", text)})
    said = campaigns(same).said_of_errors
    assert [s.split(":")[0] for s in said[:2]] == ["lab.csv", "field.csv"]
    assert "independent between outputs" in said[2]
