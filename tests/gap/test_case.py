"""Cases: what is read, refused and recorded."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.batch.environment import sha256
from calib.data import Table, read_table, write_table
from calib.errors import CalibError
from calib.gap.batch import INPUTS, case_hashes, check_resumable, inputs_record, recorded_inputs
from calib.gap.campaigns import campaigns
from calib.gap.case import (
    Context,
    Size,
    case_files,
    case_from_run,
    declared_covariates,
    new_values,
    read_case,
    read_context,
    words_of,
)
from calib.gap.corrected import load_corrected, predict_columns, save_corrected
from calib.gap.diagnose import diagnose, diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.files import document
from calib.gap.hypotheses import Hypothesis, unusual_sizes, with_known_size
from calib.gap.odds import Odds
from calib.gap.same_soil import shift_if_same_soil
from calib.inference.calibration import calibrate
from calib.inference.io import save_calibration
from calib.inference.prior_files import DeclaredPriors, default_priors
from calib.inference.priors import Prior, Priors
from calib.inference.problem import build_problem
from calib.report.gap_words import gap_verdict
from tests.gap.cases import CHOICE, MODELS, PULL_ONLY, make_case, write_case


def test_a_written_case_is_read_back(tmp_path):
    case = make_case("force_offset", n_fresh=4)
    found = read_case(write_case(case, tmp_path / "a-case"))
    assert found.name == "a-case"
    assert dict(found.models) == MODELS
    assert found.new_conditions is not None
    assert len(found.new_conditions) == 4
    for name, values in case.field.columns.items():
        np.testing.assert_allclose(found.field[name], values, rtol=1e-12)


def test_the_file_of_a_case_is_not_its_folder(tmp_path):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    with pytest.raises(CalibError, match=f"give its folder: {re.escape(str(folder))}$"):
        read_case(folder / "case.toml")


def test_units_in_column_names_are_converted(tmp_path):
    folder = write_case(make_case(), tmp_path / "case")
    columns = dict(make_case().field.columns)
    columns["inflation_pressure_kpa"] = columns.pop("inflation_pressure_psi") * 6.894757293168361
    write_table(folder / "field.csv", columns)
    psi = read_case(folder).field["inflation_pressure_psi"]
    np.testing.assert_allclose(np.unique(psi.round(6)), [18.0, 30.0, 42.0])


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        (None, "cannot be read"),
        ("calibration = ", "not valid TOML"),
        ('calibration = "lab.csv"\nfield = "field.csv"\n', "models is missing"),
        ('field = "field.csv"\n[models]\nrut_depth = "bekker"\n', "calibration"),
        ('calibration = 3\nfield = "field.csv"\n[models]\nrut_depth = "bekker"\n', "calibration"),
        (
            'calibration = "lab.csv"\nfield = "field.csv"\nprdict = "fresh.csv"\n[models]\n'
            'rut_depth = "bekker"\n',
            "unknown key prdict\n  expected: calibration, field, predict, models, priors, "
            "covariates, context, simulations, answer_sha256\n"
            "  hint: did you mean predict?",
        ),
        (
            'calibration = "lab.csv"\nfield = "field.csv"\n[models]\nsinkage = "bekker"\n',
            "unknown output sinkage",
        ),
        (
            'calibration = "nowhere.csv"\nfield = "field.csv"\n[models]\nrut_depth = "bekker"\n',
            "nowhere.csv",
        ),
    ],
)
def test_what_is_wrong_with_a_case_is_named(tmp_path, toml, words):
    folder = write_case(make_case(), tmp_path / "case")
    (folder / "case.toml").unlink()
    if toml is not None:
        (folder / "case.toml").write_text(toml)
    with pytest.raises(CalibError) as caught:
        read_case(folder)
    assert words in str(caught.value)


@pytest.mark.parametrize("name", ["../outside.csv", "/etc/passwd", "a/../../outside.csv", "\0"])
@pytest.mark.parametrize("key", ["calibration", "field", "predict"])
def test_a_case_opens_no_file_but_its_own(tmp_path, key, name):
    folder = write_case(make_case("force_offset", n_fresh=4), tmp_path / "case")
    (tmp_path / "outside.csv").write_bytes((folder / "field.csv").read_bytes())
    toml = (folder / "case.toml").read_text()
    named = {"calibration": "lab.csv", "field": "field.csv", "predict": "fresh.csv"}[key]
    written = name.replace("\0", "\\u0000")
    (folder / "case.toml").write_text(toml.replace(f'"{named}"', f'"{written}"'))
    with pytest.raises(CalibError, match=f"{key} = .* is not a file of the case"):
        read_case(folder)
    assert key not in case_files(folder)[1]


def test_a_link_out_of_a_case_is_not_followed(tmp_path):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    (folder / "field.csv").rename(tmp_path / "field.csv")
    (folder / "field.csv").symlink_to(tmp_path / "field.csv")
    with pytest.raises(CalibError, match="not reached by a link out of it"):
        read_case(folder)


def narrow_priors(text: str) -> str:
    """The shipped priors, the peak pull a tenth as wide."""
    content = text.split("\n")
    return "\n".join(
        re.sub(r"sd_log = [0-9.]+", "sd_log = 0.02", line) if "sd_log" in line else line
        for line in content
    )


def test_a_case_may_bring_the_priors_of_its_simulators(tmp_path):
    """And they go with it, to where a corrected model is kept."""
    folder = write_case(make_case("force_offset", models=PULL_ONLY), tmp_path / "case")
    text = narrow_priors(default_priors(PULL_ONLY["drawbar_pull"]).read_text(encoding="utf-8"))
    left_out = "[parameters.sigma]"
    text = text[: text.index(left_out)]
    (folder / "mine.toml").write_text(text, encoding="utf-8")
    with (folder / "case.toml").open("a", encoding="utf-8") as file:
        file.write('\n[priors]\ndrawbar_pull = "mine.toml"\n[context]\nsame_soil = false\n')
    case = read_case(folder)
    assert case_files(folder)[1]["priors.drawbar_pull"] == folder / "mine.toml"
    (output,) = campaigns(case).outputs
    used = output.problem.priors.text
    assert used.startswith(text.rstrip())
    assert left_out in used
    found = diagnose_once(case, 1, effects={"force_offset": EFFECTS["force_offset"]})
    (tmp_path / "out").mkdir()
    save_corrected(found.corrected, tmp_path / "out")
    kept = load_corrected(tmp_path / "out").data
    assert kept.case.priors["drawbar_pull"].text == used
    assert kept.case.context == Context(same_soil=False)
    recorded = json.loads(inputs_record(case, 1))
    assert recorded["priors"] == case_hashes(folder)["priors"]


@pytest.mark.parametrize(
    ("priors", "said"),
    [
        ('drawbar_pull = "../mine.toml"', "not a file of the case"),
        ('drawbar_pull = "none.toml"', "cannot be read"),
        ('rut_depth = "mine.toml"', "it says"),
        ("drawbar_pull = 3", "drawbar_pull = 3 is not"),
    ],
)
def test_priors_that_are_not_there_are_refused(tmp_path, priors, said):
    folder = write_case(make_case(models=PULL_ONLY), tmp_path / "case")
    with (folder / "case.toml").open("a", encoding="utf-8") as file:
        file.write(f"\n[priors]\n{priors}\n")
    with pytest.raises(CalibError, match=said):
        read_case(folder)


def test_a_case_of_a_run_has_the_priors_of_the_run(tmp_path):
    made = make_case("force_offset", models=PULL_ONLY)
    model = PULL_ONLY["drawbar_pull"]
    text = narrow_priors(default_priors(model).read_text(encoding="utf-8"))
    problem = build_problem(model, made.lab, DeclaredPriors("mine.toml", text))
    run = tmp_path / "run"
    run.mkdir()
    save_calibration(calibrate(problem, 1), run)
    write_table(tmp_path / "field.csv", dict(made.field.columns))
    case = case_from_run(run, tmp_path / "field.csv")
    assert campaigns(case).outputs[0].problem.priors.text == text


def test_suspicion_multiplies_the_odds_of_every_explanation_with_the_cause():
    plain, given = Odds.of(10, Context()), Odds.of(10, Context(suspected={"lug_thrust": 0.5}))
    for name in ("lug_thrust", "lug_thrust+rate_effect", "lug_thrust+unknown"):
        gained = given.ln_prior(name) - plain.ln_prior(name)
        # From 0.036 to even odds.
        assert gained == pytest.approx(np.log((1.0 - 0.036) / 0.036))
    for name in ("none", "unknown", "rate_effect", "parameter_shift"):
        assert given.ln_prior(name) == plain.ln_prior(name)


@pytest.mark.parametrize(("same", "p"), [(True, 0.06), (False, 0.5)])
def test_the_soil_sets_how_probable_a_shift_is_unless_that_is_said(same, p):
    """As if it were suspected so; the usual probability of a shift is 0.12."""
    plain, given = Odds.of(10, Context()), Odds.of(10, Context(same_soil=same))
    ratio = (p / (1.0 - p)) / (0.12 / 0.88)
    for name in ("parameter_shift", "parameter_shift+unknown"):
        assert given.ln_prior(name) - plain.ln_prior(name) == pytest.approx(np.log(ratio))
    for name in ("none", "unknown", "rate_effect", "lug_thrust+rate_effect"):
        assert given.ln_prior(name) == plain.ln_prior(name)
    said = Context(same_soil=same, suspected={"parameter_shift": 0.3})
    assert said.suspected == {"parameter_shift": 0.3}
    soil = "the same soil" if same else "another soil"
    assert Context(same_soil=same).words() == [
        f"{soil} (prior probability of a parameter shift {p:g})"
    ]
    assert said.words() == [soil, "parameter shift suspected (0.3)"]


def test_shifts_are_weighed_anew_for_the_same_soil(fake_ranking):
    """Those of 0.1 sds count 3/2, for they are one of two sizes; those of 0.6 sds do not."""
    odds = (0.06 / 0.94) / (0.12 / 0.88)
    shift = 0.12 * 0.85 * odds * 1.5 * np.exp(-1.0)
    assert shift_if_same_soil(fake_ranking()) == pytest.approx(shift / (shift + 0.40))
    assert shift_if_same_soil(fake_ranking(same_soil=True)) is None
    assert shift_if_same_soil(fake_ranking(p=0.04)) is None


@pytest.fixture
def fake_ranking():
    def made(same_soil: bool | None = None, p: float = 0.3) -> Any:
        context = Context(same_soil=same_soil)
        data = SimpleNamespace(case=SimpleNamespace(context=context))
        fits = [SimpleNamespace(forward=SimpleNamespace(
            hypothesis=Hypothesis("", shift=s), data=data)) for s in (0.0, 0.1, 0.6)]  # fmt: skip
        return SimpleNamespace(
            fits={"none": fits[:1], "parameter_shift": fits[1:]},
            scores={"none": (0.0,), "parameter_shift": (-1.0, 2.0)},
            log_evidence={"none": 0.0, "parameter_shift": 2.05},
            probability={"none": 1.0 - p, "parameter_shift": p},
            odds=Odds(5, {}),
            gap=0.0,
        )

    return made


def test_an_excluded_cause_is_not_tested_and_both_verdicts_are_told():
    case = make_case("sensor_drift", models=PULL_ONLY)
    # Given as an argument it takes the place of the case's own.
    own = replace(case, context=Context(excluded=("nobody_knows",)))
    found = diagnose(own, 1, effects=CHOICE, context={"excluded": ["sensor_drift"]})
    assert "sensor_drift" not in found.inclusion.causes
    assert "excluded" in found.ranking.not_testable["sensor_drift"]
    assert found.without_context is not None
    assert found.without_context["sensor_drift"] > 0.5
    facts = dict(gap_verdict(found).facts)
    assert facts["Known beforehand"].startswith(
        "Sensor drift excluded. Without this: sensor drift ("
    )
    assert diagnose_once(case, 1, effects=CHOICE).without_context is None


def test_a_known_size_takes_the_place_of_the_prior():
    case = make_case("force_offset", models=PULL_ONLY)
    context = Context(sizes={"force_offset": {"offset": Size(mean=0.02, sd=0.001)}})
    found = diagnose_once(replace(case, context=context), 1, effects=CHOICE)
    priors = found.ranking.fits["force_offset"][0].forward.hypothesis.effect_priors[0]
    (offset,) = priors.free
    assert (offset.loc, offset.scale) == (0.02, 0.001)
    # The truth is far outside: no variant with a wider prior takes what was put in back.
    every = [f.forward.hypothesis for group in found.ranking.fits.values() for f in group]
    own = [p for h in every for e, p in zip(h.effects, h.effect_priors, strict=True)
           if e.name == "force_offset"]  # fmt: skip
    assert {p.free[0].scale for p in own} == {0.001}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("suspected = {lug_thrust = 1.5}", "less than 1"),
        ('suspected = {lug_thrust = "yes"}', "is not a number"),
        ('excluded = "sensor_drift"', "is not a list"),
        ("suspects = {}", "context.suspects"),
        (
            'suspected = {lug_thrust = 0.5}\nexcluded = ["lug_thrust"]',
            "both suspected and excluded",
        ),
        ("sizes = {force_offset = {offset = {mean = 1.0, sd = 0.0}}}", "greater than 0"),
        ("sizes = {force_offset = {offset = {mean = nan, sd = 1.0}}}", "finite number"),
        ("sizes = {force_offset = {offset = {mean = 1.0, sd = nan}}}", "finite number"),
        ("suspected = {lug_thrust = nan}", "finite number"),
        ('same_soil = "yes"', "context.same_soil"),
    ],
)
def test_what_is_wrong_with_a_context_is_named(tmp_path, table, words):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    toml = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(f"{toml}\n[context]\n{table}\n")
    with pytest.raises(CalibError, match=words):
        read_case(folder)


@pytest.mark.parametrize(
    "context",
    [
        Context(excluded=("nobody_knows",)),
        Context(excluded=("parameter_shift",)),
        Context(sizes={"force_offset": {"size": Size(mean=1.0, sd=1.0)}}),
    ],
)
def test_names_that_nobody_knows_are_refused(context):
    case = make_case("force_offset", models=PULL_ONLY)
    with pytest.raises(CalibError, match=r"no cause that is known|always considered|no parameter"):
        diagnose_once(replace(case, context=context), 1)


def test_what_is_wrong_in_an_argument_is_said_as_of_a_file():
    case = make_case("force_offset", models=PULL_ONLY)
    with pytest.raises(CalibError, match="unknown key exclude") as refused:
        diagnose(case, context={"exclude": ["sensor_drift"]})
    assert (refused.value.where, refused.value.hint) == (
        "calib.diagnose, context.exclude", "did you mean excluded?"
    )  # fmt: skip


def test_of_a_misspelt_cause_the_one_most_like_it_is_named():
    case = make_case("force_offset", models=PULL_ONLY)
    for name, hint in (
        ("sensr_drift", "did you mean sensor_drift"),
        ("parameter_shift", "same_soil = true"),
    ):
        with pytest.raises(CalibError, match=hint):
            diagnose_once(replace(case, context=Context(excluded=(name,))), 1)


def test_a_context_is_read_from_the_case(tmp_path):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    toml = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(
        f"{toml}\n[context]\nsame_soil = true\n"
        'suspected = {lug_thrust = 0.5, parameter_shift = 0.2}\nexcluded = ["sensor_drift"]\n'
    )
    context = read_case(folder).context
    suspected = {"lug_thrust": 0.5, "parameter_shift": 0.2}
    assert context == Context(same_soil=True, suspected=suspected, excluded=("sensor_drift",))
    assert context.words() == [
        "the same soil",
        "parameter shift suspected (0.2)",
        "lug thrust suspected (0.5)",
        "sensor drift excluded",
    ]
    assert read_context(None, "") == Context()


def digging(*, known) -> Hypothesis:
    """Lugs of a size that may have either sign, a scale that is positive, a digging held fixed."""
    entries = (
        Prior("thrust", "1", "why", "who", "", False, 0.1, 0.3, lower=-1.0),
        Prior("slip_scale", "1", "why", "who", "", True, -1.5, 0.4),
        Prior("digging", "1", "why", "who", "", False, 0.2, 0.0),
    )
    single = Hypothesis("lug_thrust", effect_priors=(Priors(entries, "text", "source"),))
    return with_known_size(single, Context(sizes={"lug_thrust": known}))


def known_lugs(**known: Size) -> tuple[Context, Hypothesis]:
    return Context(sizes={"lug_thrust": known}), digging(known={})


@pytest.mark.parametrize(
    ("name", "mean", "sd", "words"),
    [
        # 0.1 ± 0.3 is usual.
        ("thrust", 1.3, 0.001, ""),
        ("thrust", 1.4, 0.001, "thrust 1.4 ± 0.001, 4 sds from what is usual (-0.2 to 0.4)"),
        ("thrust", 1.4, 0.3, ""),
        ("thrust", 30.0, 5.0, "thrust 30 ± 5, 6 sds from what is usual"),
        # exp(-1.5 ± 0.4): a fraction that was given in percent.
        ("slip_scale", 0.22, 0.02, ""),
        ("slip_scale", 22.0, 2.0, "slip_scale 22 ± 2, 11 sds from what is usual (0.15 to 0.333)"),
    ],
)
def test_a_size_in_another_unit_is_told(name, mean, sd, words):
    context, single = known_lugs(**{name: Size(mean=mean, sd=sd)})
    said = unusual_sizes([single], context)
    assert len(said) == bool(words)
    assert words in "".join(said)
    assert unusual_sizes([], context) == []


def test_what_is_put_in_and_cannot_be_tested_is_said_to_change_nothing():
    case = make_case("force_offset", models=PULL_ONLY)
    context = Context(
        suspected={"rut_rebound": 0.9},
        sizes={"force_offset": {"offset": Size(mean=40.0, sd=5.0)}},
    )
    found = diagnose_once(replace(case, context=context), 1, effects=CHOICE)
    put_in = dict(gap_verdict(found).facts)["Known beforehand"]
    assert "offset 40 ± 5 kN" in put_in
    assert "rut rebound cannot be tested here (" in put_in
    assert any("force_offset is said to have offset 40 ± 5 kN" in note for note in found.warnings)


@pytest.mark.parametrize(("mean", "allowed"), [(-1.5, False), (-1.0, True), (7.0, True)])
def test_a_size_is_within_the_bounds_of_its_prior(mean, allowed):
    known = {"thrust": Size(mean=mean, sd=0.1)}
    if allowed:
        assert digging(known=known).effect_priors[0].entries[0].loc == mean
        return
    with pytest.raises(CalibError, match=r"thrust cannot be -1\.5") as refused:
        digging(known=known)
    assert refused.value.expected == "a mean from -1 to inf"


@pytest.mark.parametrize(
    ("part", "last", "beyond"),
    [
        ("mean", 1e15, 1e15 + 0.25), ("mean", -1e15, -1e15 - 0.25),
        ("sd", 1e15, 1e15 + 0.25), ("sd", 1.1e-15, 1e-15),
    ],
)  # fmt: skip
def test_a_size_is_a_number_that_can_be_squared(part, last, beyond):
    def written(value):
        size = {"mean": 1.0, "sd": 1.0, part: value}
        return {"sizes": {"force_offset": {"offset": size}}}

    context = read_context(written(last), "case.toml")
    assert getattr(context.sizes["force_offset"]["offset"], part) == last
    with pytest.raises(CalibError, match=f"offset.{part}"):
        read_context(written(beyond), "case.toml")


FEW = {name: EFFECTS[name] for name in ("force_offset", "sensor_drift", "slip_zero_shift")}
PULL = "drawbar_pull_kn"


def case_with(folder, name, lab, field, kind, gap=None):
    """Write a case with one more column; a relative change of the field's pull goes with it."""
    made = make_case(None, models=PULL_ONLY, n_field=36)
    pull = np.array(made.field[PULL]) * np.exp(np.zeros(36) if gap is None else gap)
    columns = {**made.field.columns, PULL: pull}
    write_case(replace(made, field=replace(made.field, columns=columns)), folder)
    for file, values in (("lab.csv", lab), ("field.csv", field)):
        with (folder / file).open(newline="") as read:
            rows = list(csv.reader(read))
        cells = [name, *values(len(rows) - 1)]
        with (folder / file).open("w", newline="") as write:
            csv.writer(write).writerows([*row, cell] for row, cell in zip(rows, cells, strict=True))
    if kind:
        with (folder / "case.toml").open("a") as file:
            file.write(f"\n[covariates]\n{name} = {kind}\n")
    return folder


