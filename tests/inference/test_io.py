"""Run folders: what is saved predicts as what was saved, and damage is told."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.data import Table, table_from_arrays
from calib.errors import CalibError
from calib.inference import io
from calib.inference.calibration import Calibration, calibrate
from calib.inference.io import load_calibration, save_calibration, to_datatree
from calib.inference.problem import build_problem
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS
from calib.validation.prediction import predict
from calib.validation.validate import leave_one_out

GROUPS = {
    "posterior", "prior", "log_prior", "posterior_predictive", "log_likelihood", "sample_stats",
    "observed_data", "constant_data",
}  # fmt: skip


@pytest.fixture(scope="module")
def saved(rut_calibration: Calibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    save_calibration(rut_calibration, folder)
    return folder


@pytest.fixture(scope="module")
def loaded(saved: Path) -> Calibration:
    return load_calibration(saved)


def test_a_loaded_calibration_predicts_as_the_saved_one(
    rut_calibration: Calibration, loaded: Calibration, rut_tables: tuple[Table, Table]
) -> None:
    one, other = predict(rut_calibration, rut_tables[1]), predict(loaded, rut_tables[1])
    # Natural parameters are stored: the logarithm of an exponential may differ in the last bit.
    for kind in ("parameter", "predictive"):
        for level in (0.5, 0.9, 0.95):
            for side in ("lower", "upper"):
                np.testing.assert_allclose(
                    getattr(getattr(one, kind), side)[level],
                    getattr(getattr(other, kind), side)[level],
                    rtol=1e-12,
                )
    assert one.outside == other.outside


def test_everything_else_survives_too(rut_calibration: Calibration, loaded: Calibration) -> None:
    np.testing.assert_allclose(loaded.draws.t, rut_calibration.draws.t, rtol=1e-12)
    np.testing.assert_array_equal(loaded.draws.log_prob, rut_calibration.draws.log_prob)
    np.testing.assert_array_equal(loaded.draws.mode, rut_calibration.draws.mode)
    assert loaded.converged
    assert loaded.problem.table.label == "reconstructed"
    assert (loaded.seed, loaded.label) == (rut_calibration.seed, rut_calibration.label)
    for name in ("log_evidence", "efficiency", "acceptance", "evaluations", "seconds"):
        assert getattr(loaded.draws, name) == getattr(rut_calibration.draws, name)
    for name in ("rhat", "ess_bulk", "ess_tail", "tau"):
        np.testing.assert_array_equal(
            getattr(loaded.draws.report, name), getattr(rut_calibration.draws.report, name)
        )
    assert loaded.problem.priors.entries == rut_calibration.problem.priors.entries
    assert loaded.problem.bound.references == rut_calibration.problem.bound.references
    for name, values in rut_calibration.problem.table.columns.items():
        np.testing.assert_array_equal(loaded.problem.table[name], values)


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1.0 + 1e-12, False), (1.001, True)])
def test_a_model_that_has_changed_is_told(
    saved: Path, monkeypatch: pytest.MonkeyPatch, factor: float, told: bool
) -> None:
    """Its prediction would be another, in silence; rounding on another processor is none."""
    model = MODELS["modified_bekker"]
    changed = replace(
        model, mean_response=lambda x, **p: model.mean_response(x, **p) + np.log(factor)
    )
    monkeypatch.setattr(io, "get_model", lambda name: changed)
    if not told:
        load_calibration(saved)
        return
    with pytest.raises(CalibError, match="modified_bekker no longer gives its draws"):
        load_calibration(saved)


def test_the_tree_has_its_groups_and_dimensions(rut_calibration: Calibration) -> None:
    tree = to_datatree(rut_calibration)
    assert set(tree.children) == GROUPS
    ensembles, walkers, steps = rut_calibration.draws.t.shape[:3]
    posterior = tree["posterior"]
    assert set(posterior.data_vars) == {"z_ref", "n0", "n1", "sigma", "k"}
    assert dict(posterior.sizes) == {"chain": ensembles, "draw": walkers * steps}
    assert posterior["z_ref"].attrs["units"] == "mm"
    assert posterior["n1"].attrs["long_name"] == "growth of the exponent with slip"
    assert tree["observed_data"]["rut_depth_mm"].attrs["units"] == "mm"
    for group in ("posterior_predictive", "log_likelihood"):
        assert tree[group]["rut_depth_mm"].dims == ("chain", "draw", "row")
        assert tree[group].sizes["row"] == 18
    assert set(tree["prior"].data_vars) == set(posterior.data_vars)
    assert tree["observed_data"]["rut_depth_mm"].dims == ("row",)
    assert set(tree["constant_data"].data_vars) == {"slip_ratio", "average_ground_pressure_kpa"}
    walker = tree["sample_stats"]["walker"].values
    np.testing.assert_array_equal(walker[0], np.repeat(np.arange(walkers), steps))


def test_other_programs_find_the_same_figures_in_the_file(
    rut_calibration: Calibration, saved: Path
) -> None:
    # Not at the top: to import it takes every process of the tests a second.
    import arviz as az
    import xarray as xr

    tree = to_datatree(rut_calibration)
    for name, node in io.read_netcdf(saved / "posterior.nc").children.items():
        xr.testing.assert_equal(node.to_dataset(), tree[name].to_dataset())
    with az.from_netcdf(saved / "posterior.nc", engine="h5netcdf") as tree:
        summary = az.summary(tree, round_to="none")
        loo = az.loo(tree, pointwise=True)
    for name, s in rut_calibration.summary.items():
        assert summary.loc[name, "mean"] == pytest.approx(s.mean, rel=1e-9)
        # A chain of the file has its ensemble's walkers one after another; ours are walkers.
        assert summary.loc[name, "ess_bulk"] == pytest.approx(s.ess_bulk, rel=0.25)
        assert summary.loc[name, "r_hat"] == pytest.approx(s.rhat, abs=0.005)
    ours = leave_one_out(rut_calibration)
    # ArviZ smooths with the relative efficiency of the chains, which moves the tail slightly.
    assert loo.elpd == pytest.approx(ours.elpd, abs=0.05)


def test_a_disk_too_small_is_seen_before_it_is_written_to(
    rut_calibration: Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = shutil._ntuple_diskusage(10**9, 10**9 - 1000, 1000)  # type: ignore[attr-defined]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
    with pytest.raises(OSError, match="No space left") as told:
        io.save_posterior(rut_calibration, tmp_path / "posterior.nc")
    assert told.value.errno == errno.ENOSPC
    assert not any(tmp_path.iterdir())


def test_prior_draws_are_of_the_prior(rut_calibration: Calibration) -> None:
    prior = to_datatree(rut_calibration)["prior"]
    z_ref = prior["z_ref"].values.ravel()
    # lognormal(25, 1): 2000 draws of ln z_ref have a mean within 5/sqrt(2000) of ln 25.
    assert abs(np.log(z_ref).mean() - np.log(25.0)) < 5.0 / np.sqrt(2000)
    p_ref = rut_calibration.problem.bound.references["p_ref_kpa"]
    k = p_ref * (z_ref / 1000.0) ** -prior["n0"].values.ravel()
    np.testing.assert_allclose(prior["k"].values.ravel(), k, rtol=1e-9)


def test_equal_results_give_equal_files(
    rut_calibration: Calibration, saved: Path, tmp_path: Path
) -> None:
    save_calibration(rut_calibration, tmp_path)
    names = sorted(p.name for p in saved.iterdir())
    assert names == sorted([*io.read_record(io.RunRecord, saved).sha256, "run.json"])
    for name in names:
        assert (tmp_path / name).read_bytes() == (saved / name).read_bytes(), name


def test_a_run_is_replaced_only_where_that_is_asked_for(
    rut_calibration: Calibration, saved: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(saved, folder)
    before = (folder / "run.json").read_bytes()
    (folder / "run.json").write_bytes(before + b"\n")
    with pytest.raises(CalibError, match="exists and is not empty"):
        save_calibration(rut_calibration, folder)
    assert (folder / "run.json").read_bytes() == before + b"\n"
    save_calibration(rut_calibration, folder, overwrite=True)
    assert (folder / "run.json").read_bytes() == before
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(CalibError, match=r"calib did not write: notes\.txt"):
        save_calibration(rut_calibration, folder, overwrite=True)


def test_fixed_parameters_and_loads_survive(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    slip = np.linspace(0.0, 0.6, 12)
    table = table_from_arrays(
        {
            "slip_ratio": slip,
            "drawbar_pull_kn": 0.5 * np.sin(1.5 * np.arctan(20 * slip))
            + 0.01 * rng.normal(size=12),
            "normal_load_kn": np.full(12, 2.0),
            "repeat": np.array(["a", "b"] * 6),
        }
    )
    problem = build_problem("magic_formula", table, fixed={"Sh": 0.5, "Sv": 0.0})
    quick = SamplerSettings(steps=50, max_steps=50, keep=1600)
    calibration = calibrate(problem, 1, settings=quick)
    assert not calibration.converged
    save_calibration(calibration, tmp_path)
    loaded = load_calibration(tmp_path)
    assert not loaded.converged
    assert loaded.draws.report.reasons == calibration.draws.report.reasons
    np.testing.assert_allclose(loaded.natural, calibration.natural, rtol=1e-12)
    assert np.all(loaded.natural[..., 4] == 0.5)
    assert [p.loc for p in loaded.problem.priors.entries] == [p.loc for p in problem.priors.entries]


def replaced(key: str, *values: object) -> Callable[[Path], None]:
    """Give an entry another value, or take it out."""

    def damage(folder: Path) -> None:
        meta = json.loads((folder / "run.json").read_text())
        del meta[key]
        meta |= dict.fromkeys([key], *values) if values else {}
        (folder / "run.json").write_text(json.dumps(meta))

    return damage


def truncated(name: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return damage


@pytest.mark.parametrize(
    ("damage", "place"),
    [
        (lambda folder: (folder / "run.json").unlink(), ""),
        (lambda folder: (folder / "posterior.nc").unlink(), "posterior.nc"),
        (truncated("run.json"), ""),
        (truncated("posterior.nc"), "posterior.nc"),
        (lambda folder: (folder / "run.json").write_text("[]"), ""),
        (replaced("schema"), ""),
        (replaced("gate"), "run.json"),
        (replaced("shape"), "run.json"),
        (replaced("shape", [4, 20, 999, 4]), "posterior.nc"),
        (replaced("references", None), None),
        (replaced("model", "pacejka"), None),
        (replaced("prior_text", "model ="), None),
        (replaced("gate", {}), "run.json"),
    ],
)
def test_damage_is_told(saved: Path, tmp_path: Path, damage, place: str | None) -> None:
    folder = tmp_path / "run"
    shutil.copytree(saved, folder)
    damage(folder)
    with pytest.raises(CalibError) as caught:
        load_calibration(folder)
    assert "hint:" in str(caught.value)
    if place is not None:
        assert str(folder / place) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "said"), [("absent", "no such folder"), ("data.csv", "not a run folder")]
)
def test_something_else_is_no_run_folder(saved: Path, name: str, said: str) -> None:
    with pytest.raises(CalibError, match=said) as caught:
        load_calibration(saved / name)
    assert "calib fit" in str(caught.value)
