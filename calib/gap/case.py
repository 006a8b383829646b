"""A case of a diagnosis: its campaigns, models, declared covariates and context.

A folder with a ``case.toml``::

    calibration = "lab.csv"
    field = "field.csv"
    predict = "fresh.csv"              # optional: conditions to predict
    [models]
    drawbar_pull = "magic_formula"
    [priors]                           # optional: a prior file of the folder, by output
    [covariates]                       # optional: recorded conditions that no simulator takes
    tyre_age_weeks = "number"
    operator = "category"              # or its values, ["A. Lind", "B. Berg"]
    [context]                          # optional: what is known before the diagnosis
    same_soil = true
    suspected = {lug_thrust = 0.5}
    excluded = ["sensor_drift"]
    sizes = {force_offset = {offset = {mean = 0.1, sd = 0.02}}}

A context changes the prior probabilities, never the data.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calib.arguments import takes
from calib.data import Table, read_table
from calib.data.files import TOML_HINT, read_text, read_toml
from calib.data.quantities import OUTPUTS, output_of
from calib.data.reader import common_label
from calib.data.table import MAX_TEXT_ROWS, parse_header
from calib.errors import CalibError, in_words, meant
from calib.gap.constants import SHIFT_PRIOR
from calib.inference.prior_files import DeclaredPriors
from calib.models.base import Array

NUMBER: tuple[str, ...] = ()  # in the place of the values of a category


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Size(_Strict):
    """A parameter of an effect as it is known: mean and sd, in its own unit."""

    mean: Annotated[float, Field(ge=-1e15, le=1e15)]
    sd: Annotated[float, Field(gt=1e-15, le=1e15)]


class Context(_Strict):
    """What is known of a case beyond its data.

    Parameters
    ----------
    same_soil : bool, optional
        Whether field and laboratory have the same soil. It sets the sizes of parameter shifts and,
        unless `suspected` does, their probability.
    suspected : mapping of str to float
        Prior probability that a cause acts, whatever else acts.
    excluded : list of str
        Causes that cannot have acted.
    sizes : mapping of str to mapping of str to Size
        Effect to parameter to its known size.
    """

    same_soil: Annotated[bool | None, Field(strict=True)] = None
    suspected: dict[str, Annotated[float, Field(gt=0.0, lt=1.0)]] = {}
    excluded: list[str] = []
    sizes: dict[str, dict[str, Size]] = {}

    @model_validator(mode="before")
    @classmethod
    def _shift_of_soil(cls, content: Any) -> Any:
        same = content.get("same_soil") if isinstance(content, Mapping) else None
        if not isinstance(same, bool) or not isinstance(content.get("suspected", {}), Mapping):
            return content
        usual = {"parameter_shift": SHIFT_PRIOR[same]}
        return {**content, "suspected": usual | {**content.get("suspected", {})}}

    def __bool__(self) -> bool:
        return bool(self.suspected or self.excluded or self.sizes)

    @property
    def names(self) -> tuple[str, ...]:
        """Every cause it mentions."""
        return tuple(dict.fromkeys([*self.suspected, *self.excluded, *self.sizes]))

    def words(self, units: Mapping[tuple[str, str], str] | None = None) -> list[str]:
        """Say what was put in; sizes with the units of (effect, parameter), if they are given."""
        suspected, said = dict(self.suspected), []
        if self.same_soil is not None:
            said.append("the same soil" if self.same_soil else "another soil")
            if suspected["parameter_shift"] == SHIFT_PRIOR[self.same_soil]:
                usual = suspected.pop("parameter_shift")
                said[-1] += f" (prior probability of a parameter shift {usual:g})"
        said += [f"{n.replace('_', ' ')} suspected ({p:g})" for n, p in suspected.items()]
        said += [f"{name.replace('_', ' ')} excluded" for name in self.excluded]
        said += [
            f"{name.replace('_', ' ')}: {parameter} {size.mean:g} ± {size.sd:g}"
            f"{(units or {}).get((name, parameter), '')}"
            for name, known in self.sizes.items()
            for parameter, size in known.items()
        ]
        return said


class CaseFile(_Strict):
    """The content of a ``case.toml``."""

    calibration: str
    field: str
    predict: str | None = None
    models: Annotated[dict[str, str], Field(min_length=1)]
    priors: dict[str, str] = {}
    covariates: dict[str, str | list[str]] = {}
    context: Context | None = None
    simulations: dict[str, str] = {}
    answer_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None


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
        What a reader must know about the origin of the data.
    context : Context
        What is known beyond the data.
    priors : mapping of str to DeclaredPriors
        By output, in the place of the model's own.
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
        """How its data must be labelled wherever they are shown; usually empty."""
        return common_label(self.lab, self.field)


@takes(folder=PathLike)
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

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> case = calib.read_case(Path("cases/nominal_slip"))  # doctest: +SKIP
    >>> dict(case.models)  # doctest: +SKIP
    """
    folder = Path(folder)
    path = folder / "case.toml"
    written = _read_file(path)
    strange = [key for key in written.models if key not in OUTPUTS]
    if strange:
        raise CalibError(
            f"unknown output {', '.join(strange)}",
            where=f"{path}, [models]",
            expected=", ".join(OUTPUTS),
            hint="correct the name",
        )
    missing_ok = tuple(OUTPUTS.values())
    lab = read_table(inside(folder, "calibration", written.calibration), allow_missing=missing_ok)
    field = read_table(inside(folder, "field", written.field), allow_missing=missing_ok)
    new = read_table(inside(folder, "predict", written.predict)) if written.predict else None
    priors = read_priors(folder, written)
    tables = (lab, field) if new is None else (lab, field, new)
    own = declared_covariates(written.covariates, tables)
    return Case(
        folder.name,
        with_declared(lab, own),
        with_declared(field, own),
        written.models,
        None if new is None else with_declared(new, own),
        (),
        written.context or Context(),
        priors,
        own,
    )