def temperatures(n):
    return np.linspace(12.0, 31.0, n)[np.random.default_rng(3).permutation(n)]


def operators(n):
    return [("Lind", "Berg", "Dahl")[i % 3] for i in range(n)]


def saved(found, tmp_path):
    (tmp_path / "out").mkdir()
    save_corrected(found.corrected, tmp_path / "out")
    return load_corrected(tmp_path / "out", FEW)


def test_a_number_that_the_simulator_ignores_is_found(tmp_path):
    u = (temperatures(36) - 20.0) / 10.0
    folder = case_with(
        tmp_path / "case", "tyre_age_weeks", lambda n: np.full(n, 20.0), temperatures,
        '"number"', 0.35 * u,
    )  # fmt: skip
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert found.inclusion.causes["depends_on_tyre_age_weeks"].probability > 0.9
    assert found.ranking.order[0] == "depends_on_tyre_age_weeks"
    regions = document(found)["regions"]
    stretches = [r["conditions"].get("tyre_age_weeks") for r in regions]
    # Warm tyres pull more than simulated; stretches are known to one of eight groups.
    assert any(s and 20.0 < s[0] < s[1] and s[1] > 28.0 for s in stretches)
    again = saved(found, tmp_path)
    assert again.data.case.covariates == {"tyre_age_weeks": ()}
    at = predict_columns(again, read_table(folder / "field.csv"))
    before, after = at[f"{PULL}_before"], at[f"{PULL}_after"]
    warm = temperatures(36) > 27.0
    assert (after[warm] > before[warm]).all()


