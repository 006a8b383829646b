"""The corrected model and how far a gap shrinks."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from calib.cli.app import app
from calib.data import Table, table_from_arrays, write_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import read_case
from calib.gap.corrected import (
    Corrected,
    load_corrected,
    predict_columns,
    predict_new,
    save_corrected,
    shrink,
)
from calib.gap.diagnose import diagnose
from calib.gap.effects import EFFECTS
from calib.gap.effects.user import load_effects
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, by_parameters, joined, singles, with_case_effects
from calib.gap.mixture import Mixture, Truth, mixture
from calib.gap.noise import Noise
from calib.gap.predict import predict
from calib.gap.ranking import rank
from calib.inference.prior_files import DeclaredPriors, default_priors
from tests.gap.cases import LARGE, PULL_ONLY, campaigns_of, diagnosis_of, make_case, write_case
from tests.gap.test_load_effects import write

FEW = {name: EFFECTS[name] for name in ("force_offset", "rate_effect")}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnosis")
    case = make_case("force_offset")
    found = diagnose(replace(case, new_conditions=case.field), 1, effects=FEW)
    save_corrected(found.corrected, folder)
    return found, folder


def test_it_predicts_as_the_diagnosis_did(saved):
    found, folder = saved
    columns = predict_columns(load_corrected(folder), found.data.case.field)
    for name, prediction in found.new_predictions.items():
        column = {"drawbar_pull": "drawbar_pull_kn", "rut_depth": "rut_depth_mm"}[name]
        np.testing.assert_allclose(columns[f"{column}_before"], prediction.before, rtol=1e-9)
        np.testing.assert_allclose(columns[f"{column}_after"], prediction.after, rtol=1e-9)
        np.testing.assert_allclose(columns[f"{column}_after_lower"], prediction.lower, rtol=1e-9)


def test_a_damaged_one_is_refused(saved, tmp_path):
    _, folder = saved
    content = json.loads((folder / "corrected.json").read_text())
    content["fits"][0]["sample"] = [row[:-1] for row in content["fits"][0]["sample"]]
    (tmp_path / "corrected.json").write_text(json.dumps(content))
    (tmp_path / "case").symlink_to(folder / "case")
    with pytest.raises(CalibError, match="no readable corrected model"):
        load_corrected(tmp_path)


def test_a_model_that_has_changed_since_is_refused(saved, tmp_path):
    """As when the file of one's own effects, or its priors, is no longer what it was."""

    class Other(type(EFFECTS["force_offset"])):
        def on_output(self, phi, output, location, view):
            return location + 1.01 * (super().on_output(phi, output, location, view) - location)

    _, folder = saved
    with pytest.raises(CalibError, match="no longer predicts the drawbar_pull"):
        load_corrected(folder, {**FEW, "force_offset": Other()})


OPERATORS = ("Berg", "Lind", "Dahl")
SIGMA = {"drawbar_pull": 0.03, "rut_depth": 0.05}


def widened(table: Table) -> Table:
    """Return a table with two columns that a case declares."""
    n = len(table)
    more = {
        "operator": np.resize([0.0, 1.0, 2.0, 1.0], n), "tyre_age_weeks": np.linspace(8, 31, n),
    }  # fmt: skip
    return replace(table, columns={**table.columns, **more})


def fit_of(data, h: Hypothesis, lab_mode) -> Fit:
    forward = Forward(data, h, SIGMA, lab_mode)
    rng = np.random.default_rng(forward.n_dim)
    psi = np.array([p.loc for p in forward.priors.free])
    psi += 0.01 * rng.standard_normal(psi.size)
    noise = {o: Noise(s, 1.0, -0.8) for o, s in SIGMA.items()}
    return Fit(forward, noise, 0.0, {}, psi + 1e-3 * rng.standard_normal((5, psi.size)))


