"""How far: errors before and after, from draws whose answer is known."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.campaigns import campaigns
from calib.gap.corrected import predict_new, shrink
from calib.gap.diagnose import diagnose
from calib.gap.effects import EFFECTS
from calib.gap.mixture import Truth, mixture
from calib.gap.ranking import rank
from tests.gap.cases import PULL_ONLY, campaigns_of, diagnosis_of, make_case, write_case

N = 27


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None, "pull")


def truth(gap: float, spread: float, noise: float = 0.05, draws: int = 2000) -> Truth:
    rng = np.random.default_rng(0)
    plain = np.ones((draws, N))
    true = plain + gap + spread * rng.standard_normal((draws, 1))
    sd = np.full_like(plain, noise)
    measured = true + sd * rng.standard_normal(true.shape)
    return Truth(
        {"drawbar_pull": plain}, {"drawbar_pull": true}, {"drawbar_pull": sd},
        {"drawbar_pull": measured}, np.full(draws, 1.0 / draws),
    )  # fmt: skip


def test_a_known_gap_shrinks_to_what_is_not_known_of_it(data):
    known = truth(0.2, 0.01)
    found = shrink(data, known, {"drawbar_pull": np.ones(N)}, known.means)["drawbar_pull"]
    assert found.rmse_before == pytest.approx(0.2, abs=0.002)
    # The median of |normal| is 0.674 sd.
    assert found.rmse_after == pytest.approx(0.00674, rel=0.1)
    assert found.fraction == pytest.approx(1.0 - 0.0337, abs=0.01)
    assert found.fraction == pytest.approx(1.0 - found.rmse_after / found.rmse_before)
    low, high = found.interval
    # The 95th percentile of |normal| is 1.96 sd; its logarithm is set a quarter farther off.
    assert low == pytest.approx(1.0 - 0.674 * (1.96 / 0.674) ** 1.25 * 0.01 / 0.2, abs=0.02)
    assert low < 1.0 - 1.96 * 0.01 / 0.2
    assert low < found.fraction < high <= 1.0
    assert found.noise_floor == pytest.approx(0.05)


def test_before_is_the_simulator_as_it_was_calibrated(data):
    before = {"drawbar_pull": np.full(N, 0.9)}
    known = truth(0.2, 0.01)
    found = shrink(data, known, before, known.means)["drawbar_pull"]
    assert found.rmse_before == pytest.approx(0.3, abs=0.002)


def test_what_is_small_beside_the_noise_is_no_gap(data):
    small = truth(0.01, 0.0)
    assert shrink(data, small, {"drawbar_pull": np.ones(N)}, small.means) == {}


def test_fresh_predictions_have_the_noise_in_their_band(data):
    band = predict_new(truth(0.2, 0.0), {"drawbar_pull": np.full(N, 0.9)})["drawbar_pull"]
    np.testing.assert_array_equal(band.before, np.full(N, 0.9))
    np.testing.assert_allclose(band.after, 1.2)
    # 2000 draws: the sd of a 5 % quantile is 0.047 sd of the noise.
    np.testing.assert_allclose(band.upper - 1.2, 1.645 * 0.05, atol=4 * 0.047 * 0.05)
    np.testing.assert_allclose(1.2 - band.lower, 1.645 * 0.05, atol=4 * 0.047 * 0.05)


def test_the_correction_of_a_large_drift_predicts_new_conditions():
    found = diagnosis_of("sensor_drift")
    s = found.shrink["drawbar_pull"]
    assert s.fraction > 0.5
    assert 0.0 < s.interval[0] < s.fraction < s.interval[1] <= 1.0
    # The true field at the fresh conditions, from the generator.
    from calib.gap.case import Case
    from tests.gap.cases import simulate

    case = make_case("sensor_drift", n_fresh=9)
    assert case.new_conditions is not None
    columns = dict(case.new_conditions.columns) | {
        c: np.linspace(1.0, 2.0, 9) for c in ("drawbar_pull_kn", "rut_depth_mm")
    }

    fresh = table_from_arrays(columns)
    # The drift of the generator at the place that the rows have in the campaign.
    actual = simulate(Case("fresh", case.lab, fresh, case.models), None)[1]["drawbar_pull"]
    actual = actual + 0.25 * fresh["run_order"] / 26.0
    band = found.new_predictions["drawbar_pull"]
    before = np.sqrt(np.mean(np.square(band.before - actual)))
    after = np.sqrt(np.mean(np.square(band.after - actual)))
    assert after < 0.6 * before


def test_without_fresh_conditions_the_rows_are_predicted_by_diagnoses_that_left_them_out():
    case = make_case("force_offset", models=PULL_ONLY, size={"offset": 0.12})
    few = {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")}
    found = diagnose(case, 1, effects=few).shrink["drawbar_pull"]
    mixed = mixture(campaigns(case), rank(campaigns(case), 1, effects=few), 1)
    truth_there = mixed.at(campaigns(case).view)
    before = {"drawbar_pull": truth_there.means["drawbar_pull"] - 0.12}
    seen = shrink(campaigns(case), truth_there, before, truth_there.means)["drawbar_pull"]
    # What is left is larger than on rows that were fitted, and still far below the gap.
    assert found.rmse_after > seen.rmse_after
    assert found.fraction > 0.5


def test_too_few_rows_to_leave_out_are_judged_by_their_own_prediction():
    case = make_case("force_offset", models=PULL_ONLY, size={"offset": 0.3}, n_field=6)
    few = {"force_offset": EFFECTS["force_offset"]}
    found = diagnose(case, 1, effects=few).shrink["drawbar_pull"]
    assert found.fraction > 0.5


def test_rows_where_the_simulator_has_no_value_are_left_out(data):
    known = truth(0.2, 0.01)
    before, holed = np.ones(N), np.ones(N)
    holed[3] = np.nan
    whole, found = (
        shrink(data, known, {"drawbar_pull": b}, known.means)["drawbar_pull"]
        for b in (before, holed)
    )
    # The rows of a draw are all off by the same, so that one row less changes nothing.
    assert found.fraction == pytest.approx(whole.fraction)
    assert found.rmse_before == pytest.approx(whole.rmse_before)
    nowhere = {"drawbar_pull": np.full(N, np.nan)}
    assert shrink(data, known, nowhere, known.means) == {}


def test_extrapolated_conditions_are_said():
    few = {"force_offset": EFFECTS["force_offset"]}
    case = make_case("force_offset", n_fresh=9, size={"offset": 0.3})
    columns = {name: np.array(v) for name, v in case.new_conditions.columns.items()}
    columns["inflation_pressure_psi"][0] = 420.0
    far = replace(case, new_conditions=table_from_arrays(columns))
    said = " ".join(diagnose(far, 1, effects=few).warnings)
    assert "beyond what either campaign covered in inflation_pressure_psi: 1 of 9 rows" in said


def test_a_folder_will_do_and_the_answer_is_short(tmp_path):
    case = make_case("force_offset", models=PULL_ONLY, size={"offset": 0.3}, n_fresh=3)
    folder = write_case(case, tmp_path / "offset")
    few = {"force_offset": EFFECTS["force_offset"]}
    found = diagnose(folder, 1, effects=few)
    assert re.fullmatch(r"Diagnosis\(offset: effect; force_offset [\d.]+, .+\)", repr(found))


def shrunk(weight, gap, before, after, noise=0.1, simulator=0.0):
    """Of draws that are each one gap at both of two rows, shape (draws,)."""
    name = "drawbar_pull"
    true = np.repeat(np.array(gap, dtype=float)[:, None], 2, axis=1)
    plain, sd = np.full_like(true, simulator), np.full_like(true, noise)
    draws = Truth({name: plain}, {name: true}, {name: sd}, {name: true}, np.array(weight))
    data = SimpleNamespace(outputs=(SimpleNamespace(name=name),))
    return shrink(data, draws, {name: np.full(2, before)}, {name: np.full(2, after)}).get(name)


def test_errors_and_fraction_are_those_of_weighted_draws():
    """Nine tenths of the weight on three draws; the others are the ends of the 90 %."""
    gap = np.array([0.5, 0.6, 1.0, 1.1, 1.5])
    found = shrunk([0.06, 0.27, 0.34, 0.27, 0.06], gap, before=0.2, after=1.05)
    before, after = np.abs(gap - 0.2), np.abs(gap - 1.05)
    assert found.rmse_before == pytest.approx(0.8)
    assert found.rmse_after == pytest.approx(0.05)
    fractions = sorted(1.0 - after / before)
    assert found.fraction == pytest.approx(1.0 - found.rmse_after / found.rmse_before)
    low, high = fractions[0], fractions[-1]
    assert found.interval[1] == pytest.approx(high)
    assert found.interval[0] < low
    assert found.noise_floor == pytest.approx(0.1)


def test_the_lower_end_is_set_farther_off_by_a_quarter_of_its_logarithm():
    gap = np.array([1.3, 1.2, 1.1])
    found = shrunk([0.06, 0.47, 0.47], gap, before=0.0, after=1.0)
    left = (gap - 1.0) / gap  # 0.231, 0.167 (the median: lower fractions come first) and 0.091
    assert found.interval[0] == pytest.approx(1.0 - left[1] * (left[0] / left[1]) ** 1.25)
    assert found.interval[1] == pytest.approx(1.0 - left[2])
    # Errors' medians are of the errors: 1.2 and 0.2.
    assert found.fraction == pytest.approx(1.0 - 0.2 / 1.2)
