"""Posteriors as netCDF files, by h5netcdf: xarray takes longer to import than a file to write.

The files are laid out as ArviZ lays them out (a group for each kind of value, a coordinate for each
dimension), so that `arviz.from_netcdf` and `xarray.open_datatree` read them.

Save and load calibrations: a run folder, and posteriors as ArviZ DataTrees.

A run folder holds everything that is needed to predict from it and to compute it again:
`posterior.nc`, `data.csv` (the fitted rows), `priors.toml`, `run.json` and, of a simulator that was
emulated, `emulator.npz`.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calib.batch.environment import Environment, differs_in_lines, sha256
from calib.data import read_for_model, write_table
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import GateReport
from calib.inference.estimators import PointEstimate
from calib.inference.noise import noise_of
from calib.inference.prior_files import parse_priors, prior_references, relative_columns
from calib.inference.priors import Priors
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.inference.record import DATA, POSTERIOR, PRIORS, RunRecord, read_record
from calib.inference.sampling.sampler import Draws
from calib.models import BoundModel, get_model
from calib.models.base import Array
from calib.models.simulators.emulator import (
    emulated_model,
    emulator_of,
    load_emulator,
    save_emulator,
)

if TYPE_CHECKING:
    import xarray as xr

DRAWN = ("chain", "draw")
# ArviZ takes groups for drawn ones unless they say otherwise.
_UNDRAWN = ("observed_data", "constant_data")


@dataclass(frozen=True, eq=False)
class Groups:
    """What a file holds.

    Parameters
    ----------
    values : mapping of str to mapping of str to ndarray
        Variables by group; of shape (chains, draws, ...) but in `observed_data` and
        `constant_data`.
    dims : mapping of str to tuple of str
        Names of a variable's dimensions beyond chain and draw, none by default.
    attrs : mapping of str to str
        Of the file.
    """

    values: Mapping[str, Mapping[str, NDArray[Any]]]
    dims: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    attrs: Mapping[str, str] = field(default_factory=dict)

    def dims_of(self, group: str, name: str) -> tuple[str, ...]:
        """Return the names of a variable's dimensions, all of them."""
        return (() if group in _UNDRAWN else DRAWN) + tuple(self.dims.get(name, ()))


def write_netcdf(groups: Groups, path: Path) -> None:
    """Write groups without time stamps, so equal results give equal content.

    Raises
    ------
    OSError
        If the disk has no room for it, before anything is written.
    """
    from h5netcdf import File

    size = sum(v.nbytes for group in groups.values.values() for v in group.values())
    # HDF5 does not survive a disk that fills up while it writes.
    if shutil.disk_usage(path.parent).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    with File(path, "w") as file:
        for name, text in groups.attrs.items():
            file.attrs[name] = text
        for group, variables in groups.values.items():
            node = file.create_group(group)
            for name, values in variables.items():
                dims = groups.dims_of(group, name)
                for dim, n in zip(dims, values.shape, strict=True):
                    if dim not in node.dimensions:
                        node.dimensions[dim] = n
                        node.create_variable(dim, (dim,), np.int64, data=np.arange(n))
                # Not compressed: draws get a tenth smaller, and take four times as long.
                node.create_variable(name, dims, values.dtype, data=values)


def read_netcdf(path: Path, *only: str) -> Groups:
    """Read a file's groups, or some of them; what is a coordinate is left out.

    Raises
    ------
    OSError, KeyError, ValueError, TypeError, RuntimeError
        If the file is damaged, or lacks a group.
    """
    from h5netcdf import File

    values: dict[str, dict[str, NDArray[Any]]] = {}
    dims: dict[str, tuple[str, ...]] = {}
    with File(path, "r") as file:
        for group in only or tuple(file.groups):
            node = file[group]
            values[group] = {}
            for name, variable in node.variables.items():
                if name not in node.dimensions:
                    values[group][name] = np.asarray(variable[...])
                    dims[name] = tuple(d for d in variable.dimensions if d not in DRAWN)
        attrs = {name: str(text) for name, text in file.attrs.items()}
    return Groups(values, dims, attrs)