@pytest.mark.parametrize(
    ("stem", "column", "usual", "low", "high"),
    [
        ("camber_angle", "camber_angle_deg", 0.0, -5.0, 10.0),
        ("steering_angle", "slip_angle_rad", 0.0, -0.1, 0.2),
        ("tyre_temperature", "tread_temperature_c", 20.0, 12.0, 60.0),
        ("gravity", "gravity_m_s2", 9.81, 1.6, 9.81),
        ("tyre_diameter", "wheel_diameter_m", 0.8, 0.4, 1.2),
    ],
)  # fmt: skip
def test_a_recorded_condition_of_the_wheel_is_a_cause_without_being_declared(
    tmp_path, stem, column, usual, low, high
):
    values = np.linspace(low, high, 36)[np.random.default_rng(3).permutation(36)]
    scaled = 2.0 * (values - usual) / (high - low)
    folder = case_with(
        tmp_path / "case", column, lambda n: np.full(n, usual), lambda n: values[:n], "",
        0.3 * scaled,
    )  # fmt: skip
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert found.inclusion.causes[f"depends_on_{stem}"].probability > 0.9


def test_a_category_is_found_and_kept_by_its_names(tmp_path):
    gap = 0.5 * np.array([name == "Dahl" for name in operators(36)])
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"', gap)
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert found.data.case.covariates == {"operator": ("Berg", "Dahl", "Lind")}
    assert found.inclusion.causes["depends_on_operator"].probability > 0.9
    (effect,) = found.ranking.best("depends_on_operator").forward.hypothesis.effects
    assert set(effect.parameters) >= {"pull_factor_Dahl", "pull_offset_Dahl"}
    assert words_of(found.data.case.covariates, "operator", 1.0, 1.0) == "Dahl"
    assert words_of(found.data.case.covariates, "operator", 1.0, 2.0) == "Dahl, Lind"
    region, *others = document(found)["regions"]
    assert region["conditions"] == {"operator": ["Dahl"]}
    assert not any("operator" in r["conditions"] for r in others)
    recorded = json.loads(inputs_record(found.data.case, 1))
    assert recorded["covariates"] == case_hashes(folder)["covariates"] == {"operator": "category"}
    again = saved(found, tmp_path)
    at = predict_columns(again, read_table(folder / "field.csv"))
    assert at["operator"] == operators(36)
    ratio = at[f"{PULL}_after"] / at[f"{PULL}_before"]
    slips = again.data.view.slip() > 0.2
    dahl = np.array([name == "Dahl" for name in operators(36)])
    assert np.median(ratio[dahl & slips]) > 1.2 * np.median(ratio[~dahl & slips])