@pytest.fixture(scope="module")
def made() -> Corrected:
    """Every kind of hypothesis, of a case with priors, declared columns and fresh conditions."""
    case = make_case("force_offset", n_fresh=4)
    text = default_priors("modified_bekker").read_text(encoding="utf-8").replace("0.35", "0.36")
    case = replace(
        case, lab=widened(case.lab), field=widened(case.field),
        new_conditions=widened(case.new_conditions),
        covariates={"operator": OPERATORS, "tyre_age_weeks": ()},
        priors={"rut_depth": DeclaredPriors("mine.toml", text)},
    )  # fmt: skip
    data = campaigns(case)
    lab_mode = {o.name: np.array([p.loc for p in o.priors.free]) + 0.01 for o in data.outputs}
    pull = ("drawbar_pull",)
    few = singles(data, {n: EFFECTS[n] for n in ("sensor_drift", "rate_effect")})
    known = with_case_effects(data, EFFECTS)
    (ageing,) = singles(data, {n: known[n] for n in ("depends_on_tyre_age_weeks",)})
    hypotheses = [
        joined(*few, by_parameters(ageing)[-1]),
        Hypothesis("parameter_shift", shift=0.25, shift_as="soil"),
        Hypothesis("unknown", smooth=2.0, smooth_outputs=pull, smooth_over="slip",
                   smooth_decay=3.0),
        Hypothesis("unknown", smooth=4.0, smooth_outputs=pull, onset_over="low_pressure"),
    ]  # fmt: skip
    fits = [fit_of(data, h, lab_mode) for h in hypotheses]
    return Corrected(Mixture(data, tuple(fits), (0.4, 0.3, 0.2, 0.1), 7), lab_mode)


@pytest.fixture
def kept(made, tmp_path):
    save_corrected(made, tmp_path)
    return tmp_path


def test_everything_is_kept(made, kept):
    """To twelve digits of each number; the case as it was, whatever is declared in it."""
    again = load_corrected(kept)
    assert again.mixture.probability == made.mixture.probability
    assert again.mixture.seed == 7
    for name, mode in made.lab_mode.items():
        np.testing.assert_allclose(again.lab_mode[name], mode, rtol=1e-12)
    for was, now in zip(made.mixture.fits, again.mixture.fits, strict=True):
        h, found = was.forward.hypothesis, now.forward.hypothesis
        for part in ("name", "shift", "shift_as", "shift_over", "smooth", "smooth_outputs",
                     "smooth_over", "smooth_decay", "onset_over"):  # fmt: skip
            assert getattr(found, part) == getattr(h, part)
        assert [e.name for e in found.effects] == [e.name for e in h.effects]
        assert now.forward.priors.entries == was.forward.priors.entries
        assert now.noise == was.noise
        np.testing.assert_allclose(now.sample, was.sample, rtol=1e-11)
        assert (now.forward.shift is None) == (was.forward.shift is None)
        if was.forward.shift is not None:
            np.testing.assert_allclose(now.forward.shift.radius_error,
                                       was.forward.shift.radius_error)  # fmt: skip
    case, found = made.data.case, again.data.case
    assert dict(found.models) == dict(case.models)
    assert found.covariates == case.covariates
    assert {o: p.text for o, p in found.priors.items()} == {
        o: p.text for o, p in case.priors.items()
    }
    for was, now in ((case.lab, found.lab), (case.field, found.field),
                     (case.new_conditions, found.new_conditions)):  # fmt: skip
        assert set(now) == set(was)
        for column in was:
            np.testing.assert_allclose(now[column], was[column], rtol=1e-9)


def damaged(folder, change):
    path = folder / "corrected.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c["fits"][0].update(sample=[r[:-1] for r in c["fits"][0]["sample"]]),
        lambda c: c["fits"][1].pop("sample"),
        lambda c: c.update(schema="calib/corrected/5"),
        lambda c: c["fits"][2].pop("smooth_over"),
        lambda c: c["fits"][2].update(probability=None),
    ],
)
def test_whatever_is_damaged_is_noticed(kept, change):
    damaged(kept, change)
    with pytest.raises(CalibError, match="no readable corrected model"):
        load_corrected(kept)


