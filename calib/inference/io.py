"""Run folders: records read and checked, calibrations saved, loaded and computed again.

A run folder holds everything that is needed to predict from it and to compute it again:
`posterior.nc`, `data.csv` (the fitted rows), `priors.toml`, `run.json` and, of a simulator that was
emulated, `emulator.npz`. `arviz.from_netcdf` and `xarray.open_datatree` read `posterior.nc`.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from os import PathLike
from pathlib import Path, PurePath, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    StringConstraints,
    ValidationError,
)

from calib.arguments import takes
from calib.batch.environment import Environment, differs_in_lines, sha256
from calib.batch.folders import check_folder
from calib.data import Table, read_for_model, write_table
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError, in_words
from calib.inference.calibration import Calibration, calibrate
from calib.inference.diagnostics import GateReport
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.likelihood import noise_of
from calib.inference.prior_files import parse_priors, relative_columns
from calib.inference.priors import prior_references
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.inference.sampler import Draws, SamplerSettings
from calib.models import DECLARE, MODELS, BoundModel, get_model
from calib.models.base import Array
from calib.models.simulators.emulator import (
    emulated_model,
    emulator_of,
    load_emulator,
    save_emulator,
)

if TYPE_CHECKING:
    import xarray as xr

    from calib.inference.joint_files import JointRecord


RUN, POSTERIOR, PRIORS, DATA = "run.json", "posterior.nc", "priors.toml", "data.csv"


def _inside(path: str) -> str:
    """A path that leaves the folder is no path of one of its files."""
    pure = PurePosixPath(path)
    if pure.is_absolute() or ".." in pure.parts or "\\" in path or not pure.parts:
        raise ValueError("not a path inside the folder")
    return path


def _name(text: str) -> str:
    if text != PurePosixPath(text).name or "\\" in text:
        raise ValueError("not the name of a file")
    return text


def _known_model(name: str) -> str:
    if name not in MODELS:
        raise CalibError(
            f"model: {name} is not one of {', '.join(MODELS)}", expected="a model known here",
            hint=f"{DECLARE}; if there is none, restore the folder's",
        )  # fmt: skip
    return name


type Hash = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
type File = Annotated[str, AfterValidator(_inside)]
type Name = Annotated[str, AfterValidator(_name)]
type KnownModel = Annotated[str, AfterValidator(_known_model)]


class Entry(BaseModel):
    """Some entries of a record: what later versions add to them is not needed."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Record(Entry):
    """What a folder of any kind says of itself, in one of its files."""

    FILE: ClassVar[str]
    kind: ClassVar[Literal["report", "run", "comparison", "diagnosis", "joint"]]
    WRITTEN_BY: ClassVar[str]
    versions: dict[str, str]
    machine: dict[str, str]
    code: str
    seed: Annotated[int, Field(ge=0)]
    settings: SamplerSettings
    document: dict[str, JsonValue]
    """The whole file."""

    @property
    def environment(self) -> Environment:
        """Where it was made, as it says."""
        return Environment(self.versions, self.machine, self.code)


class _Estimate(Entry):
    method: str
    theta: tuple[float, ...]
    reported: dict[str, float]
    cost: float
    rmse: float


class RunRecord(Record):
    """`run.json` of a run folder."""

    FILE, kind, WRITTEN_BY = RUN, "run", "calib fit"
    schema_: Literal["calib/run/1"] = Field(alias="schema")
    model: KnownModel
    label: str
    estimates: tuple[_Estimate, ...]
    fixed: dict[str, float]
    references: dict[str, float]
    prior_file: Name
    prior_text: str
    prior_references: dict[str, float]
    data_source: str
    data_label: str
    header: tuple[str, ...] = ()
    part_of: str = ""
    sha256: dict[File, Hash]


def fault_of(folder: Path, fault: str) -> str:
    """Say what is wrong with a folder that cannot be read: above all, that it does not exist."""
    return fault if folder.exists() else "there is no such folder"


_OF_JOINT = (
    "of a joint calibration make a run of one output: in Python calib.save_calibration("
    "load_joint(FOLDER).calibration(OUTPUT), RUN), with load_joint of calib.inference.joint_files"
)