def test_what_nothing_goes_with_is_not_named(tmp_path):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert found.inclusion.causes["depends_on_operator"].probability < 0.2
    assert found.verdict == "none"


def test_a_category_that_differs_between_the_campaigns_only_cannot_be_separated(tmp_path):
    folder = case_with(
        tmp_path / "case", "site", lambda n: ["barn"] * n, lambda n: ["field"] * n, '"category"',
        np.full(36, 0.4),
    )  # fmt: skip
    found = diagnose_once(read_case(folder), 1, effects=FEW)
    assert any("site: its condition is one value" in w for w in found.warnings) or any(
        "depends_on_site" in w and "cannot be separated" in w for w in found.warnings
    )


def test_values_of_the_field_alone_are_named(tmp_path):
    folder = case_with(
        tmp_path / "case", "operator", lambda n: ["Berg", "Lind"] * (n // 2) + ["Lind"] * (n % 2),
        operators, '"category"',
    )  # fmt: skip
    case = read_case(folder)
    (said,) = new_values(case.covariates, case.lab, case.field)
    assert said.startswith("operator: Dahl in the field only")


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        ("operator", '"word"', '"number", "category"'),
        ("operator", '"number"', "operator is 'Lind'"),
        ("operator", '["Lind", "Berg"]', "operator is 'Dahl'"),
        ("speed_m_s", '"number"', "a quantity that is known"),
    ],
)
def test_what_is_declared_wrongly_is_refused(tmp_path, name, kind, said):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text.replace('operator = "category"', f"{name} = {kind}"))
    with pytest.raises(CalibError, match=said):
        read_case(folder)


