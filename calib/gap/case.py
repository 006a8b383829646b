"""A case: a calibrated simulator, the campaign it was calibrated on, and the one it misses."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from calib.data import Table, read_table
from calib.data.files import MEND_TOML, read_text, read_toml
from calib.data.quantities import OUTPUTS, output_of
from calib.data.reader import common_label
from calib.errors import CalibError, meant
from calib.gap.context import Context, read_context
from calib.gap.declared import declared_covariates, with_declared
from calib.inference.prior_files import DeclaredPriors

_FILES = ("calibration", "field", "predict")
_KEYS = (*_FILES, "models", "priors", "covariates", "context")


@dataclass(frozen=True)
class Case:
    """The tables and models of a diagnosis.

    Parameters
    ----------
    lab, field : Table
        The campaign of the calibration, and the one the simulator is used for.
    models : mapping of str to str
        Output (`calib.data.quantities.OUTPUTS`) to model.
    new_conditions : Table, optional
        Conditions to predict.
    notes : tuple of str
        What a reader must know about where the data are from.
    context : Context
        What is known besides the data.
    priors : mapping of str to DeclaredPriors
        Of an output's simulator, as its prior file says; the model's own where there is none.
    covariates : mapping of str to tuple of str
        Columns that the case declares: the values of a category, none for numbers.
    """

    name: str
    lab: Table
    field: Table
    models: Mapping[str, str]
    new_conditions: Table | None = None
    notes: tuple[str, ...] = ()
    context: Context = dataclasses.field(default_factory=Context)
    priors: Mapping[str, DeclaredPriors] = dataclasses.field(default_factory=dict)
    covariates: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    @property
    def label(self) -> str:
        """What its data must be called wherever something of them is shown; usually nothing."""
        return common_label(self.lab, self.field)


def read_case(folder: Path) -> Case:
    """Read a case folder.

    Parameters
    ----------
    folder : Path
        With ``case.toml`` and the CSV files it names.

    Raises
    ------
    CalibError
        Naming what is missing or wrong, and where.
    """
    folder = Path(folder)
    path = folder / "case.toml"
    try:
        content = read_toml(path)
    except OSError as error:
        raise CalibError(
            f"the case cannot be read ({error.strerror})", where=str(path),
            hint=f"give its folder: {folder.parent}" if folder.is_file()
            else "give a folder with a case.toml in it",
        ) from None  # fmt: skip
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibError(f"not valid TOML: {error}", where=str(path), hint=MEND_TOML) from None
    unknown = [key for key in content if key not in _KEYS]
    if unknown:
        raise CalibError(
            f"unknown key {unknown[0]}", where=str(path), expected=", ".join(_KEYS),
            hint=meant(unknown[0], _KEYS, "correct its name, or leave it out"),
        )  # fmt: skip
    models = content.get("models")
    files = {key: content.get(key) for key in ("calibration", "field")}
    if (
        not isinstance(models, dict)
        or not models
        or not all(isinstance(f, str) for f in files.values())
    ):
        raise CalibError(
            "calibration, field or [models] is missing", where=str(path),
            expected='calibration = "lab.csv", field = "field.csv", [models] output = "model"',
            hint="add it",
        )  # fmt: skip
    unknown = [key for key in models if key not in OUTPUTS]
    if unknown:
        raise CalibError(
            f"unknown output {', '.join(unknown)}", where=f"{path}, [models]",
            expected=", ".join(OUTPUTS), hint="correct the name",
        )  # fmt: skip
    missing_ok = tuple(OUTPUTS.values())
    lab = read_table(_inside(folder, "calibration", content), allow_missing=missing_ok)
    field = read_table(_inside(folder, "field", content), allow_missing=missing_ok)
    new = read_table(_inside(folder, "predict", content)) if content.get("predict") else None
    context = read_context(content.get("context"), str(path))
    priors = _read_priors(folder, content.get("priors", {}), models)
    tables = (lab, field) if new is None else (lab, field, new)
    own = declared_covariates(content.get("covariates", {}), tables)
    lab, field = with_declared(lab, own), with_declared(field, own)
    new = None if new is None else with_declared(new, own)
    return Case(folder.name, lab, field, models, new, (), context, priors, own)


def _read_priors(
    folder: Path, named: object, models: Mapping[str, str]
) -> dict[str, DeclaredPriors]:
    """Read the prior files of a case's simulators; what is in them is checked with the models."""
    where = f"{folder / 'case.toml'}, [priors]"
    if not isinstance(named, dict) or not set(named) <= set(models):
        raise CalibError(
            f"it says {named!r}", where=where,
            expected=f'the name of a prior file for any of {", ".join(models)}',
            hint="correct the name of the output, or leave it out",
        )  # fmt: skip
    found = {}
    for output in named:
        path = _inside(folder, output, named)
        try:
            found[output] = DeclaredPriors(path.name, read_text(path))
        except (OSError, UnicodeDecodeError) as error:
            raise CalibError(
                f"the prior file cannot be read ({error})", where=f"{where}, {output}",
                hint="name a readable TOML file of the case's folder",
            ) from None  # fmt: skip
    return found


def _inside(folder: Path, key: str, content: Mapping[str, Any]) -> Path:
    """Return the path of a file of the case, which opens no others: it may be from elsewhere."""
    name = content[key]
    path = folder / str(name)
    if not isinstance(name, str) or not _is_inside(path, folder):
        raise CalibError(
            f"{key} = {name!r} is not a file of the case", where=str(folder / "case.toml"),
            expected="the name of a file in the case's folder, not reached by a link out of it",
            hint="put the file, or a copy of it, into the folder",
        )  # fmt: skip
    return path


def _is_inside(path: Path, folder: Path) -> bool:
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError):  # no path at all
        return False


def case_files(folder: Path) -> tuple[dict[str, Any], dict[str, Path]]:
    """Return what a ``case.toml`` says, and the files of the case; no content if it is not TOML.

    Parameters
    ----------
    folder : Path
        Of the case. Whether the other files are there is not looked at.
    """
    path = Path(folder) / "case.toml"
    try:
        content = read_toml(path)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        content = {}
    named = {key: content.get(key) for key in _FILES}
    priors = content.get("priors")
    named |= {f"priors.{k}": v for k, v in (priors if isinstance(priors, dict) else {}).items()}
    files = {
        key: path.parent / name
        for key, name in named.items()
        if isinstance(name, str) and _is_inside(path.parent / name, path.parent)
    }
    return content, {"case.toml": path} | files


def case_from_run(run: Path, field: Path) -> Case:
    """Make a case of an earlier calibration and a field campaign.

    Parameters
    ----------
    run : Path
        Run folder of `calib fit`.
    field : Path
        CSV with the model's conditions and its output.

    Raises
    ------
    CalibError
        If either cannot be read.
    """
    # Needs what writes and reads run folders, and that a sampler: no other case does.
    problem = import_module("calib.inference.io").load_calibration(run).problem
    problem.noise.must_be_usual(str(Path(run) / "priors.toml"), "a diagnosis")
    model = problem.bound.model
    output = output_of(model.output)
    table = read_table(field, allow_missing=tuple(OUTPUTS.values()))
    # The run's priors, which need not be the model's own.
    priors = {output: DeclaredPriors(f"{model.name}.toml", problem.priors.text)}
    return Case(Path(run).name, problem.table, table, {output: model.name}, priors=priors)