def read_record[R: Record](kind: type[R], folder: Path) -> R:
    """Read the record of a kind in a folder.

    Raises
    ------
    CalibError
        If there is none, or it is damaged or of an earlier version.
    """
    path = folder / kind.FILE
    if not path.is_file():
        raise CalibError(
            fault_of(folder, f"this is not a {kind.kind} folder (no readable {kind.FILE} in it)"),
            where=str(folder),
            expected=f"a folder written by `{kind.WRITTEN_BY}`",
            hint=_OF_JOINT
            if (folder / "joint.json").is_file()
            else f"give the folder that `{kind.WRITTEN_BY} ... --out` named",
        )
    try:
        content = json.loads(path.read_bytes())
        return kind.model_validate({**content, "document": content})
    except ValidationError as error:
        found = error.errors()
    except CalibError as error:
        raise error.within(str(path)) from None
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise _damaged(kind, path, f"it cannot be read ({type(error).__name__})") from None
    if any(e["loc"] == ("schema",) for e in found):
        schema, expected = content.get("schema"), kind.model_fields["schema_"].annotation
        hint = f"run `{kind.WRITTEN_BY}` again, or use the version that made the folder"
        said, allowed = f"the schema is {schema!r}", get_args(expected)[0]
        raise CalibError(said, where=str(path), expected=allowed, hint=hint)
    place = ".".join(map(str, found[0]["loc"]))
    raise _damaged(kind, path, f"{place or 'in it'}: {in_words(found[0])}")


def _damaged(kind: type[Record], path: Path, found: str) -> CalibError:
    hint = f"restore the file, or run `{kind.WRITTEN_BY}` again"
    return CalibError(found, where=str(path), expected="the file as it was written", hint=hint)


DRAWN = ("chain", "draw")
_EMULATOR = "emulator.npz"
# What `run.json` has of the draws and of the gate's report under their own names.
_OF_DRAWS = ("log_evidence", "efficiency", "acceptance", "evaluations")
_OF_GATE = ("rhat", "ess_bulk", "ess_tail", "tau")