@pytest.mark.parametrize(("moved", "refused"), [(0.9e-4, False), (1.2e-4, True), (-1.2e-4, True)])
@pytest.mark.parametrize("output", SIGMA)
def test_it_must_predict_as_when_it_was_saved(kept, output, moved, refused):
    """To a ten-thousandth of the noise, everywhere."""

    def change(content):
        content["fits"][3]["field"][output][5] += moved * SIGMA[output]

    damaged(kept, change)
    told = pytest.raises(CalibError, match=f"no longer predicts the {output}")
    with told if refused else nullcontext():
        load_corrected(kept)


def test_a_drift_is_predicted_as_at_the_end_of_the_campaign(made):
    field = made.data.case.field
    without = table_from_arrays({k: v for k, v in field.columns.items() if k in CONDITIONS})
    without = replace(widened(without), ignored=("operator", "tyre_age_weeks"))
    bare = replace(made.data.case, covariates={})
    corrected = Corrected(replace(made.mixture, data=campaigns(bare)), made.lab_mode)
    at = {
        order: predict_columns(corrected, replace(without, columns={
            **without.columns, **({} if order is None else {"run_order": np.full(27, order)}),
        }))
        for order in (None, 26.0, 3.0)
    }  # fmt: skip
    pull = {order: columns["drawbar_pull_kn_after"] for order, columns in at.items()}
    np.testing.assert_allclose(pull[None], pull[26.0], rtol=1e-12)
    assert not np.allclose(pull[None], pull[3.0])
    assert "run_order" not in at[None]


CONDITIONS = ("slip_ratio", "inflation_pressure_psi", "average_ground_pressure_kpa",
              "normal_load_kn", "speed_m_s", "pass_number")  # fmt: skip


def test_a_prediction_is_laid_out_by_output(made):
    """Columns as they are given, but for outputs, then each output's four columns."""
    case = made.data.case
    field = case.field
    words = tuple((OPERATORS[int(c)], f"{t!r}") for c, t in zip(
        field["operator"], field["tyre_age_weeks"].tolist(), strict=True))  # fmt: skip
    words = tuple((*row, "A", f"{100 * s!r}", "1.0")
                  for row, s in zip(words, field["slip_ratio"].tolist(), strict=True))  # fmt: skip
    header = ("operator", "tyre_age_weeks", "Site", "Slip [%]", "Drawbar pull [lbf]")
    typed = replace(field, header=header, text=words)
    found = predict_columns(made, typed)
    of_outputs = [
        f"{column}_{part}"
        for column in ("drawbar_pull_kn", "rut_depth_mm")
        for part in ("before", "after", "after_lower", "after_upper")
    ]
    assert list(found) == [*header[:-1], *of_outputs, "outside_calibrated_range"]
    assert found["operator"] == [row[0] for row in words]
    assert found["Site"] == ["A"] * len(field)
    assert found["Slip [%]"] == [row[3] for row in words]
    truth = made.mixture.at(made.data.at_conditions(field.columns))
    for o in made.data.outputs:
        column, bound = OUTPUTS[o.name], o.problem.bound
        theta = o.priors.to_natural(made.lab_mode[o.name][None])
        before = bound.predict(theta, bound.model.select(field.columns))[0]
        np.testing.assert_allclose(found[f"{column}_before"], before, rtol=1e-12)
        np.testing.assert_allclose(
            found[f"{column}_after"], truth.mean(truth.truth[o.name]), rtol=1e-12
        )
        for end, q in (("lower", 0.05), ("upper", 0.95)):
            np.testing.assert_allclose(
                found[f"{column}_after_{end}"], truth.quantile(truth.measured[o.name], q)
            )


def test_missing_covariates_are_named(saved):
    _, folder = saved
    few = table_from_arrays({"slip_ratio": np.array([0.1])})
    with pytest.raises(CalibError, match="the corrected model needs"):
        predict_columns(load_corrected(folder), few)