def typed(**columns) -> Table:
    """Return a table of cells as they were typed, which the reader did not know."""
    header, text = tuple(columns), tuple(zip(*columns.values(), strict=True))
    return Table({}, "made.csv", np.arange(len(text)) + 2, header, text, "", ignored=header)


@pytest.mark.parametrize(("n", "refused"), [(1, True), (2, False), (12, False), (13, True)])
def test_a_category_has_from_two_to_twelve_values(n, refused):
    words = [f"w{i:02d}" for i in range(n)]
    tables = (typed(operator=words), typed(operator=[" w00 "]))
    if refused:
        with pytest.raises(CalibError, match=f"operator has {n} different values"):
            declared_covariates({"operator": "category"}, tables)
        with pytest.raises(CalibError, match=f"operator has {n} different values"):
            declared_covariates({"operator": words}, tables)
    else:
        assert declared_covariates({"operator": "category"}, tables) == {"operator": tuple(words)}
        given = words[::-1]
        assert declared_covariates({"operator": given}, tables) == {"operator": tuple(given)}


@pytest.mark.parametrize("name", ["speed_m_s", "speed_km_h", "speed_furlongs"])
def test_a_known_quantity_is_declared_by_its_name_alone(name):
    """In whatever unit, even one that nobody knows."""
    with pytest.raises(CalibError, match=f"{name} is a quantity that is known"):
        declared_covariates({name: "number"}, (typed(**{name: ["1"]}),))


