"""Student-t noise and a noise that depends on a condition, against SciPy and closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats

from calib.data import Table, read_for_model, table_from_arrays
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import case_from_run
from calib.inference.calibration import Calibration, calibrate
from calib.inference.emulation.prepared import emulated
from calib.inference.estimators import estimate, methods_for
from calib.inference.io import load_calibration, save_calibration
from calib.inference.likelihood import Noise
from calib.inference.prior_files import default_priors, parse_priors
from calib.inference.problem import Problem, build_problem
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, example_csv, get_model
from calib.validation.prediction import predict, predictive_draws
from tests.conftest import SEED, he2019_table
from tests.gap.cases import make_case

STUDENT = '[likelihood]\nfamily = "student_t"\n'
SLIP = '[likelihood]\nnoise_depends_on = "slip"\n'
BOTH = STUDENT + 'noise_depends_on = "slip_ratio"\n'
WORDS = 'unit = "1"\nreason = "a test"\nsource = "nobody"\n'


def prior_text(model: str, extra: str) -> str:
    return default_priors(model).read_text(encoding="utf-8") + "\n" + extra


def problem_with(folder: Path, extra: str, table: Table, model: str = "modified_bekker") -> Problem:
    path = folder / "priors.toml"
    path.write_text(prior_text(model, extra), encoding="utf-8")
    return build_problem(model, table, path)


def sampled(problem: Problem, settings: SamplerSettings | None = None) -> Calibration:
    point = estimate(problem, "least_squares", np.random.default_rng(SEED))
    return calibrate(problem, SEED, estimates=(point,), settings=settings)


def drawn(problem: Problem, k: int = 40) -> np.ndarray:
    t = problem.priors.sample(np.random.default_rng(0), 50 * k)
    return t[np.isfinite(problem.log_likelihood(t))][:k]


@pytest.mark.parametrize("model", ["modified_bekker", "magic_formula_pressure"])
@pytest.mark.parametrize("extra", [STUDENT, SLIP, BOTH])
def test_densities_are_scipys(tmp_path: Path, model: str, extra: str) -> None:
    output = "rut_depth" if model == "modified_bekker" else "drawbar_pull"
    problem = problem_with(tmp_path, extra, he2019_table(output), model)
    t = drawn(problem)
    natural = problem.theta(t)
    value = dict(zip((p.name for p in problem.priors.entries), natural.T[:, :, None], strict=True))
    slip = problem.conditions["slip_ratio"]
    z = (slip - slip.mean()) / slip.std()
    scale = value["sigma"] * np.exp(value.get("sigma_slope", 0.0) * z)
    theta = np.stack([value[n][:, 0] for n in problem.bound.model.parameters], axis=1)
    location = problem.bound.mean_response(theta, problem.conditions)
    law = stats.t(value["nu"]) if "nu" in value else stats.norm()
    expected = law.logpdf((problem.response - location) / scale) - np.log(scale)
    if problem.bound.model.response == "log":
        expected -= np.log(problem.observed)
    np.testing.assert_allclose(problem.log_likelihood_rows(t), expected, rtol=1e-9)
    np.testing.assert_allclose(problem.log_likelihood(t), expected.sum(axis=1), rtol=1e-9)


def test_normal_noise_of_one_sd_is_the_default_whoever_says_so(tmp_path: Path) -> None:
    said = problem_with(tmp_path, '[likelihood]\nfamily = "normal"\n', he2019_table("rut_depth"))
    assert said.noise.iid_normal
    assert said.names == build_problem("modified_bekker", said.table).names


@pytest.mark.parametrize("lower", [None, 1.0])
def test_the_gamma_prior_is_scipys(lower: float | None) -> None:
    bound = "" if lower is None else f"lower = {lower}\n"
    nu = f'[parameters.nu]\ndist = "gamma"\nshape = 2.0\nrate = 0.1\n{bound}{WORDS}'
    model = get_model("bekker")
    names = (*model.parameters, "sigma")
    priors = parse_priors(prior_text("bekker", STUDENT + nu), "my.toml", "bekker", names, {})
    (j,) = [i for i, p in enumerate(priors.free) if p.name == "nu"]
    law = stats.gamma(2.0, scale=10.0)
    low = 0.0 if lower is None else lower
    t = priors.sample(np.random.default_rng(1), 5000)
    part = stats.kstest(np.exp(t[:, j]), lambda x: (law.cdf(x) - law.cdf(low)) / law.sf(low))
    assert part.pvalue > 1e-3
    at = np.repeat(t[:1], 2, axis=0)
    at[:, j] = np.log([3.0, 30.0])
    difference = np.diff(priors.log_prob(at))[0]
    # Of the logarithm, whose density has a factor nu.
    assert difference == pytest.approx(law.logpdf(30.0) - law.logpdf(3.0) + np.log(10.0))

    def density(x: float) -> float:
        at[0, j] = x
        return float(np.exp(priors.log_prob(at[:1])[0] - rest))

    others = replace(priors, entries=tuple(p for p in priors.entries if p.name != "nu"))
    rest = others.log_prob(np.delete(at[:1], j, axis=1))[0]
    start = -20.0 if lower is None else np.log(lower)
    assert integrate.quad(density, start, 7.0, limit=200)[0] == pytest.approx(1.0, rel=1e-6)


def test_noise_is_drawn_as_its_density_says() -> None:
    rng, slip = np.random.default_rng(3), np.array([0.1, 0.3, 0.5])
    noise = Noise("student_t", "slip", "", "slip_ratio", 0.3, 0.2)
    nu, slope, sigma = 3.0, 0.7, 0.2
    natural = np.tile([9.0, nu, slope, sigma], (4000, 1))
    conditions = {"slip_ratio": slip}
    found = noise.draw(natural, conditions, rng, 3)
    z = stats.norm.ppf((np.arange(4000) + 0.5) / 4000)[:, None]
    at_quantiles = noise.of_normal(natural, conditions, z)
    for i in range(3):
        law = stats.t(nu, scale=sigma * np.exp(slope * (slip[i] - 0.3) / 0.2))
        assert stats.kstest(found[:, i], law.cdf).pvalue > 1e-3
        np.testing.assert_allclose(law.cdf(at_quantiles[:, i]), stats.norm.cdf(z[:, 0]), rtol=1e-8)
    np.testing.assert_allclose(
        noise.normal_scores(at_quantiles, natural, noise.scale(natural, conditions)),
        np.tile(z, (1, 3)), rtol=1e-8,
    )  # fmt: skip


def off_line(factor: float) -> Table:
    rng = np.random.default_rng(5)
    slip = np.tile(np.linspace(0.05, 0.6, 12), 2)
    pressure = np.repeat([90.0, 150.0], 12)
    rut = 20.0 * (pressure / 116.0) ** (1.0 + slip) * np.exp(0.05 * rng.standard_normal(24))
    rut[7] *= factor
    return table_from_arrays(
        {"slip_ratio": slip, "average_ground_pressure_kpa": pressure, "rut_depth_mm": rut}
    )


def test_a_reading_off_by_a_hundred_times_moves_student_less(tmp_path: Path) -> None:
    short = SamplerSettings(walkers=64, max_steps=192)
    clean = sampled(build_problem("modified_bekker", off_line(1.0)), short)
    normal = sampled(build_problem("modified_bekker", off_line(100.0)), short)
    student = sampled(problem_with(tmp_path, STUDENT, off_line(100.0)), short)
    for name in ("z_ref", "n0"):
        truth = clean.summary[name]
        moved = [abs(c.summary[name].mean - truth.mean) / truth.sd for c in (normal, student)]
        assert moved[1] < 0.5 * moved[0]
    assert (
        abs(student.summary["z_ref"].mean - clean.summary["z_ref"].mean) < clean.summary["z_ref"].sd
    )
    # And hardly widens it.
    assert student.summary["z_ref"].sd < 0.2 * normal.summary["z_ref"].sd
    assert student.summary["nu"].median < 5.0


def test_a_run_is_loaded_with_its_noise(tmp_path: Path) -> None:
    found = sampled(problem_with(tmp_path, BOTH, he2019_table("rut_depth")))
    assert found.converged
    folder = tmp_path / "run"
    folder.mkdir()
    save_calibration(found, folder)
    with pytest.raises(CalibError, match="a diagnosis takes normal noise"):
        case_from_run(folder, tmp_path / "field.csv")
    loaded = load_calibration(folder)
    assert loaded.problem.noise == found.problem.noise
    assert loaded.problem.names == found.problem.names
    np.testing.assert_allclose(
        loaded.problem.log_prob(loaded.draws.flat[:50]), found.draws.log_prob.reshape(-1)[:50]
    )
    bands = [predict(c, found.problem.table).predictive.upper[0.9] for c in (found, loaded)]
    np.testing.assert_allclose(*bands)
    # What is drawn at random and what is worked out by quantiles is the same distribution.
    rng = np.random.default_rng(1)
    _, measured = predictive_draws(found, found.problem.conditions, rng)
    np.testing.assert_allclose(np.quantile(measured, 0.95, axis=0), bands[0], rtol=0.03)


def refused(extra: str, table: Table, folder: Path, model: str = "modified_bekker") -> str:
    with pytest.raises(CalibError) as error:
        problem_with(folder, extra, table, model)
    return str(error.value)


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ('[likelihood]\nfamily = "cauchy"\n', ["family", "student_t"]),
        ('[likelihood]\nfamilie = "student_t"\n', ["familie"]),
        ('likelihood = 3\n', ["likelihood"]),
        ('[likelihood]\nnoise_depends_on = "load"\n', ["'load'", "slip"]),
        (f'[parameters.nu]\ndist = "fixed"\nvalue = 4.0\n{WORDS}', ["unknown parameter nu"]),
        (f'{STUDENT}[parameters.sigma_slope]\ndist = "normal"\nmean = 0.0\nsd = 1.0\n{WORDS}',
         ["unknown parameter sigma_slope"]),
        (STUDENT + '[parameters.nu]\ndist = "fixed"\nvalue = -1.0\n' + WORDS, ["nu", "above 0"]),
        (STUDENT + '[parameters.nu]\ndist = "normal"\nmean = 4.0\nsd = 2.0\n' + WORDS,
         ["nu", "above 0"]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(tmp_path: Path, extra: str, said: list[str]) -> None:
    text = refused(extra, he2019_table("rut_depth"), tmp_path)
    assert all(word in text for word in said), text


def test_gamma_is_for_degrees_of_freedom_alone(tmp_path: Path) -> None:
    text = prior_text("modified_bekker", "").replace(
        '[parameters.sigma]\ndist = "lognormal"\nmedian = 0.1\nsd_log = 0.8',
        '[parameters.sigma]\ndist = "gamma"\nshape = 2.0\nrate = 10.0',
    )
    path = tmp_path / "gamma.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibError, match="degrees of freedom"):
        build_problem("modified_bekker", he2019_table("rut_depth"), path)


def test_a_noise_cannot_depend_on_what_is_the_same_everywhere(tmp_path: Path) -> None:
    table = he2019_table("rut_depth")
    same = replace(table, columns={**table.columns, "slip_ratio": np.full(len(table), 0.2)})
    assert "same in all rows" in refused(SLIP, same, tmp_path)


def test_an_effect_has_no_likelihood() -> None:
    with pytest.raises(CalibError, match="an effect has no likelihood"):
        parse_priors(f'model = "an_effect"\n{STUDENT}', "my.toml", "an_effect", ("size",), {})


def twice(name: str, folder: Path) -> Path:
    """An example's rows and as many with all 2 % larger: more than parameters, noise and all."""
    header, *rows = example_csv(name).splitlines()
    again = [",".join(f"{1.02 * float(cell):.6g}" for cell in row.split(",")) for row in rows]
    path = folder / "rows.csv"
    path.write_text("\n".join([header, *rows, *again, ""]), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["magic_formula", "modified_bekker", "brixius"])