def test_conditions_beyond_both_campaigns_are_named(saved):
    found, folder = saved
    case, flags = found.data.case, "outside_calibrated_range"
    assert set(predict_columns(load_corrected(folder), case.field)[flags]) == {""}
    fast = {
        **case.field.columns,
        "speed_m_s": case.field["speed_m_s"] * np.array([30.0] + [1.0] * 26),
    }
    predicted = predict_columns(load_corrected(folder), table_from_arrays(fast))
    assert predicted[flags] == ["speed_m_s", *[""] * 26]
    assert list(predicted)[-1] == flags


def test_a_diagnosis_answers_with_the_doubt_about_its_cause(saved, tmp_path):
    found, folder = saved
    table = found.data.case.field
    predicted = predict(found, table)
    drawn = predicted.draws("drawbar_pull_kn")
    low, high = drawn.quantile([0.05, 0.95]).reading
    # Of 1200 draws, to the distance of one from the next.
    np.testing.assert_allclose(low, predicted.columns["drawbar_pull_kn_after_lower"], rtol=2e-3)
    np.testing.assert_allclose(high, predicted.columns["drawbar_pull_kn_after_upper"], rtol=2e-3)
    at_mean = drawn.probability(">", predicted.columns["drawbar_pull_kn_after"])
    # Nearly symmetric, so the mean is nearly the median.
    np.testing.assert_allclose(at_mean.mean.value, 0.5, atol=0.15)
    assert ((at_mean.mean.error > 0.005) & (at_mean.mean.error < 0.1)).all()
    # Draws of one weight have the mean of all, to their own scatter.
    few = drawn.draws(400).mean.values
    error = few.std(axis=0) / 20.0
    before = drawn.mean.weights.weight @ drawn.mean.values
    assert (np.abs(few.mean(axis=0) - before) < 5.0 * error).all()
    with pytest.raises(CalibError, match="no output torque"):
        predicted.draws("torque")
    write_table(tmp_path / "at.csv", dict(table.columns))
    asked = ["--exceeds", "drawbar_pull_n=900", "--quantiles", "0.5", "--json"]
    given = ["predict", str(folder), "--at", str(tmp_path / "at.csv"), *asked]
    told = json.loads(CliRunner().invoke(app, given).stdout)
    over = drawn.probability(">", 0.9)
    column = told["columns"]["drawbar_pull_n_mean_above_900"]
    np.testing.assert_allclose(column, over.mean.value, atol=1e-9)
    assert told["everywhere"][0]["mean"] == pytest.approx(float(over.mean_everywhere.value))
    setting = {name: values[:1] for name, values in table.columns.items()}
    ends = {name: np.repeat(values, 2) for name, values in setting.items()}
    write_table(tmp_path / "curve.csv", ends | {"slip_ratio": np.array([0.02, 0.6])})
    asked = ["--peak-over", "slip_ratio", "--json"]
    given = ["predict", str(folder), "--at", str(tmp_path / "curve.csv"), *asked]
    (peak,) = json.loads(CliRunner().invoke(app, given).stdout)["columns"][
        "drawbar_pull_kn_peak_median"
    ]
    slip = np.linspace(0.02, 0.6, 30)
    curve = {name: np.repeat(values, 30) for name, values in setting.items()}
    along = predict(found, curve | {"slip_ratio": slip}).draws("drawbar_pull_kn")
    assert peak == pytest.approx(float(along.quantile(0.5).mean.max()), rel=0.02)