def test_a_column_that_is_not_there_is_refused(tmp_path):
    folder = case_with(tmp_path / "case", "operator", operators, operators, '"category"')
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text.replace("operator =", "driver ="))
    with pytest.raises(CalibError, match="there is no column 'driver'"):
        read_case(folder)


@pytest.fixture
def diagnosed(tmp_path) -> tuple[Path, Path]:
    """Return a case folder, and a folder of results with its record."""
    made = make_case(models=PULL_ONLY, n_lab=15, n_field=12, n_fresh=3)
    case = write_case(made, tmp_path / "cases" / "case-0")
    (tmp_path / "out" / "case-0").mkdir(parents=True)
    (tmp_path / "out" / "case-0" / INPUTS).write_bytes(inputs_record(read_case(case), 1))
    return case, tmp_path / "out"


def test_the_record_of_a_case_is_what_its_folder_holds(diagnosed):
    case, out = diagnosed
    said = recorded_inputs(out / "case-0")
    assert said is not None
    kept = ("models", "sha256", "context", "priors", "covariates")
    assert {key: said.get(key) for key in kept} == case_hashes(case)
    assert set(said["sha256"]) == {"calibration", "field", "predict"}
    check_resumable([case], out, 1)


def test_a_changed_file_another_seed_or_version_are_refused(diagnosed):
    case, out = diagnosed
    with pytest.raises(CalibError, match="--seed 1, not 2"):
        check_resumable([case], out, 2)
    record = out / "case-0" / INPUTS
    said = json.loads(record.read_text())
    record.write_text(json.dumps(said | {"version": "0.0.0"}))
    with pytest.raises(CalibError, match=r"made by version 0\.0\.0"):
        check_resumable([case], out, 1)
    record.write_text(json.dumps(said | {"code_sha256": "0" * 64}))
    with pytest.raises(
        CalibError, match=re.escape(f"other code or priors of version {said['version']}")
    ):
        check_resumable([case], out, 1)
    with (case / "field.csv").open("a") as file:
        file.write("\n")
    with pytest.raises(CalibError, match="of other cases, or of these before") as caught:
        check_resumable([case], out, 1)
    assert "case-0" in str(caught.value)
    assert caught.value.hint is not None


