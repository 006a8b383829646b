"""Priors against scipy's distributions, and every mistake in a prior file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from calib.batch.user_code import run_file
from calib.errors import CalibError
from calib.he2019.embedded import load_he2019
from calib.inference import prior_files
from calib.inference.prior_files import (
    default_priors,
    inheritance_note,
    parse_priors,
    read_priors,
    relative_columns,
)
from calib.inference.priors import Priors, prior_references
from calib.inference.problem import Problem, build_problem
from calib.models import MODELS

ENTRY = '[parameters.{name}]\nunit = "1"\nreason = "a test"\nsource = "nobody"\n'
# Of single parameters; how parameters move together is of another form (tests/gap/test_forward.py).
PRIOR_FILES = sorted(
    p
    for p in Path(__file__).resolve().parents[2].joinpath("priors").rglob("*.toml")
    if p.parent.name != "shifts"
)


def one(body: str, references: dict[str, float] | None = None, name: str = "x") -> Priors:
    text = f'model = "m"\n{ENTRY.format(name=name)}{body}'
    return parse_priors(text, "my.toml", "m", (name,), references or {})


# TOML, and the same distribution by scipy, in internal coordinates (the log for a log-normal).
CASES: dict[str, tuple[str, stats.rv_continuous]] = {
    "normal": ('dist = "normal"\nmean = 1.5\nsd = 0.4', stats.norm(1.5, 0.4)),
    "normal, both sides cut": (
        'dist = "normal"\nmean = 1.5\nsd = 0.4\nlower = 1.0\nupper = 1.6',
        stats.truncnorm(-0.5 / 0.4, 0.1 / 0.4, 1.5, 0.4),
    ),
    "normal, lower tail alone": (
        'dist = "normal"\nmean = 0.0\nsd = 1.0\nupper = -9.5',
        stats.truncnorm(-np.inf, -9.5, 0.0, 1.0),
    ),
    "normal, cut 45 sds above": (
        'dist = "normal"\nmean = 0.0\nsd = 1.0\nlower = 45.0',
        stats.truncnorm(45.0, np.inf, 0.0, 1.0),
    ),
    "normal, between bounds 50 and 60 sds below": (
        'dist = "normal"\nmean = 1.0\nsd = 0.1\nlower = -5.0\nupper = -4.0',
        stats.truncnorm(-60.0, -50.0, 1.0, 0.1),
    ),
    "normal, between near bounds 1,000 sds above": (
        'dist = "normal"\nmean = 0.0\nsd = 1.0\nlower = 1000.0\nupper = 1000.001',
        stats.truncnorm(1000.0, 1000.001, 0.0, 1.0),
    ),
    "lognormal": ('dist = "lognormal"\nmedian = 4.0\nsd_log = 0.7', stats.norm(np.log(4), 0.7)),
    "lognormal, cut": (
        'dist = "lognormal"\nmedian = 4.0\nsd_log = 0.7\nlower = 2.0\nupper = 5.0',
        stats.truncnorm(np.log(0.5) / 0.7, np.log(1.25) / 0.7, np.log(4), 0.7),
    ),
    "half normal": ('dist = "half_normal"\nsd = 0.3', stats.halfnorm(0.0, 0.3)),
    "uniform": ('dist = "uniform"\nlower = -2.0\nupper = 3.0', stats.uniform(-2.0, 5.0)),
}
BY_CASE = pytest.mark.parametrize(("body", "expected"), CASES.values(), ids=CASES)


@BY_CASE
def test_density_quantiles_and_draws_are_scipys(body: str, expected) -> None:
    priors = one(body)
    u = np.array([0.001, 0.1, 0.5, 0.9, 0.999])
    t = expected.ppf(u)
    np.testing.assert_allclose(priors.log_prob(t[:, None]), expected.logpdf(t), rtol=1e-8)
    np.testing.assert_allclose(priors.ppf(u[:, None])[:, 0], t, rtol=1e-8, atol=1e-12)
    drawn = priors.sample(np.random.default_rng(5), 4000)[:, 0]
    # At a fixed seed this either holds or not; p would be below 1e-4 by chance in 1 of 1e4 seeds.
    assert stats.kstest(drawn, expected.cdf).pvalue > 1e-4


@pytest.mark.parametrize(
    "body",
    [
        'dist = "normal"\nmean = 0.0\nsd = 1e-9\nlower = 1.0',
        'dist = "lognormal"\nmedian = 1.0\nsd_log = 2e-6\nupper = 1e-3',
        'dist = "half_normal"\nsd = 1e-9\nlower = 1.0',
    ],
)
def test_bounds_beyond_all_probability_are_refused(body: str) -> None:
    with pytest.raises(CalibError) as caught:
        one(body)
    assert "my.toml, parameters.x" in str(caught.value)


@BY_CASE
def test_no_draw_leaves_the_bounds_and_nothing_lies_outside(body: str, expected) -> None:
    priors = one(body)
    (prior,) = priors.free
    corners = np.array([[0.0], [5e-324], [1.0 - 1e-16], [1.0]])
    drawn = np.concatenate([priors.ppf(corners), priors.sample(np.random.default_rng(6), 2000)])
    assert np.all(drawn >= prior.lower)
    assert np.all(drawn <= prior.upper)
    finite = [b + s for b, s in ((prior.lower, -1e-6), (prior.upper, 1e-6)) if np.isfinite(b)]
    assert np.all(priors.log_prob(np.array(finite)[:, None]) == -np.inf)


def test_a_joint_density_is_the_sum_over_parameters() -> None:
    bodies = {"a": CASES["normal, both sides cut"], "b": CASES["lognormal"], "c": CASES["uniform"]}
    text = 'model = "m"\n' + "\n".join(ENTRY.format(name=n) + b for n, (b, _) in bodies.items())
    priors = parse_priors(text, "my.toml", "m", tuple(bodies), {})
    t = priors.sample(np.random.default_rng(1), 50)
    expected = sum(e.logpdf(t[:, j]) for j, (_, e) in enumerate(bodies.values()))
    np.testing.assert_allclose(priors.log_prob(t), expected, rtol=1e-10)
    outside = t.copy()
    outside[:, 2] = 3.5
    assert np.all(priors.log_prob(outside) == -np.inf)


def mixed() -> Priors:
    text = 'model = "m"\n' + "\n".join(
        ENTRY.format(name=n) + body
        for n, body in {
            "a": 'dist = "lognormal"\nmedian = 4.0\nsd_log = 0.7',
            "b": 'dist = "fixed"\nvalue = -3.0',
            "c": 'dist = "uniform"\nlower = 0.0\nupper = 1.0',
        }.items()
    )
    return parse_priors(text, "my.toml", "m", ("a", "b", "c"), {})


def test_fixed_parameters_are_carried_but_not_sampled() -> None:
    priors = mixed()
    assert priors.names == ("a", "c")
    natural = priors.to_natural(np.array([[np.log(2.0), 0.25]]))
    np.testing.assert_allclose(natural, [[2.0, -3.0, 0.25]])
    np.testing.assert_allclose(priors.to_internal(natural), [[np.log(2.0), 0.25]])


def test_internal_coordinates_are_pulled_inside_the_bounds() -> None:
    t = mixed().to_internal(np.array([[-1.0, -3.0, 7.0]]))
    assert np.isfinite(mixed().log_prob(t)).all()
    assert t[0, 1] == pytest.approx(1.0, abs=1e-8)


def test_fixing_a_parameter_removes_it_and_keeps_the_others() -> None:
    held = mixed().fix({"a": 5.0})
    assert held.names == ("c",)
    np.testing.assert_allclose(held.to_natural(np.array([[0.5]])), [[5.0, -3.0, 0.5]])
    with pytest.raises(CalibError, match="cannot fix z") as caught:
        mixed().fix({"z": 1.0})
    assert "a, b, c" in str(caught.value)


@pytest.mark.parametrize(
    ("body", "t"),
    [
        ('dist = "normal"\nmean = 0.2\nsd = 0.1\nlower = 0.1\nupper = 0.4', [0.4, 1.2, 2.0]),
        ('dist = "uniform"\nlower = 0.1\nupper = 0.4', [0.4, 1.0, 1.6]),
        ('dist = "half_normal"\nsd = 0.1', [0.01, 0.4, 2.0]),
    ],
)
def test_relative_priors_scale_with_the_load(body: str, t: list[float]) -> None:
    relative = one(f'{body}\nrelative_to = "normal_load_kn"', {"normal_load_kn": 4.0})
    plain = one(body)
    scaled = np.array(t)[:, None]
    np.testing.assert_allclose(
        relative.log_prob(scaled), plain.log_prob(scaled / 4.0) - np.log(4.0), rtol=1e-9
    )


def test_relative_log_normals_shift_and_fall_back_on_the_default() -> None:
    body = (
        'dist = "lognormal"\nmedian = 0.2\nsd_log = 0.5\nlower = 0.1\n'
        'relative_to = "normal_load_kn"\ndefault_reference = 5.0'
    )
    for references, load in (({"normal_load_kn": 2.0}, 2.0), ({}, 5.0)):
        (prior,) = one(body, references).entries
        assert prior.loc == pytest.approx(np.log(0.2 * load))
        assert prior.lower == pytest.approx(np.log(0.1 * load))
        assert prior.scale == 0.5
        assert f"x {load:g} (normal_load_kn)" in prior.text


# Mistakes


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(CalibError) as caught:
        call()
    message = str(caught.value)
    assert "hint:" in message
    return message


NUMBERS = {
    "normal": ("mean", "sd", "lower", "upper"),
    "lognormal": ("median", "sd_log", "lower", "upper"),
    "half_normal": ("sd",),
    "uniform": ("lower", "upper"),
    "gamma": ("shape", "rate", "lower", "upper"),
    "fixed": ("value",),
}


@pytest.mark.parametrize(
    ("dist", "key"),
    [(dist, key) for dist, keys in NUMBERS.items() for key in (*keys, "default_reference")],
)
def test_a_text_is_no_number(dist: str, key: str) -> None:
    given = {**dict.fromkeys(NUMBERS[dist], "0.5"), key: '"0.75"'}
    body = "\n".join(f"{name} = {text}" for name, text in given.items())
    message = refusal(lambda: one(f'dist = "{dist}"\n{body}'))
    assert f"my.toml, parameters.x: {key} = " in message
    assert f"expected: a number, as in {key} = 0.75" in message


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('dist = "normal"\nmean = 0.0\nsd = 0.0', ["normal.sd", "greater than 0", "0.0"]),
        ('dist = "lognormal"\nmedian = 1.0\nsd_log = 1e300', ["sd_log", "equal to 20", "1e+300"]),
        ('dist = "normal"\nmean = 1e300\nsd = 1', ["mean", "less than or equal to"]),
        (
            'dist = "half_normal"\nsd = 1\nrelative_to = "weight"',
            ["relative_to names no known column: 'weight'", "normal_load_kn"],
        ),
        ('dist = "lognormal"\nmedian = -1.0\nsd_log = 1', ["median", "greater than 0"]),
        ('dist = "normal"\nmean = nan\nsd = 1.0', ["mean", "finite", "nan"]),
        ('dist = "normal"\nmean = 0.0\nsd = inf', ["sd", "finite", "inf"]),
        ('dist = "normal"\nmean = "wide"\nsd = 1.0', ["mean", "number", "wide"]),
        ('dist = "normal"\nmean = 0.0', ["normal.sd", "sd is missing"]),
        ('dist = "normal"\nmean = 0.0\nsd = 1.0\nsigma = 2', ["no key 'sigma'"]),
        ('dist = "normal"\nmean = {a = 1}\nsd = 1.0', ["mean = {'a': 1} is not a number"]),
        ('dist = "nromal"\nmean = 0.0', ["no distribution 'nromal'", "did you mean normal"]),
        ("mean = 0.0\nsd = 1.0", ["parameters.x", "dist"]),
    ],
)  # fmt: skip
def test_an_impossible_entry_names_its_place(body: str, words: list[str]) -> None:
    message = refusal(lambda: one(body))
    for word in ["my.toml", "parameters.x", "expected:", *words]:
        assert word in message
    assert not set(PYDANTIC) & set(message.split())


PYDANTIC = ("Input", "Field", "String", "dictionary", "valid")


@pytest.mark.parametrize(("table", "words"), [
    ("[parameters]\nx = 0.5", "x = 0.5 is not a table"),
    ("[likelihood]\nfamily = 7", "family = 7 is not 'normal' or 'student_t'"),
])  # fmt: skip
def test_what_is_no_table_or_no_text_is_told_in_plain_words(table: str, words: str) -> None:
    text = f'model = "m"\n{table}\n'
    message = refusal(
        lambda: parse_priors(text, "my.toml", "m", ("x",) if "x" in table else ("sigma",), {})
    )
    assert words in message
    assert not set(PYDANTIC) & set(message.split())


@pytest.mark.parametrize(
    "body",
    [
        'dist = "uniform"\nlower = 3.0\nupper = 1.0',
        'dist = "normal"\nmean = 0.0\nsd = 1.0\nlower = 3.0\nupper = 1.0',
    ],
)
def test_swapped_bounds_are_told(body: str) -> None:
    message = refusal(lambda: one(body))
    assert "my.toml, parameters.x: lower bound 3 is not below upper bound" in message


@pytest.mark.parametrize("part", ["reason", "source", "unit"])
def test_a_prior_without_a_justification_is_refused(part: str) -> None:
    entry = "\n".join(
        line for line in ENTRY.format(name="x").splitlines() if not line.startswith(part)
    )
    text = f'model = "m"\n{entry}\ndist = "half_normal"\nsd = 1.0'
    message = refusal(lambda: parse_priors(text, "my.toml", "m", ("x",), {}))
    assert f"half_normal.{part}" in message
    assert f"{part} is missing" in message


def test_unknown_and_missing_parameters_come_in_one_message() -> None:
    text = f'model = "m"\n{ENTRY.format(name="kk")}dist = "half_normal"\nsd = 1.0'
    message = refusal(lambda: parse_priors(text, "my.toml", "m", ("k", "sigma"), {}))
    for word in ("my.toml, [parameters]", "unknown parameter kk", "missing parameter k, sigma",
                 "expected: k, sigma"):  # fmt: skip
        assert word in message


@pytest.mark.parametrize("text", ['model = "other"\n', "", "parameters = 3\n"])
def test_priors_of_another_model_are_refused(text: str) -> None:
    message = refusal(lambda: parse_priors(text, "my.toml", "m", ("x",), {}))
    assert "not 'm'" in message
    assert 'expected: model = "m"' in message


def test_bad_toml_names_the_line() -> None:
    message = refusal(lambda: parse_priors('model = "m"\nx = = 3\n', "my.toml", "m", ("x",), {}))
    assert "my.toml: the prior file is not valid TOML" in message
    assert "line 2" in message


def test_unreadable_files_are_told(tmp_path: Path) -> None:
    latin = tmp_path / "latin.toml"
    latin.write_bytes(b'model = "\xe9"\n')
    for path in (tmp_path / "absent.toml", tmp_path, latin):
        message = refusal(lambda p=path: read_priors(p, "m", ("x",), {}))
        assert f"{path}: the prior file cannot be read" in message


# What a file leaves out


N_ALONE = 'model = "bekker"\n\n[parameters.n]  # ours\n' + (
    'dist = "normal"\nmean = 1.0\nsd = 0.1\nunit = "1"\nreason = "plates"\nsource = "own"\n'
)


def bekker(tmp_path: Path, text: str) -> Problem:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return build_problem("bekker", load_he2019("rut_depth"), path)


def test_what_a_file_leaves_out_is_as_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = bekker(tmp_path, N_ALONE)
    z_ref, n, sigma = problem.priors.entries
    shipped = build_problem("bekker", load_he2019("rut_depth")).priors.entries
    assert (z_ref, sigma) == (shipped[0], shipped[2])
    assert (n.loc, n.scale, n.source) == (1.0, 0.1, "own")
    assert problem.notes == (
        "mine.toml sets the prior of n; those of z_ref, sigma are the shipped ones",
    )
    # What is kept is the whole set, whatever will be shipped later.
    kept = problem.priors.text
    assert kept.startswith(N_ALONE)
    monkeypatch.setattr(prior_files, "_shipped", lambda: tmp_path)
    again = bekker(tmp_path, kept)
    assert again.priors.entries == problem.priors.entries
    assert again.notes == problem.notes


def test_a_file_may_choose_the_noise_alone(tmp_path: Path) -> None:
    problem = bekker(tmp_path, 'model = "bekker"\n[likelihood]\nfamily = "student_t"')
    assert problem.names == ("z_ref", "n", "nu", "sigma")
    assert problem.notes == ("mine.toml sets no prior; all are the shipped ones",)


def test_a_misspelt_parameter_is_none_that_is_left_out(tmp_path: Path) -> None:
    message = refusal(lambda: bekker(tmp_path, N_ALONE.replace("s.n]", "s.zref]")))
    assert "mine.toml, [parameters]: unknown parameter zref\n" in message
    assert "zref: did you mean z_ref? correct the name" in message


def test_an_inline_table_is_not_completed(tmp_path: Path) -> None:
    text = 'model = "bekker"\nparameters = {n = {dist = "fixed", value = 1.0}}'
    message = refusal(lambda: bekker(tmp_path, text))
    assert "missing parameter z_ref, sigma" in message
    assert "each as a table [parameters.NAME]" in message


def test_what_a_file_leaves_out_is_as_the_model_declares_it(tmp_path: Path) -> None:
    path, mine = tmp_path / "model.py", tmp_path / "mine.toml"
    path.write_text(DECLARED.replace("gaussian", "normal"))
    mine.write_text(
        N_ALONE.replace("bekker", "flat_pull").replace("s.n]", "s.a]").replace('"1"', '"kN"')
    )
    try:
        run_file(path, "models")
        read = read_priors(mine, "flat_pull", ("a", "sigma"), {})
        assert [p.source for p in read.entries] == ["own", "nobody"]
        assert inheritance_note(read, "flat_pull").endswith("those of sigma are the model's own")
    finally:
        MODELS.discard("flat_pull")


# What is shipped


@pytest.mark.parametrize("path", PRIOR_FILES, ids=lambda p: p.stem)
def test_shipped_priors_parse_with_reasons_and_sources(path: Path) -> None:
    import tomllib

    content = tomllib.loads(path.read_text(encoding="utf-8"))
    assert content["model"] == path.stem
    names = tuple(content["parameters"])
    priors = read_priors(path, path.stem, names, {})
    for entry in priors.entries:
        assert len(entry.reason) > 5
        assert len(entry.source) > 5
        assert entry.unit
    t = priors.sample(np.random.default_rng(3), 200)
    assert np.isfinite(priors.log_prob(t)).all()


def test_there_are_priors_for_every_model_and_they_give_its_parameters() -> None:
    for name, model in MODELS.items():
        priors = read_priors(default_priors(name), name, (*model.parameters, "sigma"), {})
        assert tuple(p.name for p in priors.entries) == (*model.parameters, "sigma")
        assert priors.entries[-1].lower >= 0.0 or priors.entries[-1].log


def test_a_prior_may_be_relative_to_any_column() -> None:
    relative = 'relative_to = "cone_index_kpa"\ndefault_reference = 3'
    body = f'dist = "normal"\nmean = 1.0\nsd = 0.5\n{relative}'
    columns = {"cone_index_kpa": np.array([100.0, np.nan, 300.0]), "slip_ratio": np.zeros(3)}
    references = prior_references(columns)
    assert references == {"cone_index_kpa": 200.0}
    (given,), (assumed,) = one(body, references).entries, one(body).entries
    assert (given.loc, given.scale) == (200.0, 100.0)
    assert (assumed.loc, assumed.scale) == (3.0, 1.5)
    assert relative_columns(one(body).text) == {"cone_index_kpa": 3.0}


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ("sd_log", "sdlog", ["my.toml, parameters.x: ", "no key 'sdlog'", "mean sd_log?"]),
        ("[parameters.x]", "[parameters.sigm]", ["[parameters]", "sigm; missing parameter x"]),
        ("[parameters.x]", "[parameters.xx]", ["unknown parameter xx", "xx: did you mean x?"]),
        ('model = "m"', 'modle = "m"', ["my.toml: ", "no key 'modle'", "mean model?"]),
    ],
)
def test_a_misspelt_key_is_named_with_the_nearest_ones(
    right: str, wrong: str, words: list[str]
) -> None:
    body = 'dist = "lognormal"\nmedian = 1.0\nsd_log = 0.2'
    text = f'model = "m"\n{ENTRY.format(name="x")}{body}'.replace(right, wrong)
    with pytest.raises(CalibError) as refused:
        parse_priors(text, "my.toml", "m", ("x",), {})
    for word in (*words, "expected: "):
        assert word in str(refused.value)


def test_a_misspelt_key_of_the_likelihood_is_named() -> None:
    with pytest.raises(CalibError, match="did you mean family\\?") as refused:
        parse_priors('model = "m"\n[likelihood]\nfamly = 1\n', "my.toml", "m", ("sigma",), {})
    assert refused.value.where == "my.toml, [likelihood]"


def test_priors_that_a_model_declares_are_looked_for_in_its_file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(DECLARED)
    try:
        run_file(path, "models")
        with pytest.raises(CalibError, match="there is no distribution 'gaussian'") as caught:
            read_priors(default_priors("flat_pull"), "flat_pull", ("a", "sigma"), {})
        assert f"{path}, priors of the model flat_pull, parameters.a: " in str(caught.value)
        known = MODELS["flat_pull"]
        MODELS.discard("flat_pull")
        replace(known, priors=known.priors.replace("gaussian", "normal")).register()
        read = read_priors(default_priors("flat_pull"), "flat_pull", ("a", "sigma"), {})
        assert read.source == "flat_pull.toml"
    finally:
        MODELS.discard("flat_pull")


DECLARED = '''
import calib


def predict(theta, conditions):
    return theta[:, :1] + 0.0 * conditions["slip_ratio"]


calib.register(calib.Model(
    name="flat_pull", title="The same pull at every slip", output="drawbar_pull_kn",
    conditions=("slip_ratio",), parameters=("a",), predict=predict, latex=("$P = a$",),
    source="nobody", priors="""
model = "flat_pull"
[parameters]
a = {dist = "gaussian", mean = 1.0, sd = 1.0, unit = "kN", reason = "a test", source = "nobody"}
sigma = {dist = "half_normal", sd = 1.0, unit = "kN", reason = "a test", source = "nobody"}
"""))
'''