def test_an_effect_of_ones_own_is_passed_to_predict(tmp_path, capsys):
    path = write(tmp_path)
    case = make_case("force_offset", models=PULL_ONLY, n_fresh=3)
    own = load_effects(path)
    (tmp_path / "found").mkdir()
    save_corrected(diagnose(case, 1, effects=own).corrected, tmp_path / "found")
    conditions = {k: v for k, v in case.field.columns.items() if k not in OUTPUTS.values()}
    write_table(tmp_path / "at.csv", {k: v for k, v in conditions.items() if k != "run_order"})
    given = ["predict", str(tmp_path / "found"), "--at", str(tmp_path / "at.csv")]
    refused = CliRunner().invoke(app, given)
    assert refused.exit_code == 2
    assert "--effects" in refused.stderr
    done = CliRunner().invoke(app, [*given, "--effects", str(path)])
    assert done.exit_code == 0
    assert "no run_order is given" in done.stderr
    header, *rows = done.stdout.splitlines()
    values = np.array([row.split(",")[:-1] for row in rows], float).T
    columns = dict(zip(header.split(",")[:-1], values, strict=True))
    change = columns["drawbar_pull_kn_after"] - columns["drawbar_pull_kn_before"]
    # The offset of the case, which the wind explains, to two noise sds of its mean and the lab's.
    np.testing.assert_allclose(change.mean(), LARGE["force_offset"]["offset"], atol=0.02)


def test_a_fault_that_was_mended_is_left_out(saved):
    found, folder = saved
    corrected, field = load_corrected(folder), found.data.case.field
    assert corrected.faults == ["force_offset"]
    with_it = predict_columns(corrected, field)
    mended = predict_columns(corrected, field, ["force_offset"])
    # The truth is the simulator again, to what the field taught it; the reading had the offset.
    change = with_it["drawbar_pull_kn_after"] - mended["drawbar_pull_kn_after"]
    np.testing.assert_allclose(change.mean(), LARGE["force_offset"]["offset"], atol=0.02)
    half = (mended["drawbar_pull_kn_after_upper"] - mended["drawbar_pull_kn_after_lower"]) / 2.0
    gap = np.abs(mended["drawbar_pull_kn_after"] - mended["drawbar_pull_kn_before"])
    assert (gap < half).all()
    np.testing.assert_allclose(mended["rut_depth_mm_after"], with_it["rut_depth_mm_after"])


def test_what_is_left_out_must_be_a_cause(saved, tmp_path):
    found, folder = saved
    with pytest.raises(CalibError, match="no cause offset to leave out") as refused:
        predict_columns(load_corrected(folder), found.data.case.field, ["offset"])
    assert "force_offset" in refused.value.expected
    conditions = dict(found.data.case.field.columns)
    write_table(tmp_path / "at.csv", conditions)
    given = ["predict", str(folder), "--at", str(tmp_path / "at.csv")]
    told = CliRunner().invoke(app, given)
    assert "predict --without force_offset" in told.stderr
    mended = CliRunner().invoke(app, [*given, "--without", "force_offset"])
    assert mended.exit_code == 0
    assert "what is predicted is the reading" not in mended.stderr
    assert mended.stdout != told.stdout


def test_the_case_that_is_kept_has_the_headers_and_units_of_the_files(made, tmp_path):
    """A diagnosis made again from it shows its numbers as the first did."""
    own = {"drawbar_pull_kn": "Drawbar pull [lbf] (checked)", "slip_ratio": "Slip (%)"}
    case = make_case("force_offset")
    tables = {
        part: replace(table, header=tuple(own.get(n, n) for n in table), text=())
        for part, table in (("lab", case.lab), ("field", case.field))
    }
    data = campaigns(replace(case, **tables))
    fit = fit_of(data, Hypothesis("none"), made.lab_mode)
    save_corrected(Corrected(Mixture(data, (fit,), (1.0,), 1), made.lab_mode), tmp_path)
    again = read_case(tmp_path / "case")
    for was, now in ((tables["lab"], again.lab), (tables["field"], again.field)):
        assert now.header == was.header
        assert now.column("drawbar_pull_kn").checked
        for column in was:
            np.testing.assert_allclose(now[column], was[column], rtol=1e-15)
    load_corrected(tmp_path)


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


@pytest.mark.slow
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
    assert re.fullmatch(r"<Diagnosis of offset: effect; force_offset [\d.]+, .+>", repr(found))