@pytest.mark.parametrize("text", [None, "{", "[]"])
def test_results_that_do_not_say_what_they_are_of_are_not_resumed(diagnosed, text):
    case, out = diagnosed
    (out / "case-0" / INPUTS).unlink()
    if text is not None:
        (out / "case-0" / INPUTS).write_text(text)
    with pytest.raises(CalibError, match="do not say which cases"):
        check_resumable([case], out, 1)


def test_effects_of_ones_own_are_recorded_and_not_resumed_without_them(diagnosed):
    case, out = diagnosed
    files = {"mine.py": b"class Wind: ...", "wind.toml": b'model = "wind"'}
    record = inputs_record(read_case(case), 1, files)
    assert json.loads(record)["effects"] == {name: sha256(text) for name, text in files.items()}
    (out / "case-0" / INPUTS).write_bytes(record)
    with pytest.raises(CalibError, match="made with effects of one's own"):
        check_resumable([case], out, 1)


def test_a_known_size_that_the_data_rule_out_stays_what_is_known():
    """The guess, drawn to the readings, lies where the priors of the simulator have an end."""
    context = Context(sizes={"force_offset": {"offset": Size(mean=20.0, sd=0.01)}})
    case = replace(make_case(None, models=PULL_ONLY), context=context)
    ranking = diagnose_once(case, 1, effects=CHOICE).ranking
    (found,) = ranking.fits["force_offset"]
    assert np.isfinite(found.log_evidence)
    assert ranking.probability["force_offset"] < 1e-6
    assert found.psi[found.forward.phi_slices[0]] == pytest.approx(20.0, abs=0.05)