@dataclass(frozen=True, eq=False)
class DrawsFile:
    """The draws in a file (chains, draws) by parameter, and their log density."""

    draws: Mapping[str, NDArray[np.float64]]
    log_prob: NDArray[np.float64]


def read_draws(path: Path) -> DrawsFile:
    """Read the posterior draws in a file; raises what `read_netcdf` does, if there are none too."""
    groups = read_netcdf(path, "posterior", "sample_stats").values
    draws, log_prob = groups["posterior"], groups["sample_stats"]["lp"]
    if log_prob.ndim != 2 or not log_prob.size or not draws:
        raise ValueError("there are no draws in it")
    if any(v.shape != log_prob.shape for v in draws.values()):
        raise ValueError("its draws differ in number")
    return DrawsFile(draws, log_prob)


SCHEMA = "calib/run/1"
_HASHED = (POSTERIOR, PRIORS, DATA)
_EMULATOR = "emulator.npz"
# Draws of a run whose log density is worked out again as it is read. It may be off by so many
# nats, far more than rounding and far less than what moves a prediction, and for one of the draws
# by more: one that lies on a bound may be rounded beyond it.
_N_COMPARED, _SAME_NATS = 8, 1e-3
N_PRIOR = 2000
MAX_CELLS = 8_000_000
_GATE = ("rhat", "ess_bulk", "ess_tail", "tau")
# Of the draws, as they are.
_DRAWS = ("log_evidence", "efficiency", "acceptance", "evaluations")


def to_datatree(calibration: Calibration) -> xr.DataTree:
    """Return a calibration as an ArviZ DataTree.

    Chains are walkers (`sample_stats.ensemble` says of which ensemble), so that effective sample
    sizes computed from the file are those of the gate. Groups: posterior, prior, log_prior,
    posterior_predictive, log_likelihood, sample_stats, observed_data, constant_data.
    """
    # Of ArviZ the part that lays out and reads: its plots take a second to import.
    from arviz_base import from_dict

    groups = groups_of(calibration)
    with warnings.catch_warnings():
        # Walkers are chains, of which there are more than draws in a short run.
        warnings.filterwarnings("ignore", "Found chain dimension to be longer", UserWarning)
        tree: xr.DataTree = from_dict(
            {name: dict(values) for name, values in groups.values.items()},
            dims={name: list(dims) for name, dims in groups.dims.items()},
            attrs={"/": dict(groups.attrs)},
        )
    return tree