def _read_file(path: Path) -> CaseFile:
    try:
        content = read_toml(path)
    except OSError as error:
        folder = path.parent
        raise CalibError(
            f"the case cannot be read ({error.strerror})",
            where=str(path),
            hint=f"give its folder: {folder.parent}"
            if (folder.parent / "case.toml").is_file()
            else "it is a run folder: write a case.toml beside the two tables, or use "
            "`calib diagnose --run RUN --field CSV`"
            if (folder / "run.json").is_file()
            else "give a folder with a case.toml in it",
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibError(f"not valid TOML: {error}", where=str(path), hint=TOML_HINT) from None
    keys = list(CaseFile.model_fields)
    if unknown := [key for key in content if key not in keys]:
        raise CalibError(
            f"unknown key {unknown[0]}",
            where=str(path),
            expected=", ".join(keys),
            hint=meant(unknown[0], keys, "correct its name, or leave it out"),
        )
    context = read_context(content.pop("context", None), str(path))
    try:
        return CaseFile.model_validate({**content, "context": context})
    except ValidationError as error:
        first = error.errors()[0]
    if first["loc"][0] == "covariates":
        found = f"{first['loc'][:2][-1]} = {first['input']!r}"
        raise _undeclared(found, 'write, for example, operator = "category"')
    raise CalibError(
        in_words(first),
        where=f"{path}, {first['loc'][0]}",
        expected='calibration = "lab.csv", field = "field.csv", [models] output = "model", and in '
        "[priors] the name of a prior file of the case",
        hint="add or correct it",
    )


def read_context(content: Any, where: str) -> Context:
    """Check the table ``[context]`` of a ``case.toml``."""
    try:
        context = Context.model_validate({} if content is None else content)
    except ValidationError as error:
        first = error.errors()[0]
        place, key = ".".join(str(part) for part in first["loc"]), next(map(str, first["loc"]), "")
        unknown = first["type"] == "extra_forbidden" and len(first["loc"]) == 1
        raise CalibError(
            f"unknown key {key}" if unknown else in_words(first),
            where=f"{where}, context.{place}",
            expected="same_soil = true or false, suspected = {name = probability}, "
            "excluded = [names], sizes = {name = {parameter = {mean = …, sd = …}}}",
            hint=meant(key, [*Context.model_fields], "correct its name, or leave it out")
            if unknown
            else "write, for example: "
            + {
                "same_soil": "same_soil = true",
                "excluded": 'excluded = ["sensor_drift"]',
                "sizes": "sizes = {force_offset = {offset = {mean = 0.1, sd = 0.02}}}",
            }.get(key, "suspected = {lug_thrust = 0.5}"),
        ) from None
    if twice := set(context.suspected) & set(context.excluded):
        raise CalibError(
            f"{min(twice)} is both suspected and excluded",
            where=f"{where}, [context]",
            hint="leave one of the two out",
        )
    return context


def read_priors(folder: Path, written: CaseFile) -> dict[str, DeclaredPriors]:
    """Read the prior files of a case's simulators; what is in them is checked with the models."""
    where = f"{folder / 'case.toml'}, [priors]"
    found = {}
    for output, name in written.priors.items():
        if output not in written.models:
            raise CalibError(
                f"it says {output} = {name!r}, but no model predicts {output}",
                where=where,
                expected=f"the name of a prior file for any of {', '.join(written.models)}",
                hint="correct the name of the output, or leave it out",
            )
        path = inside(folder, output, name)
        try:
            found[output] = DeclaredPriors(path.name, read_text(path))
        except (OSError, UnicodeDecodeError) as error:
            raise CalibError(
                f"the prior file cannot be read ({error})",
                where=f"{where}, {output}",
                hint="name a readable TOML file of the case's folder",
            ) from None
    return found


def inside(folder: Path, key: str, name: str) -> Path:
    """Return the path of a file of the case, which opens no others: it may be from elsewhere."""
    path = folder / name
    if not _is_inside(path, folder):
        raise CalibError(
            f"{key} = {name!r} is not a file of the case",
            where=str(folder / "case.toml"),
            expected="the name of a file in the case's folder, not reached by a link out of it",
            hint="put the file, or a copy of it, into the folder",
        )
    return path


def _is_inside(path: Path, folder: Path) -> bool:
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError):  # no path at all
        return False