@takes(calibration=Calibration)
def to_datatree(calibration: Calibration) -> xr.DataTree:
    """Return a calibration as an ArviZ DataTree.

    A chain is an independently seeded ensemble, with the draws of its walkers one after another
    (`sample_stats.walker`). Variables have `units` and `long_name`. Groups: posterior, prior,
    log_prior, posterior_predictive, log_likelihood, sample_stats, observed_data, constant_data.

    Examples
    --------
    >>> import calib
    >>> ruts = calib.load_he2019("rut_depth")
    >>> calibration = calib.calibrate(calib.build_problem("bekker", ruts), seed=1)
    >>> tree = calib.to_datatree(calibration)
    >>> tree["posterior"].sizes["chain"], tree["posterior"]["z_ref"].attrs["units"]
    (4, 'mm')
    """
    import xarray as xr  # late: half a second

    problem, draws = calibration.problem, calibration.draws
    chains, steps = calibration.natural.shape[:2]
    output = problem.bound.model.output
    # Groups with a number for every draw and row have 64 MB at most: of long data fewer draws.
    kept = min(steps, 8_000_000 // (chains * problem.response.size))
    picked = np.linspace(0, steps - 1, kept).round().astype(int)
    ensembles, walkers = draws.t.shape[:2]
    shape = (ensembles, walkers * kept, problem.response.size)
    by_row: dict[str, Mapping[str, NDArray[Any]]] = {}
    if kept:
        natural = calibration.natural[:, picked].reshape(-1, calibration.natural.shape[-1])
        internal = draws.t.reshape(chains, steps, -1)[:, picked].reshape(-1, draws.t.shape[-1])
        rng = generator(calibration.seed, calibration.label, "posterior_predictive")
        noisy = problem.draw_mean_response(natural, problem.conditions, rng)
        noisy = noisy + problem.draw_noise(natural, rng)
        with np.errstate(over="ignore"):
            measured = problem.bound.from_response(noisy).reshape(shape).astype(np.float32)
        by_row = {
            "posterior_predictive": {output: measured},
            "log_likelihood": {output: problem.log_likelihood_left_out(internal).reshape(shape)},
        }
    whole = (ensembles, walkers * steps)
    groups = {
        "posterior": {n: v.reshape(whole) for n, v in calibration.parameters.items()},
        "prior": _prior_group(calibration),
        **by_row,
        "log_prior": {"joint": problem.priors.log_prob(draws.flat).reshape(whole)},
        "sample_stats": {
            "lp": draws.log_prob.reshape(whole),
            "walker": np.tile(np.repeat(np.arange(walkers), steps), (ensembles, 1)),
        },
        "observed_data": {output: problem.observed},
        "constant_data": problem.conditions,
    }
    said = _units_and_meanings(problem)
    datasets = {}
    for group, variables in groups.items():
        dims = ("row",) if group in ("observed_data", "constant_data") else (*DRAWN, "row")
        about = {} if group in ("log_likelihood", "sample_stats") else said
        named = {n: (dims[: v.ndim], v, about.get(n, {})) for n, v in variables.items()}
        data = xr.Dataset(named)
        datasets[group] = data.assign_coords({d: np.arange(n) for d, n in data.sizes.items()})
    tree = xr.DataTree.from_dict(datasets)
    # Without durations: equal results give equal files.
    tree.attrs["run"] = json.dumps(_describe(calibration))
    return tree


def _units_and_meanings(problem: Problem) -> dict[str, dict[str, str]]:
    """Return the attributes of variables: parameters and columns."""
    model = problem.bound.model
    units = dict(model.reported) | {p.name: p.unit for p in problem.priors.entries}
    meanings = {"sigma": "standard deviation of the noise", **model.meanings}
    columns = [QUANTITIES[c] for c in (*problem.conditions, model.output)]
    return {n: {"units": u, "long_name": meanings.get(n, n)} for n, u in units.items()} | {
        q.canonical: {"units": q.unit, "long_name": q.description} for q in columns
    }


def save_posterior(calibration: Calibration, path: Path) -> None:
    """Write a calibration's DataTree as netCDF, without time stamps.

    Raises
    ------
    OSError
        If the disk has no room for it, before anything is written.
    """
    write_netcdf(to_datatree(calibration), path)


def write_netcdf(tree: xr.DataTree, path: Path) -> None:
    """Write a DataTree; an OSError, before anything is written, if the disk has no room for it."""
    # HDF5 does not survive a disk that fills up while it writes.
    if shutil.disk_usage(path.parent).free < tree.nbytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    tree.to_netcdf(path, engine="h5netcdf")


def read_netcdf(path: Path) -> xr.DataTree:
    """Read a file that `save_posterior` wrote.

    Raises
    ------
    OSError, KeyError, ValueError, TypeError, RuntimeError
        If the file is damaged.
    """
    import xarray as xr

    with xr.open_datatree(path, engine="h5netcdf") as tree:
        return tree.load()


def _of_walkers(values: xr.DataArray, steps: int) -> NDArray[np.float64]:
    return np.asarray(values.to_numpy(), dtype=np.float64).reshape(-1, steps)


class DrawsFile(NamedTuple):
    """The draws in a file (walkers, steps) by parameter, and their log density."""

    draws: Mapping[str, NDArray[np.float64]]
    log_prob: NDArray[np.float64]


def read_draws(path: Path) -> DrawsFile:
    """Read the posterior draws in a file; raises what `read_netcdf` does, if there are none too."""
    tree = read_netcdf(path)
    # By walker, as effective sample sizes are worked out.
    steps = json.loads(tree.attrs["run"])["shape"][2]
    draws = {str(n): _of_walkers(v, steps) for n, v in tree["posterior"].data_vars.items()}
    log_prob = _of_walkers(tree["sample_stats"].data_vars["lp"], steps)
    if log_prob.ndim != 2 or not log_prob.size or not draws:
        raise ValueError("there are no draws in it")
    if any(v.shape != log_prob.shape for v in draws.values()):
        raise ValueError("its draws differ in number")
    return DrawsFile(draws, log_prob)


def _prior_group(calibration: Calibration) -> dict[str, Array]:
    problem = calibration.problem
    rng = generator(calibration.seed, calibration.label, "prior")
    natural = problem.theta(problem.priors.sample(rng, 2000))
    named = {p.name: natural[:, i] for i, p in enumerate(problem.priors.entries) if not p.fixed}
    with np.errstate(all="ignore"):
        derived = problem.bound.report(problem.of_model(natural))
    both = {name: v for name, v in derived.items() if name in calibration.parameters} | named
    return {name: both[name][None] for name in calibration.parameters}


def own_names(table: Table) -> dict[str, Any]:
    """Return the file's own column names, where they are not those of the copy that is kept."""
    return {} if table.header == tuple(table.columns) else {"header": list(table.header)}


def _describe(calibration: Calibration) -> dict[str, Any]:
    problem, report = calibration.problem, calibration.draws.report
    known = prior_references(problem.table.columns)
    return {
        "schema": "calib/run/1",
        "model": problem.bound.model.name,
        "output": problem.bound.model.output,
        "references": dict(problem.bound.references),
        "fixed": {p.name: p.loc for p in problem.priors.entries if p.fixed},
        "prior_file": PurePath(problem.priors.source).name,
        "prior_text": problem.priors.text,
        "prior_references": {
            name: known[name] for name in relative_columns(problem.priors.text) if name in known
        },
        "seed": calibration.seed,
        "label": calibration.label,
        "shape": list(calibration.draws.t.shape),
        "mode": calibration.draws.mode.tolist(),
        **{k: getattr(calibration.draws, k) for k in _OF_DRAWS},
        "walkers": calibration.draws.walkers,
        "settings": asdict(calibration.settings),
        "estimates": describe_estimates(calibration.estimates),
        "data_source": problem.table.source,
        "data_label": problem.table.label,
        # Units are shown as in the file, of which the copy has other names.
        **own_names(problem.table),
        **({"part_of": calibration.part_of} if calibration.part_of else {}),
        "gate": describe_gate(report),
    }


def describe_gate(report: GateReport) -> dict[str, Any]:
    """Return a gate's report as JSON has it."""
    return {
        "passed": report.passed,
        "reasons": list(report.reasons),
        "steps": report.steps,
        "names": list(report.names),
        **{k: getattr(report, k).tolist() for k in _OF_GATE},
    }


def read_gate(gate: Mapping[str, Any]) -> GateReport:
    """Return the report that `describe_gate` described."""
    return GateReport(
        names=tuple(gate["names"]), steps=gate["steps"], passed=gate["passed"],
        reasons=tuple(gate["reasons"]), **{k: np.array(gate[k]) for k in _OF_GATE},
    )  # fmt: skip


def describe_estimates(estimates: Sequence[PointEstimate]) -> list[dict[str, Any]]:
    """Return what a run folder keeps of the estimates that seeded the sampler."""
    return [
        {"method": e.method, "theta": e.theta.tolist()}
        | {k: getattr(e, k) for k in ("reported", "cost", "rmse")}
        for e in estimates
    ]


@takes(calibration=Calibration, folder=PathLike)
def save_calibration(
    calibration: Calibration,
    folder: str | Path,
    *,
    overwrite: bool = False,
    environment: Environment | None = None,
) -> None:
    """Write a run folder.

    Parameters
    ----------
    calibration : Calibration
    folder : path
        New, or empty.
    overwrite : bool
        Whether to replace a folder that calib has written.
    environment : Environment, optional
        Where it says that it was made: in that of this process by default.

    Raises
    ------
    CalibError
        If the folder is not empty and may not be replaced, or cannot be written.

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> calib.save_calibration(calibration, Path("run"))  # doctest: +SKIP
    """
    problem, folder = calibration.problem, Path(folder)
    check_folder(folder, overwrite=overwrite)
    if overwrite and folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    save_posterior(calibration, folder / POSTERIOR)
    (folder / PRIORS).write_text(problem.priors.text, encoding="utf-8")
    write_table(folder / DATA, problem.table.whole())
    hashed = [POSTERIOR, PRIORS, DATA]
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
    (folder / RUN).write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")


@takes(folder=PathLike)
def load_calibration(folder: Path) -> Calibration:
    """Read a run folder.

    Raises
    ------
    CalibError
        If the folder is not one, a file in it is damaged, or the model has changed since.

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> calibration = calib.load_calibration(Path("run"))  # doctest: +SKIP
    """
    folder = Path(folder)
    record = read_record(RunRecord, folder)
    meta: dict[str, Any] = record.document
    check_unchanged(folder, record)
    with damage(folder / RUN):
        problem = run_problem(record, folder / DATA)
        shape = tuple(meta["shape"])
    with damage(folder / POSTERIOR):
        file, priors = read_draws(folder / POSTERIOR), problem.priors
        natural, log_prob = priors.stack(file.draws, shape[:-1]), file.log_prob.reshape(shape[:-1])
        t = priors.to_internal(natural.reshape(-1, natural.shape[-1]), margin=0.0).reshape(shape)
    with damage(folder / RUN):
        _check_model(problem, t, log_prob, folder)
        draws = Draws(
            t=t, log_prob=log_prob, report=read_gate(meta["gate"]), mode=np.array(meta["mode"]),
            walkers=meta.get("walkers", t.shape[1]),  # earlier run folders had all stored
            **{k: meta[k] for k in (*_OF_DRAWS, "seconds")},
        )  # fmt: skip
        calibration = Calibration(problem, draws, record.seed, record.label, part_of=record.part_of)
        _ = calibration.parameters  # what cannot be reported is damaged as well
        return calibration


def check_unchanged(folder: Path, record: RunRecord | JointRecord) -> None:
    """A folder is predicted from only as it was written; a CalibError names a file that changed."""
    for name, expected in record.sha256.items():
        with damage(folder / name, record.WRITTEN_BY):
            content = (folder / name).read_bytes()
        if (found := sha256(content)) != expected and not differs_in_lines(content, expected):
            raise CalibError(
                "the file has changed since the run was written",
                where=str(folder / name),
                expected=f"SHA-256 {expected[:16]}..., found {found[:16]}...",
                hint=f"restore it, or run `{record.WRITTEN_BY}` again",
            )


def _check_model(problem: Problem, t: Array, log_prob: Array, folder: Path) -> None:
    """A run is predicted from only by the model that it was fitted with."""
    flat = t.reshape(-1, t.shape[-1])
    some = np.linspace(0, len(flat) - 1, 8).astype(int)
    with np.errstate(all="ignore"):
        off = np.abs(problem.log_prob(flat[some]) - log_prob.reshape(-1)[some])
    # A thousandth of a nat is far more than rounding and far less than what moves a prediction. One
    # draw may be off by more: one that lies on a bound may be rounded beyond it.
    if np.count_nonzero(off < 1e-3) < len(some) - 1:
        raise CalibError(
            f"the model {problem.bound.model.name} no longer gives its draws the densities that "
            "the run was saved with: its formula, or that of its noise, has changed since",
            where=str(folder),
            expected="the model as it was when the run was made",
            hint="pass the model's file as it was then, or run `calib fit` again",
        )


@contextmanager
def damage(path: Path, by: str = "calib fit") -> Iterator[None]:
    """Turn what a damaged file makes fail into a CalibError that names it."""
    try:
        yield
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CalibError(
            f"the file cannot be read ({type(error).__name__})",
            where=str(path),
            expected=f"the file as `{by}` wrote it",
            hint=f"the file is damaged or incomplete: run `{by}` again",
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
    if record.header:
        table = replace(table, header=record.header, text=())
    # A run holds the rows that it was calibrated on: those that the noise is measured by.
    noise = noise_of(priors.noise, model, table, record.prior_file)
    return Problem(BoundModel(model, record.references), table, priors, noise=noise)


def estimate_again(record: RunRecord, problem: Problem) -> tuple[PointEstimate, ...]:
    """Return a run's point estimates, by the methods and the seed that it names."""
    return tuple(
        estimate(problem, e.method, generator(record.seed, record.model, e.method))
        for e in record.estimates
    )


def recompute_run(
    record: RunRecord, problem: Problem, out: Path, progress: Callable[[str, int, int], None]
) -> Calibration:
    """Sample a run again and write it into a new folder.

    Sampled from the recorded starts, whoever chose them; the estimates in the new folder are
    computed again, to be compared with them.
    """
    estimates = estimate_again(record, problem)
    starts = tuple(
        replace(again, theta=np.array(said.theta), rmse=said.rmse)
        for again, said in zip(estimates, record.estimates, strict=True)
    )
    calibration = calibrate(
        problem, record.seed, label=record.label, estimates=starts, settings=record.settings,
        progress=lambda done, planned: progress("sampling", done, planned),
    )  # fmt: skip
    calibration = replace(calibration, estimates=estimates)
    out.mkdir()
    save_calibration(calibration, out, environment=record.environment)
    return calibration
