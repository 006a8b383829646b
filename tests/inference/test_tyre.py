"""Magic Formulas as tyre property files, and property files as priors."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import calib
from calib import CalibError, TyreFile
from calib.inference.calibration import Calibration
from calib.inference.prior_files import default_priors, parse_priors
from calib.inference.sampler import SamplerSettings
from calib.inference.tyre import _fitted, priors_from_tir, tir_draws, to_tir
from calib.models.magic_formula import magic_formula
from calib.models.tir import FORCE

AT_30 = {"inflation_pressure_kpa": 206.8427, "normal_load_n": 5000.0}
SHORT = SamplerSettings(steps=100, max_steps=100)


def both_ways(sign: float = 1.0) -> Calibration:
    """A wheel that brakes and drives, its slips written as kappa: the curve is odd over s."""
    s = sign * np.linspace(-0.3, 0.5, 17)
    pull = magic_formula(100.0 * s, 0.09, 1.5, 2.0, -1.0)
    rows = {"slip_kappa_percent": 100.0 * s / (1.0 - s), "drawbar_pull_kn": pull,
            "normal_load_kn": np.full(17, 4.0)}  # fmt: skip
    noise = 0.02 * np.random.default_rng(1).standard_normal(17)
    rows["drawbar_pull_kn"] = rows["drawbar_pull_kn"] + noise
    return calib.calibrate(calib.build_problem("magic_formula", rows), seed=1, settings=SHORT)


@pytest.fixture(scope="module")
def braking() -> Calibration:
    return both_ways()


def test_negative_slips_are_fitted_and_predicted(braking: Calibration) -> None:
    assert braking.problem.conditions["slip_ratio"].min() == pytest.approx(-0.3)
    at = {"slip_percent": [-30.0, -10.0, 0.0, 10.0, 30.0]}
    median = calib.predict(braking, at).predictive.median
    truth = magic_formula(np.array(at["slip_percent"]), 0.09, 1.5, 2.0, -1.0)
    np.testing.assert_allclose(median, truth, atol=0.05)


def off_of(tyre: TyreFile) -> float:
    """Return how far a file says that its curve is off (N)."""
    said = re.search(r"is off by (\S+) N at most", " ".join(tyre.comments))
    assert said
    return float(said[1])


@pytest.mark.parametrize("name", ["pull_calibration", "braking"])
def test_a_file_read_back_is_the_calibrated_curve_to_the_deviation_that_it_says(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    calibration: Calibration = request.getfixturevalue(name)
    tyre = to_tir(calibration, at=AT_30 if name == "pull_calibration" else None)
    path = tmp_path / "tyre.tir"
    path.write_text(tyre.text, encoding="utf-8")
    again, load = calib.read_tir(path), tyre.nominal_load_n
    slips = calibration.problem.conditions["slip_ratio"]
    s = np.linspace(min(slips.min(), 0.0), slips.max(), 57)
    kappa = s / (1.0 - s)
    force = again.longitudinal_force(kappa, load)
    np.testing.assert_allclose(force, tyre.longitudinal_force(kappa, load), rtol=1e-6)
    assert again.sections["LONG_SLIP_RANGE"]["KPUMAX"] == pytest.approx(kappa[-1])
    at = {"slip_ratio": s, "inflation_pressure_kpa": np.full(57, AT_30["inflation_pressure_kpa"])}
    median = 1000.0 * calib.predict(calibration, at).parameter.median
    said = off_of(tyre)
    assert said < 0.02 * np.abs(median).max()
    np.testing.assert_allclose(force, median, atol=1.01 * said)


@given(
    st.floats(0.02, 0.8), st.floats(1.0, 2.0), st.floats(0.1, 5.0), st.floats(-20.0, 0.9),
    st.floats(-0.05, 0.05), st.floats(-0.2, 0.2), st.sampled_from([(0.0, 0.6), (-0.4, 0.4)]),
)  # fmt: skip
def test_a_magic_formula_is_found_again_over_its_own_slip(K, C, D, E, Sh, Sv, ends) -> None:
    x = np.linspace(*ends, 201)
    K = 100.0 * K
    pull = magic_formula(x, K / (C * D), C, D, E, Sh, Sv)
    fit = _fitted(x, pull, np.array([K, C, D, E, Sh, Sv]))
    assert fit.off <= 1e-6 * np.abs(pull).max()


@given(
    st.floats(0.02, 0.5), st.floats(1.1, 1.9), st.floats(-20.0, 0.6), st.floats(0.2, 0.9)
)  # fmt: skip
def test_over_the_other_slip_it_is_near(K, C, E, reach) -> None:
    s = np.linspace(0.0, reach, 201)
    pull = magic_formula(100.0 * s, K / C, C, 1.0, E)
    fit = _fitted(s / (1.0 - s), pull, np.array([100.0 * K, C, 1.0, E, 0.0, 0.0]))
    assert fit.off <= 0.06 * np.abs(pull).max()


def test_draws_are_those_of_the_posterior(braking: Calibration) -> None:
    drawn = tir_draws(braking, 20, at={})
    theta = braking.problem.theta(braking.subset(20))
    slip = {"slip_ratio": np.array([-0.2, 0.1, 0.4])}
    pulls = 1000.0 * braking.problem.bound.predict(braking.problem.of_model(theta), slip)
    kappa = slip["slip_ratio"] / (1.0 - slip["slip_ratio"])
    for tyre, pull in zip(drawn, pulls, strict=True):
        np.testing.assert_allclose(
            tyre.longitudinal_force(kappa, 4000.0), pull, atol=1.01 * off_of(tyre)
        )
    assert len({tyre.sections[FORCE]["PDX1"] for tyre in drawn}) == 20


def test_what_the_data_and_the_sampler_say_is_in_the_file(
    braking: Calibration, pull_calibration: Calibration
) -> None:
    assert "DID NOT CONVERGE" in " ".join(to_tir(braking).comments)
    said = " ".join(to_tir(pull_calibration, at=AT_30).comments)
    assert "reconstructed data, at inflation pressure 30 psi, normal load 5 kN" in said


@pytest.mark.parametrize(
    ("at", "words"),
    [
        ({}, ["one inflation pressure", "inflation_pressure_psi and of normal_load_kn"]),
        ({"inflation_pressure_psi": 30}, ["for one normal load", "--at normal_load_kn=5"]),
        ({**AT_30, "inflation_pressure_kpa": 400.0}, ["outside", "from 18 to 42"]),
        ({**AT_30, "normal_load_n": -5000.0}, ["normal_load_n = -5000 is outside"]),
        ({**AT_30, "slip_percent": 5.0}, ["slip_percent is not asked for"]),
        ({**AT_30, "colour": 5.0}, ["colour is not asked for"]),
    ],
)
def test_conditions_that_do_not_fit_are_refused(
    pull_calibration: Calibration, at: dict[str, float], words: list[str]
) -> None:
    with pytest.raises(CalibError) as refused:
        to_tir(pull_calibration, at=at)
    for word in words:
        assert word in str(refused.value)


def test_another_model_is_refused(rut_calibration: Calibration) -> None:
    with pytest.raises(CalibError, match="modified_bekker is no tyre property file"):
        to_tir(rut_calibration)


def made(C: float = 1.6, **more: float) -> TyreFile:
    force = {"PCX1": C, "PDX1": 1.1, "PEX1": 0.3, "PKX1": 22.0, "PHX1": -0.002, "PVX1": 0.01}
    return TyreFile(
        {"VERTICAL": {"FNOMIN": 3000.0}, FORCE: force, "LONG_SLIP_RANGE": more}, "made.tir"
    )


def test_priors_are_about_the_curve_of_a_tyre(tmp_path: Path) -> None:
    tyre = made()
    text = priors_from_tir(tyre)
    shipped = default_priors("magic_formula").read_text(encoding="utf-8")
    entries, before = (tomllib.loads(t)["parameters"] for t in (text, shipped))
    names = ("K", "C", "D", "G", "Sh", "Sv", "sigma")
    priors = parse_priors(text, "priors.toml", "magic_formula", names, {})
    at = dict(zip(names, (np.exp(p.loc) if p.log else p.loc for p in priors.entries), strict=True))
    s = np.linspace(0.0, 0.5, 60)
    B = at["K"] / (at["C"] * at["D"])
    pull = magic_formula(100.0 * s, B, at["C"], at["D"], 1.0 - at["G"], at["Sh"], at["Sv"])
    force = tyre.longitudinal_force(s / (1.0 - s), 3000.0) / 1000.0
    np.testing.assert_allclose(pull, force, atol=0.03 * force.max())
    for name, entry in entries.items():
        for width in ("dist", "sd", "sd_log", "lower", "upper", "unit", "relative_to"):
            assert entry.get(width) == before[name].get(width)
        assert ("made.tir" in entry["source"]) == (name != "sigma")
    # Of another load, the forces are in proportion.
    heavier = parse_priors(text, "", "magic_formula", names, {"normal_load_kn": 6.0})
    assert np.exp(heavier.entries[2].loc) == pytest.approx(2.0 * at["D"])


def test_a_tyre_that_was_only_braked_gives_priors_of_braking() -> None:
    text = priors_from_tir(made(PEX4=0.0, KPUMIN=-0.8, KPUMAX=0.0))
    entries = tomllib.loads(text)["parameters"]
    assert entries["D"]["median"] == pytest.approx(1.1, rel=0.1)


def test_priors_of_a_tyre_are_fitted_with(tmp_path: Path) -> None:
    path = tmp_path / "priors.toml"
    path.write_text(priors_from_tir(made()), encoding="utf-8")
    s = np.linspace(0.0, 0.5, 12)
    rows = {"slip_ratio": s, "normal_load_kn": np.full(12, 3.0),
            "drawbar_pull_kn": made().longitudinal_force(s / (1.0 - s), 3000.0) / 1000.0
            + 0.05 * np.random.default_rng(2).standard_normal(12)}  # fmt: skip
    problem = calib.build_problem("magic_formula", rows, path)
    found = calib.calibrate(problem, seed=1, settings=SHORT)
    assert found.summary["D"].median == pytest.approx(3.3, rel=0.1)
