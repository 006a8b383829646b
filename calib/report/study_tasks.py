"""What a study is of: outputs, the model and the rows of each, and those held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.data import Table, hold_out, read_for_model
from calib.data.quantities import OUTPUTS
from calib.data.table import parse_header, renamed
from calib.errors import CalibError
from calib.inference.prior_files import prior_file_model
from calib.models import MODELS, get_model
from calib.report.labels import degrees

# A report's figures and leave-one-out hold a number for every draw and row.
MAX_ROWS = 5000


@dataclass(frozen=True)
class HoldOut:
    """Rows kept for validation: a column as a header would name it, and its value."""

    column: str
    value: float

    def __str__(self) -> str:
        return f"{self.column} = {self.value:g}"

    @property
    def words(self) -> str:
        """What is held out, as a heading says it: the quantity, its value and unit."""
        column = parse_header(self.column)
        if column is None:
            return str(self)
        unit = degrees(column.unit.replace("**", "^").replace("*", " "))
        value = f"{column.quantity.word} {self.value:g}"
        return value if unit == "dimensionless" else f"{value} {unit}"

    @classmethod
    def parse(cls, text: str) -> HoldOut:
        """Read ``COLUMN=VALUE``, or raise a CalibError."""
        column, equals, value = text.partition("=")
        try:
            if not equals:
                raise ValueError
            parse_header(column.strip())
            return cls(column.strip(), float(value))
        except CalibError as error:
            raise CalibError(
                error.message, where=f"--hold-out {text}", expected=error.expected,
                hint="write one of these before the equals sign",
            ) from None  # fmt: skip
        except ValueError:
            raise CalibError(
                f"cannot read --hold-out {text!r}",
                expected="COLUMN=VALUE, for instance inflation_pressure_psi=30",
                hint="name a column with its unit, an equals sign and one number",
            ) from None

    def applies_to(self, table: Table) -> bool:
        """Whether a table has the column at all."""
        column = parse_header(self.column)
        return column is not None and column.quantity.canonical in table

    def split(self, table: Table) -> tuple[Table, Table]:
        """Return the rows that are left, and these; see `calib.data.hold_out`."""
        return hold_out(table, self.column, self.value)


def read_and_split(
    path: Path, columns: Sequence[str], kept: HoldOut | None
) -> tuple[Table, Table | None]:
    """Read a file, of which some columns are used; return the rows to fit and those held out."""
    table = read_for_model(path, columns)
    return kept.split(table) if kept else (table, None)


@dataclass(frozen=True)
class Task:
    """One output (a key of `OUTPUTS`) to calibrate; leave-one-out where no rows are held out."""

    output: str
    model: str
    table: Table
    held_out: HoldOut | None = None
    prior_path: Path | None = None


def choose_model(output: str, table: Table) -> str:
    """Pick the model of an output (a key of `OUTPUTS`) that suits a table.

    Of the models whose conditions are all there it is the one that makes use of most of those that
    vary; of several such, one that is not slow, the one of fewest conditions that do not vary, of
    fewest parameters, of fewest conditions, then the one known first. Which of them the data
    prefer, `calib.compare` says.

    Raises
    ------
    CalibError
        If no model of the output suits the table, with what those there are would need.
    """
    known = [m for m in MODELS.values() if m.output == OUTPUTS[output]]
    suited = [m for m in known if all(c in table for c in m.conditions)]
    if suited:
        varied = {c for m in suited for c in m.conditions if np.unique(table[c]).size > 1}
        uses = [
            (
                len(varied & set(m.conditions)),
                not m.slow,
                -len(set(m.conditions) - varied),
                -len(m.parameters),
                -len(m.conditions),
            )
            for m in suited
        ]
        return suited[uses.index(max(uses))].name
    conditions = {c for m in known for c in m.conditions}
    raise CalibError(
        f"no model of {output} suits the columns",
        where=table.source,
        expected="; ".join(f"{m.name}: {', '.join(m.conditions)}" for m in known)
        or "a model that is registered for this output",
        hint=f"{renamed(table.ignored, conditions)}add the columns of one of these models, "
        "declare a model of your own (--models), or report the other outputs (--only)",
    )


def plan_tasks(
    tables: Sequence[Table],
    held_out: HoldOut | None = None,
    *,
    models: Sequence[str] = (),
    prior_paths: Sequence[Path] = (),
    only: Sequence[str] = (),
) -> tuple[Task, ...]:
    """Find the outputs in some tables and choose a model for each.

    Models are used for their outputs, in the place of the ones the columns suggest; a prior file
    names the model it is for; `only` has outputs to work out (keys of `OUTPUTS`).

    Raises
    ------
    CalibError
        If no table has an output, two tables or two models have the same, none has the rows to
        hold out, a table is too long for a report, a name is unknown, or a model's output is in
        no table.
    """
    wanted: dict[str, str] = {}
    for name in models:
        other = wanted.setdefault(get_model(name).output, name)
        if other != name:
            raise CalibError(
                f"two models are given for the same output: {other}, {name}",
                expected="one model for each output",
                hint=f"report one of them; `calib compare {other} {name} FILE` tells which of them "
                "the data prefer",
            )
    priors = {prior_file_model(path): path for path in prior_paths}
    for name in only:
        if name not in OUTPUTS:
            raise CalibError(f"there is no output {name!r}", expected=", ".join(OUTPUTS))
    tasks: dict[str, Task] = {}
    for table in tables:
        if len(table) > MAX_ROWS:
            raise CalibError(
                f"{len(table)} rows are too many for a report",
                where=table.source,
                expected=f"up to {MAX_ROWS} rows",
                hint="use `calib fit` and `calib predict`, or thin the rows",
            )
        found = [key for key, column in OUTPUTS.items() if column in table]
        found = [key for key in found if not only or key in only]
        if not found:
            raise CalibError(
                "there is no output to calibrate",
                where=table.source,
                expected=", ".join(OUTPUTS.values()) + " (in any known unit)",
                hint=f"{renamed(table.ignored, OUTPUTS.values())}add a column with the measured "
                "output",
            )
        for key in found:
            if key in tasks:
                raise CalibError(
                    f"two files give the output {key}",
                    where=f"{tasks[key].table.source}, {table.source}",
                    hint="report one of them, or join them into one file",
                )
            rows = table.take(np.isfinite(table[OUTPUTS[key]]))
            usable = held_out if held_out is not None and held_out.applies_to(rows) else None
            model = wanted.get(OUTPUTS[key]) or choose_model(key, rows)
            tasks[key] = Task(key, model, rows, usable, priors.get(model))
    planned = tuple(tasks[key] for key in OUTPUTS if key in tasks)
    for column, name in wanted.items():
        if column not in {OUTPUTS[task.output] for task in planned}:
            raise CalibError(
                f"the model {name} is for {column}, which is not reported",
                where=", ".join(table.source for table in tables),
                expected=f"models of {', '.join(task.output for task in planned)}",
                hint=f"leave it out, or give a file with {column}",
            )
    if held_out is not None:
        _check_held_out(planned, held_out)
    return planned


def _check_held_out(tasks: Sequence[Task], held_out: HoldOut) -> None:
    """Check that the rows to hold out are there for one output at least."""
    refusals = []
    for task in tasks:
        try:
            held_out.split(task.table)
        except CalibError as error:
            refusals.append(error)
    if len(refusals) == len(tasks):
        raise refusals[0]


def fitted_rows(task: Task) -> tuple[Table, Table | None]:
    """Return the rows that are fitted, and those held out."""
    if task.held_out is None:
        return task.table, None
    return task.held_out.split(task.table)
