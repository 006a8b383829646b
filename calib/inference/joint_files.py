"""Folders of joint calibrations: written, read, and computed again.

Such a folder has `joint.json`, `posterior.nc` and of each output the rows and the priors,
`OUTPUT.csv` and `OUTPUT.toml`; of emulated simulators `emulators/MODEL.npz`. In `posterior.nc` the
values of the groups have a dimension `group`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from calib.batch.environment import Environment, sha256
from calib.batch.folders import check_folder
from calib.data import read_for_model, write_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.io import (
    DRAWN,
    POSTERIOR,
    DrawsFile,
    Entry,
    File,
    Hash,
    KnownModel,
    Record,
    check_unchanged,
    damage,
    describe_gate,
    own_names,
    read_gate,
    read_netcdf,
    read_record,
    write_netcdf,
)
from calib.inference.joint import JointCalibration, JointProblem, build_joint, calibrate_joint
from calib.inference.sampler import Draws
from calib.models.base import Array
from calib.models.simulators.emulator import emulator_of, save_emulator

JOINT = "joint.json"
_OF_DRAWS = ("acceptance", "evaluations", "walkers", "seconds")


class OutputRecord(Entry):
    """One output of a joint calibration: its model, and what was said of its rows."""

    model: KnownModel
    data_source: str
    data_label: str
    header: tuple[str, ...] = ()


class JointRecord(Record):
    """`joint.json` of a folder of `calib joint`."""

    FILE, kind, WRITTEN_BY = JOINT, "joint", "calib joint"
    schema_: Literal["calib/joint/1"] = Field(alias="schema")
    outputs: dict[str, OutputRecord]
    group: str
    pooled: tuple[str, ...]
    sha256: dict[File, Hash]


def save_joint(
    calibration: JointCalibration, folder: Path, *, environment: Environment | None = None,
    verdicts: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Write the folder of a joint calibration, new or empty, with verdicts by output and group.

    A CalibError if it is not empty, or cannot be written.
    """
    problem, draws, report = calibration.problem, calibration.draws, calibration.draws.report
    check_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _save_posterior(calibration, folder / POSTERIOR)
    outputs: dict[str, Any] = {}
    for output, whole in problem.wholes.items():
        model, table = whole.bound.model, whole.table
        columns: dict[str, Any] = table.whole()
        if problem.column and problem.column not in columns:
            columns[problem.column] = problem.labels[output]
        write_table(folder / f"{output}.csv", columns)
        (folder / f"{output}.toml").write_text(whole.priors.text, encoding="utf-8")
        if (emulator := emulator_of(model)) is not None:
            (folder / "emulators").mkdir(exist_ok=True)
            save_emulator(emulator, model.name, folder / "emulators" / f"{model.name}.npz")
        outputs[output] = {
            "model": model.name, "data_source": table.source, "data_label": table.label,
            **own_names(table),
        }  # fmt: skip
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    described = {
        "schema": "calib/joint/1",
        "outputs": outputs,
        "group": problem.column,
        "pooled": list(problem.pooled),
        "shared": {name: list(of) for name, of in problem.shared.items()},
        "seed": calibration.seed,
        "settings": asdict(calibration.settings),
        "shape": list(draws.t.shape),
        **{k: getattr(draws, k) for k in _OF_DRAWS},
        "gate": describe_gate(report),
        **({} if verdicts is None else {"verdict": verdicts}),
        **(environment or Environment.here()).document(),
        "sha256": {p.relative_to(folder).as_posix(): sha256(p.read_bytes()) for p in files},
    }  # fmt: skip
    (folder / JOINT).write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")


def _save_posterior(calibration: JointCalibration, path: Path) -> None:
    import xarray as xr  # late: half a second

    problem, draws = calibration.problem, calibration.draws
    ensembles, walkers, steps, _ = draws.t.shape
    shape = (ensembles, walkers * steps)
    by_name, groups = dict(calibration.parameters), problem.groups
    units = {p.name: p.unit for p in problem.priors.entries}
    variables: dict[str, Any] = {}
    for name in problem.pooled:
        values = np.stack([by_name.pop(f"{name}[{g}]") for g in groups], axis=-1)
        kept = values.reshape(*shape, len(groups))
        variables[f"{name}_by_group"] = ((*DRAWN, "group"), kept, {"units": units[name]})
    variables |= {n: (DRAWN, v.reshape(shape), {"units": units[n]}) for n, v in by_name.items()}
    posterior = xr.Dataset(variables, coords={"group": list(groups)} if groups else {})
    stats = xr.Dataset({"lp": (DRAWN, draws.log_prob.reshape(shape))})
    tree = xr.DataTree.from_dict({"posterior": posterior, "sample_stats": stats})
    tree.attrs["run"] = json.dumps({"shape": list(draws.t.shape)})
    write_netcdf(tree, path)


