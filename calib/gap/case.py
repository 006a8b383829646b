"""A case of a diagnosis: its campaigns, models, declared covariates and context."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.data import Table, read_table
from calib.data.files import MEND_TOML, read_text, read_toml
from calib.data.quantities import OUTPUTS, output_of
from calib.data.reader import common_label
from calib.data.table import MAX_TEXT_ROWS, parse_header
from calib.errors import CalibError, in_words, meant
from calib.inference.prior_files import DeclaredPriors
from calib.inference.priors import Prior, Priors
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.gap.hypotheses import Hypothesis

# What stands for the values of a column of numbers.
NUMBER: tuple[str, ...] = ()
_MOST_LEVELS = 12
_WHERE = "[covariates] of case.toml"


def declared_covariates(content: object, tables: tuple[Table, ...]) -> dict[str, tuple[str, ...]]:
    """Return the declared columns and the values of each category; none for numbers.

    Parameters
    ----------
    content : object
        Of the table ``[covariates]``.
    tables : tuple of Table
        In which every column must be.

    Raises
    ------
    CalibError
        If it declares what is known anyway, what is not there, or what is neither.
    """
    if not isinstance(content, dict):
        raise _error(f"it is {content!r}", "a table of names", 'write operator = "category"')
    found: dict[str, tuple[str, ...]] = {}
    for name, kind in content.items():
        if _is_known(name):
            raise _error(
                f"{name} is a quantity that is known",
                "columns of other names",
                "leave it out: a known condition is taken into account by itself",
            )
        given = kind if isinstance(kind, list) and all(isinstance(v, str) for v in kind) else None
        if kind not in ("number", "category") and not given:
            raise _error(
                f"{name} = {kind!r}",
                '"number", "category" or a list of its values',
                "say which it is",
            )
        if kind == "number":
            found[name] = NUMBER
            continue
        seen = sorted({cell for table in tables for cell in _column(table, name)} - {""})
        levels = tuple(dict.fromkeys(given or seen))
        if not 1 < len(levels) <= _MOST_LEVELS:
            raise _error(
                f"{name} has {len(levels)} different values",
                f"from 2 to {_MOST_LEVELS}",
                "group them, declare a number, or leave it out",
            )
        found[name] = levels
    return found


def with_declared(table: Table, covariates: Mapping[str, tuple[str, ...]]) -> Table:
    """Add declared columns to a table: numbers as they are, categories as their place in the list.

    Raises
    ------
    CalibError
        If one is not there, or holds something else.
    """
    if not covariates:
        return table
    added = {name: _codes(table, name, levels) for name, levels in covariates.items()}
    ignored = tuple(name for name in table.ignored if name not in covariates)
    return replace(table, columns={**table.columns, **added}, ignored=ignored)


def words_of(covariates: Mapping[str, tuple[str, ...]], name: str, low: float, high: float) -> str:
    """Say in its own words which values of a category lie between two places; empty for numbers."""
    return ", ".join(covariates.get(name, ())[int(round(low)) : int(round(high)) + 1])


def new_values(covariates: Mapping[str, tuple[str, ...]], lab: Table, field: Table) -> list[str]:
    """Say which values of categories the field has and the laboratory has not."""
    said = []
    for name, levels in covariates.items():
        if not levels:
            continue
        new = [levels[int(j)] for j in np.setdiff1d(field[name], lab[name])]
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
            f"there is no column {name!r}", where=table.source,
            expected="every column that the case declares in [covariates]",
            hint="add it; before a diagnosis it can be left out of case.toml as well",
        )  # fmt: skip
    if not table.text:
        raise _error(
            f"{table.source} has {len(table)} rows",
            f"{MAX_TEXT_ROWS} where columns are declared",
            "thin the rows",
        )
    j = table.header.index(name)
    return [row[j].strip() for row in table.text]


def _codes(table: Table, name: str, levels: tuple[str, ...]) -> Array:
    values = np.empty(len(table))
    for i, cell in enumerate(_column(table, name)):
        try:
            if not cell:
                raise ValueError
            values[i] = levels.index(cell) if levels else float(cell)
            if not np.isfinite(values[i]):
                raise ValueError
        except ValueError:
            raise CalibError(
                f"{name} is {cell!r}", where=f"{table.source}, line {table.lines[i]}",
                expected=", ".join(levels) or "a number, with a decimal point",
                hint="write one of these" if levels else "correct it, or delete the row",
            ) from None  # fmt: skip
    return values


def _error(found: str, allowed: str, hint: str) -> CalibError:
    return CalibError(found, where=_WHERE, expected=allowed, hint=hint)


# A known size that is so many sds (its own and its prior's) off may be in another unit.
_UNUSUAL = 4.0
_Number = Annotated[float, Field(ge=-1e15, le=1e15)]


class Size(BaseModel):
    """A parameter of an effect as it is known: mean and sd, in its own unit."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    mean: _Number
    sd: Annotated[float, Field(gt=1e-15, le=1e15)]