def groups_of(calibration: Calibration) -> Groups:
    """Return what the file of a calibration holds, as `to_datatree` says."""
    problem = calibration.problem
    draws = calibration.draws
    chains, steps = calibration.natural.shape[:2]
    output = problem.bound.model.output
    # Of long data the groups that hold a number for every draw and row hold fewer draws, or none.
    kept = min(steps, MAX_CELLS // (chains * problem.response.size))
    picked = np.linspace(0, steps - 1, kept).round().astype(int)
    shape = (chains, kept, problem.response.size)
    natural = calibration.natural[:, picked].reshape(-1, calibration.natural.shape[-1])
    internal = draws.t.reshape(chains, steps, -1)[:, picked].reshape(-1, draws.t.shape[-1])
    rng = generator(calibration.seed, calibration.label, "posterior_predictive")
    location = problem.draw_mean_response(natural, problem.conditions, rng)
    noisy = location + problem.draw_noise(natural, rng)
    prior = problem.theta(
        problem.priors.sample(generator(calibration.seed, calibration.label, "prior"), N_PRIOR)
    )
    with np.errstate(over="ignore"):
        measured = problem.bound.from_response(noisy).reshape(shape).astype(np.float32)
    by_row = {
        "posterior_predictive": {output: measured},
        "log_likelihood": {output: problem.log_likelihood_left_out(internal).reshape(shape)},
    }
    if kept == 0:
        by_row = {}
    ensembles = np.repeat(np.arange(draws.t.shape[0]), draws.t.shape[1])
    return Groups(
        {
            "posterior": calibration.parameters,
            "prior": _prior_group(calibration, prior),
            **by_row,
            "log_prior": {"joint": problem.priors.log_prob(draws.flat).reshape(chains, steps)},
            "sample_stats": {
                "lp": draws.log_prob.reshape(chains, steps),
                "ensemble": np.repeat(ensembles[:, None], steps, axis=1),
            },
            "observed_data": {output: problem.observed},
            "constant_data": problem.conditions,
        },
        dims=dict.fromkeys((output, *problem.conditions), ("row",)),
        # Without durations: equal results give equal files.
        attrs={"run": json.dumps(_describe(calibration))},
    )


def _prior_group(calibration: Calibration, natural: Array) -> dict[str, Array]:
    problem = calibration.problem
    named = {p.name: natural[:, i] for i, p in enumerate(problem.priors.entries) if not p.fixed}
    with np.errstate(all="ignore"):
        derived = problem.bound.report(problem.of_model(natural))
    both = {name: v for name, v in derived.items() if name in calibration.parameters} | named
    return {name: both[name][None] for name in calibration.parameters}


def _describe(calibration: Calibration) -> dict[str, Any]:
    problem, report = calibration.problem, calibration.draws.report
    return {
        "schema": SCHEMA,
        "model": problem.bound.model.name,
        "output": problem.bound.model.output,
        "references": dict(problem.bound.references),
        "fixed": {p.name: p.loc for p in problem.priors.entries if p.fixed},
        "prior_file": PurePath(problem.priors.source).name,
        "prior_text": problem.priors.text,
        "prior_references": _references(problem),
        "seed": calibration.seed,
        "label": calibration.label,
        "shape": list(calibration.draws.t.shape),
        "mode": calibration.draws.mode.tolist(),
        **{k: getattr(calibration.draws, k) for k in _DRAWS},
        "walkers": calibration.draws.walkers,
        "settings": asdict(calibration.settings),
        "estimates": describe_estimates(calibration.estimates),
        "data_source": problem.table.source,
        "data_label": problem.table.label,
        "gate": {
            "passed": report.passed,
            "reasons": list(report.reasons),
            "steps": report.steps,
            "names": list(report.names),
            **{k: getattr(report, k).tolist() for k in _GATE},
        },
    }


def describe_estimates(estimates: Sequence[PointEstimate]) -> list[dict[str, Any]]:
    """Return what a run folder keeps of the estimates that seeded the sampler."""
    return [
        {"method": e.method, "theta": e.theta.tolist()}
        | {k: getattr(e, k) for k in ("reported", "cost", "rmse")}
        for e in estimates
    ]


def _references(problem: Problem) -> dict[str, float]:
    known = prior_references(problem.table.columns)
    return {name: known[name] for name in relative_columns(problem.priors.text) if name in known}


def save_calibration(
    calibration: Calibration, folder: Path, *, environment: Environment | None = None
) -> None:
    """Write a run folder into an existing, empty folder.

    Parameters
    ----------
    environment : Environment, optional
        Where it says that it was made: in that of this process by default.
    """
    problem = calibration.problem
    write_netcdf(groups_of(calibration), folder / "posterior.nc")
    (folder / "priors.toml").write_text(problem.priors.text, encoding="utf-8")
    write_table(
        folder / "data.csv",
        {**problem.table.to_write(problem.table.columns), **problem.table.extra},
    )
    hashed = [*_HASHED]
    emulator = emulator_of(problem.bound.model)
    if emulator is not None:
        save_emulator(emulator, problem.bound.model.name, folder / _EMULATOR)
        hashed.append(_EMULATOR)
    hashes = {name: sha256((folder / name).read_bytes()) for name in hashed}
    described = {
        **_describe(calibration),
        "seconds": calibration.draws.seconds,
        **(environment or Environment.here()).document(),
        "sha256": hashes,
    }
    (folder / "run.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")


def _check_hashes(record: RunRecord, folder: Path) -> None:
    """A run is predicted from only as it was written."""
    for name, expected in record.sha256.items():
        with _damage(folder / name):
            content = (folder / name).read_bytes()
        if (found := sha256(content)) != expected and not differs_in_lines(content, expected):
            raise CalibError(
                "the file has changed since the run was written",
                where=str(folder / name),
                expected=f"SHA-256 {expected[:16]}..., found {found[:16]}...",
                hint="restore it, or run `calib fit` again",
            )


def load_calibration(folder: Path) -> Calibration:
    """Read a run folder.

    Raises
    ------
    CalibError
        If the folder is not one, a file in it is damaged, or the model has changed since.
    """
    folder = Path(folder)
    record = read_record(RunRecord, folder)
    meta: dict[str, Any] = record.document
    _check_hashes(record, folder)
    with _damage(folder / "run.json"):
        problem = run_problem(record, folder / "data.csv")
        shape = tuple(meta["shape"])
    with _damage(folder / "posterior.nc"):
        t, log_prob = _read_posterior(folder / "posterior.nc", problem.priors, shape)
    with _damage(folder / "run.json"):
        _check_model(problem, t, log_prob, folder)
        found = Calibration(problem, _draws(meta, t, log_prob), record.seed, record.label)
        _ = found.parameters  # what cannot be reported is damaged as well
        return found


def _check_model(problem: Problem, t: Array, log_prob: Array, folder: Path) -> None:
    """A run is predicted from only by the model that it was fitted with."""
    flat = t.reshape(-1, t.shape[-1])
    some = np.linspace(0, len(flat) - 1, _N_COMPARED).astype(int)
    with np.errstate(all="ignore"):
        off = np.abs(problem.log_prob(flat[some]) - log_prob.reshape(-1)[some])
    if np.count_nonzero(off < _SAME_NATS) < _N_COMPARED - 1:
        raise CalibError(
            f"the model {problem.bound.model.name} no longer gives its draws the densities that "
            "the run was saved with: its formula, or that of its noise, has changed since",
            where=str(folder),
            expected="the model as it was when the run was made",
            hint="pass the model's file as it was then, or run `calib fit` again",
        )


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CalibError(
            f"the file cannot be read ({type(error).__name__})",
            where=str(path),
            expected="the file as `calib fit` wrote it",
            hint="the file is damaged or incomplete: run `calib fit` again",
        ) from None


def run_problem(record: RunRecord, data: Path) -> Problem:
    """Return the problem of a run folder from the content of its ``run.json`` and ``data.csv``."""
    model = get_model(record.model)
    if (data.parent / _EMULATOR).exists():
        model = emulated_model(model, load_emulator(data.parent / _EMULATOR)[1])
    priors = parse_priors(
        record.prior_text, record.prior_file, model.name, (*model.parameters, "sigma"),
        record.prior_references,
    )  # fmt: skip
    if record.fixed:
        priors = priors.fix(record.fixed)
    table = read_for_model(data, (*model.conditions, model.output))
    # What is reconstructed stays labelled so.
    table = replace(table, source=record.data_source, label=record.data_label)
    # A run holds the rows that it was calibrated on: those that the noise is measured by.
    noise = noise_of(priors.noise, model.select(table.columns), record.prior_file)
    return Problem(BoundModel(model, record.references), table, priors, noise=noise)


def _read_posterior(path: Path, priors: Priors, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the internal coordinates, of a shape, and their log densities."""
    file = read_draws(path)
    natural, log_prob = priors.stack(file.draws, shape[:-1]), file.log_prob.reshape(shape[:-1])
    t = priors.to_internal(natural.reshape(-1, natural.shape[-1]), margin=0.0).reshape(shape)
    return t, log_prob


def _draws(meta: dict[str, Any], t: Array, log_prob: Array) -> Draws:
    gate = meta["gate"]
    report = GateReport(
        names=tuple(gate["names"]), steps=gate["steps"], passed=gate["passed"],
        reasons=tuple(gate["reasons"]), **{k: np.array(gate[k]) for k in _GATE},
    )  # fmt: skip
    return Draws(
        t=t,
        log_prob=log_prob,
        report=report,
        mode=np.array(meta["mode"]),
        # Earlier run folders had all walkers stored.
        walkers=meta["walkers"] if "walkers" in meta else t.shape[1],
        **{k: meta[k] for k in (*_DRAWS, "seconds")},
    )