def case_files(folder: Path) -> tuple[dict[str, Any], dict[str, Path]]:
    """Return the content of a ``case.toml``, and the files of the case; no content if not TOML.

    Parameters
    ----------
    folder : Path
        Of the case. The other files may be missing.
    """
    path = Path(folder) / "case.toml"
    try:
        content = read_toml(path)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        content = {}
    named = {key: content.get(key) for key in ("calibration", "field", "predict")}
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
    problem.noise.must_be_normal_of_one_sd(str(Path(run) / "priors.toml"))
    model = problem.bound.model
    output = output_of(model.output)
    table = read_table(field, allow_missing=tuple(OUTPUTS.values()))
    # The run's priors, which need not be the model's own.
    priors = {output: DeclaredPriors(f"{model.name}.toml", problem.priors.text)}
    return Case(Path(run).name, problem.table, table, {output: model.name}, priors=priors)


def declared_covariates(
    content: Mapping[str, str | Sequence[str]], tables: Sequence[Table]
) -> dict[str, tuple[str, ...]]:
    """Return the declared columns and the values of each category; none for numbers."""
    found: dict[str, tuple[str, ...]] = {}
    for name, kind in content.items():
        if _is_known(name):
            raise _undeclared(
                f"{name} is a quantity that is known",
                "leave it out: a known condition is taken into account by itself",
            )
        if kind == "number":
            found[name] = NUMBER
            continue
        if (isinstance(kind, str) and kind != "category") or not kind:
            raise _undeclared(f"{name} = {kind!r}", "say which it is")
        seen = sorted({cell for table in tables for cell in _column(table, name)} - {""})
        levels = tuple(dict.fromkeys(seen if isinstance(kind, str) else kind))
        if not 1 < len(levels) <= 12:
            raise _undeclared(
                f"{name} has {len(levels)} different values, not 2 to 12",
                "group them, declare a number, or leave it out",
            )
        found[name] = levels
    return found


def with_declared(table: Table, covariates: Mapping[str, tuple[str, ...]]) -> Table:
    """Add declared columns to a table: numbers, and categories as their place in the list."""
    if not covariates:
        return table
    added = {name: _codes(table, name, levels) for name, levels in covariates.items()}
    ignored = tuple(name for name in table.ignored if name not in covariates)
    return replace(table, columns={**table.columns, **added}, ignored=ignored)


def words_of(covariates: Mapping[str, tuple[str, ...]], name: str, low: float, high: float) -> str:
    """Return the values of a category between two places of its list; empty for numbers."""
    return ", ".join(covariates.get(name, ())[int(round(low)) : int(round(high)) + 1])


def new_values(covariates: Mapping[str, tuple[str, ...]], lab: Table, field: Table) -> list[str]:
    """Say which values of categories occur in the field only."""
    said = []
    for name, levels in covariates.items():
        new = [levels[int(j)] for j in np.setdiff1d(field[name], lab[name])] if levels else []
        if new:
            said.append(
                f"{name}: {', '.join(new)} in the field only; a constant difference of these rows "
                "cannot be separated from anything else that all of them share"
            )
    return said


def cells(
    columns: Mapping[str, Array], covariates: Mapping[str, tuple[str, ...]]
) -> dict[str, Array | list[str]]:
    """Return columns as they are to be written: categories by their names."""
    return {
        name: [covariates[name][int(code)] for code in values] if covariates.get(name) else values
        for name, values in columns.items()
    }


def _is_known(name: str) -> bool:
    try:
        return parse_header(name) is not None
    except CalibError:  # a quantity in an unknown unit
        return True


def _column(table: Table, name: str) -> list[str]:
    if name not in table.header:
        raise CalibError(
            f"there is no column {name!r}",
            where=table.source,
            expected="every column that the case declares in [covariates]",
            hint="add it; before a diagnosis it can be left out of case.toml as well",
        )
    if not table.text:
        raise _undeclared(
            f"{table.source} has {len(table)} rows, more than the {MAX_TEXT_ROWS} allowed where "
            "columns are declared",
            "thin the rows",
        )
    j = table.header.index(name)
    return [row[j].strip() for row in table.text]


def _codes(table: Table, name: str, levels: tuple[str, ...]) -> Array:
    values = np.empty(len(table))
    for i, cell in enumerate(_column(table, name)):
        try:
            values[i] = levels.index(cell) if levels else float(cell)
        except ValueError:
            values[i] = np.nan
        if not cell or not np.isfinite(values[i]):
            raise CalibError(
                f"{name} is {cell!r}",
                where=f"{table.source}, line {table.lines[i]}",
                expected=", ".join(levels) or "a number, with a decimal point",
                hint="write one of these" if levels else "correct it, or delete the row",
            )
    return values


def _undeclared(found: str, hint: str) -> CalibError:
    return CalibError(
        found,
        where="[covariates] of case.toml",
        expected='columns of other than known quantities, each "number", "category" or a list of '
        "its 2 to 12 values",
        hint=hint,
    )