class _Written(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    suspected: dict[str, Annotated[float, Field(gt=0.0, lt=1.0)]] = {}
    excluded: list[str] = []
    sizes: dict[str, dict[str, Size]] = {}


@dataclass(frozen=True)
class Context:
    """What is put into a diagnosis besides its data.

    Parameters
    ----------
    suspected : mapping of str to float
        Prior probability that a cause acts, whatever acts besides.
    excluded : tuple of str
        Causes that cannot have acted.
    sizes : mapping of str to mapping of str to Size
        Effect to parameter to what is known of it.
    """

    suspected: Mapping[str, float] = field(default_factory=dict)
    excluded: tuple[str, ...] = ()
    sizes: Mapping[str, Mapping[str, Size]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.suspected or self.excluded or self.sizes)

    @property
    def names(self) -> tuple[str, ...]:
        """Every cause it speaks of."""
        return tuple(dict.fromkeys([*self.suspected, *self.excluded, *self.sizes]))

    def sized(self, single: Hypothesis) -> Hypothesis:
        """Return an effect with what is known of its size in the place of its prior.

        Raises
        ------
        CalibError
            If it has no such parameter, or the mean is not within the bounds of its prior.
        """
        known = self.sizes.get(single.name)
        if not known:
            return single
        (priors,) = single.effect_priors
        strange = set(known) - {p.name for p in priors.free}
        if strange:
            raise CalibError(
                f"{single.name} has no parameter {min(strange)!r}", where="[context] sizes",
                expected=", ".join(p.name for p in priors.free), hint="correct the name",
            )  # fmt: skip
        return replace(single, effect_priors=(_known(single.name, priors, known),))

    def unusual(self, single: Sequence[Hypothesis]) -> list[str]:
        """Say which sizes are far from what their effects usually have, as in another unit.

        Parameters
        ----------
        single : sequence of Hypothesis
            Effects by themselves, with their usual priors.
        """
        said = []
        for h in single:
            for p in h.effect_priors[0].free:
                size = self.sizes.get(h.name, {}).get(p.name)
                if size is None:
                    continue
                loc, scale = _on_its_scale(size, p)
                apart = abs(loc - p.loc) / float(np.hypot(scale, p.scale))
                if apart > _UNUSUAL:
                    low, high = (p.loc + s * p.scale for s in (-1.0, 1.0))
                    low, high = (float(np.exp(e)) if p.log else e for e in (low, high))
                    said.append(
                        f"[context] sizes: {h.name} is said to have {p.name} {size.mean:g} ± "
                        f"{size.sd:g}{_unit(p.unit)}, {apart:.0f} sds from what is usual "
                        f"({low:.3g} to {high:.3g}): check its sign and unit, for the diagnosis "
                        "takes it as it is"
                    )
        return said

    def words(self, single: Sequence[Hypothesis] = ()) -> list[str]:
        """Say what was put in, sizes in the units of the effects that are given."""
        units = {(h.name, p.name): _unit(p.unit) for h in single for p in h.effect_priors[0].free}
        said = [f"{n.replace('_', ' ')} suspected ({p:g})" for n, p in self.suspected.items()]
        said += [f"{name.replace('_', ' ')} excluded" for name in self.excluded]
        said += [
            f"{name.replace('_', ' ')}: {parameter} {size.mean:g} ± {size.sd:g}"
            f"{units.get((name, parameter), '')}"
            for name, known in self.sizes.items()
            for parameter, size in known.items()
        ]
        return said


def _unit(unit: str) -> str:
    return "" if unit in {"1", "dimensionless", ""} else f" {unit}"


def _on_its_scale(size: Size, p: Prior) -> tuple[float, float]:
    """Mean and sd, of the logarithm where the prior is of that."""
    return (float(np.log(size.mean)), size.sd / size.mean) if p.log else (size.mean, size.sd)


def _known(effect: str, priors: Priors, known: Mapping[str, Size]) -> Priors:
    entries = []
    for p in priors.entries:
        size = known.get(p.name)
        if size is None:
            entries.append(p)
            continue
        if p.log and size.mean <= 0.0:
            raise CalibError(
                f"{effect}: {p.name} is positive", where="[context] sizes",
                expected="a mean above zero", hint="correct it",
            )  # fmt: skip
        loc, scale = _on_its_scale(size, p)
        if not p.lower <= loc <= p.upper:
            low, high = (np.exp(end) if p.log else end for end in (p.lower, p.upper))
            raise CalibError(
                f"{effect}: {p.name} cannot be {size.mean:g}", where="[context] sizes",
                expected=f"a mean from {low:g} to {high:g}",
                hint="correct it, or declare an effect of your own with another prior",
            )  # fmt: skip
        entries.append(replace(p, loc=loc, scale=scale))
    return Priors(tuple(entries), priors.text, priors.source)


def read_context(content: Any, where: str) -> Context:
    """Check the table ``[context]`` of a ``case.toml``.

    Parameters
    ----------
    content : Any
        The table, or None where there is none.
    where : str
        Its file, for messages.

    Raises
    ------
    CalibError
        Naming the entry, and what is allowed there.
    """
    if content is None:
        return Context()
    try:
        written = _Written.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise CalibError(
            in_words(first), where=f"{where}, context.{place}",
            expected="suspected = {name = probability}, excluded = [names], "
            "sizes = {name = {parameter = {mean = …, sd = …}}}",
            hint="write, for example: suspected = {lug_thrust = 0.5} and, in the next line, "
            'excluded = ["sensor_drift"]',
        ) from None  # fmt: skip
    twice = set(written.suspected) & set(written.excluded)
    if twice:
        raise CalibError(
            f"{min(twice)} is both suspected and excluded", where=f"{where}, [context]",
            hint="leave one of the two out",
        )  # fmt: skip
    return Context(written.suspected, tuple(written.excluded), written.sizes)


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