def read_joint_draws(path: Path) -> DrawsFile:
    """Read the draws of a joint posterior, each (walkers, steps), those of groups by ``p[group]``.

    Raises what `calib.inference.io.read_netcdf` does.
    """
    tree = read_netcdf(path)
    posterior, steps = tree["posterior"], json.loads(tree.attrs["run"])["shape"][2]
    draws: dict[str, Array] = {}
    for name, values in posterior.data_vars.items():
        x = values.to_numpy()
        if values.dims == DRAWN:
            draws[str(name)] = x.reshape(-1, steps)
            continue
        for i, group in enumerate(posterior["group"].to_numpy()):
            own = str(name).removesuffix("_by_group")
            draws[f"{own}[{group}]"] = x[..., i].reshape(-1, steps)
    return DrawsFile(draws, tree["sample_stats"]["lp"].to_numpy().reshape(-1, steps))


def joint_problem(record: JointRecord, folder: Path) -> JointProblem:
    """Return the problem of a joint folder, from its rows and priors."""
    data, priors = {}, {}
    for output, said in record.outputs.items():
        path = folder / f"{output}.csv"
        table = read_for_model(path, [OUTPUTS[output]])
        table = replace(table, source=said.data_source, label=said.data_label)
        data[said.model] = replace(table, header=said.header, text=()) if said.header else table
        priors[said.model] = folder / f"{output}.toml"
    return build_joint(data, group=record.group, pooled=record.pooled, priors=priors)


def coordinates_of(problem: JointProblem, file: DrawsFile) -> Array:
    """Return the coordinates (n, d) of draws in a file."""
    log = {p.name: p.log for p in problem.priors.free}
    natural = np.stack([file.draws[p.name].reshape(-1) for p in problem.priors.entries], axis=1)
    own = []
    for g in problem.groups:
        for p in problem.pooled:
            x = file.draws[f"{p}[{g}]"].reshape(-1)
            own.append(np.log(x) if log[p] else x)
    return np.column_stack([problem.priors.to_internal(natural, margin=0.0), *own])


def load_joint(folder: Path) -> JointCalibration:
    """Read a folder that `save_joint` wrote.

    Raises
    ------
    CalibError
        If the folder is not one, a file in it is damaged, or a model has changed since.
    """
    from calib.models.simulators.files import load_files

    load_files(sorted((folder / "emulators").glob("*.npz")))
    record = read_record(JointRecord, folder)
    check_unchanged(folder, record)
    problem = joint_problem(record, folder)
    meta: dict[str, Any] = record.document
    with damage(folder / POSTERIOR, record.WRITTEN_BY):
        file, shape = read_joint_draws(folder / POSTERIOR), tuple(meta["shape"])
        t, log_prob = coordinates_of(problem, file), file.log_prob.reshape(shape[:-1])
        draws = Draws(
            t.reshape(shape), log_prob, read_gate(meta["gate"]), t[int(np.argmax(log_prob))],
            np.nan, np.nan, **{k: meta[k] for k in _OF_DRAWS},
        )  # fmt: skip
    if density_differs(problem, t, file):
        raise CalibError(
            "the models no longer give the draws the densities that they were saved with: a "
            "formula, or that of a noise, has changed since",
            where=str(folder), expected="the models as they were when the folder was made",
            hint="pass a model's file as it was then, or run `calib joint` again",
        )  # fmt: skip
    return JointCalibration(problem, draws, record.seed, record.settings)


def density_differs(problem: JointProblem, t: Array, file: DrawsFile, size: int = 8) -> str:
    """Say how the density of some draws (n, d) differs from that in the file; empty if not.

    One in eight may be off: a draw on a bound may be rounded beyond it.
    """
    some = np.linspace(0, len(t) - 1, min(size, len(t))).astype(int)
    found = problem.log_posterior(*problem.parted(t[some]))
    with np.errstate(all="ignore"):
        off = np.abs(found - file.log_prob.reshape(-1)[some])
    worst = int(np.argmax(np.nan_to_num(off, nan=np.inf)))
    if np.count_nonzero(off < 1e-3) >= len(some) - max(1, len(some) // 100):
        return ""
    return f"{file.log_prob.reshape(-1)[some][worst]:.6g} is stated, {found[worst]:.6g} computed"


def recompute_joint(
    record: JointRecord, problem: JointProblem, out: Path, progress: Callable[[str, int, int], None]
) -> JointCalibration:
    """Sample a joint calibration again and write it into a new folder."""
    found = calibrate_joint(
        problem, record.seed, settings=record.settings,
        progress=lambda done, planned: progress("sampling", done, planned),
    )  # fmt: skip
    save_joint(found, out, environment=record.environment)
    return found