def test_every_model_and_estimator_takes_another_noise(name: str, tmp_path: Path) -> None:
    model = MODELS[name]
    path = twice(name, tmp_path)
    table = read_for_model(path, (*model.conditions, model.output))
    varying = next(c for c in model.conditions if np.ptp(table[c]) > 0.0)
    chosen = STUDENT + f'noise_depends_on = "{varying}"\n'
    problem, usual = problem_with(tmp_path, chosen, table, name), build_problem(name, table)
    assert problem.names == (*usual.names[:-1], "nu", "sigma_slope", "sigma")
    assert np.isfinite(problem.log_prob(drawn(problem, 3))).all()
    # What minimises squares knows no noise.
    for method in set(methods_for(name)) - {"genetic"}:
        try:
            expected = estimate(usual, method, np.random.default_rng(1))
        except CalibError:  # a method that reads features off curves needs more rows
            continue
        found = estimate(problem, method, np.random.default_rng(1))
        np.testing.assert_allclose(found.theta, expected.theta)


def test_an_emulator_and_a_diagnosis_refuse_another_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = problem_with(tmp_path, STUDENT, he2019_table("rut_depth"))
    with pytest.raises(CalibError, match="an emulator takes normal noise"):
        emulated(problem, 1)
    monkeypatch.setattr("calib.gap.campaigns.build_problem", lambda model, lab, priors: problem)
    with pytest.raises(CalibError, match="a diagnosis takes normal noise"):
        campaigns(make_case())
    uncertain = replace(problem.bound.model, uncertain=lambda theta, conditions: None)
    monkeypatch.setattr("calib.inference.problem.get_model", lambda name: uncertain)
    with pytest.raises(CalibError, match="the emulator modified_bekker takes normal noise"):
        build_problem("modified_bekker", problem.table, tmp_path / "priors.toml")
