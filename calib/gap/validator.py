"""What is wrong with a case: everything at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from calib.data import Table, read_table
from calib.data.documents import invalid, read_numbers
from calib.data.files import read_toml
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import (
    Case,
    CaseFile,
    Context,
    declared_covariates,
    inside,
    read_priors,
    with_declared,
)
from calib.gap.effects import EFFECTS
from calib.gap.hypotheses import with_case_effects
from calib.gap.ranking import check_names
from calib.models import MODELS, get_model

TABLES = ("calibration", "field", "predict")


def faults(folder: Path) -> list[CalibError]:
    """Return what is wrong with a case folder.

    Returns
    -------
    list of CalibError
        With file, line and column; none of what follows the format.

    Raises
    ------
    CalibError
        If there is no ``case.toml``, or it is no TOML.
    """
    found: list[CalibError] = []
    folder = Path(folder)
    path, written = folder / "case.toml", None
    try:
        content = read_toml(path)
        written = CaseFile.model_validate(content)
    except ValidationError as error:
        found += invalid(error, str(path))
    except (OSError, ValueError) as error:
        raise CalibError(
            f"it cannot be read: {error}", where=str(path),
            hint="give a case folder, or a run folder and a CSV",
        ) from None  # fmt: skip
    if (folder / "answer.json").exists():
        found.append(CalibError("the answer lies in the case that it answers", where=str(folder)))
    tables: dict[str, Table] = {}
    named = {key: name for key in TABLES if isinstance(name := content.get(key), str)}
    for key, name in named.items():
        with _noting(found):
            missing_ok = tuple(OUTPUTS.values()) if key != "predict" else ()
            tables[key] = read_table(inside(folder, key, name), allow_missing=missing_ok)
    if written is None:
        return found
    for output, model in {**dict.fromkeys(written.simulations, ""), **written.models}.items():
        try:
            _check_model(output, model, output in written.simulations)
        except CalibError as error:
            found.append(error.within(f"{path}, {output}"))
    if tables.keys() == named.keys():
        _check_tables(found, folder, written, tables)
    return list({str(fault): fault for fault in found}.values())


@contextmanager
def _noting(found: list[CalibError]) -> Iterator[None]:
    try:
        yield
    except CalibError as error:
        found += error.each or (error,)


def _check_model(output: str, model: str, simulated: bool) -> None:
    if output not in OUTPUTS:
        raise CalibError(f"{output} is no output", expected=", ".join(OUTPUTS))
    if not model:
        raise CalibError("there is no model of it", hint="name its simulator in [models]")
    if not simulated:
        get_model(model)  # one that calib does not have takes part by what it predicts


def _check_tables(
    found: list[CalibError], folder: Path, written: CaseFile, tables: dict[str, Table]
) -> None:
    wanted = [f"{key}_{row}" for key, table in tables.items() for row in range(len(table))]
    for output, name in written.simulations.items():
        with _noting(found):
            read_numbers(inside(folder, output, name), wanted, None)
    known = {o: model for o, model in written.models.items() if o in OUTPUTS and model in MODELS}
    with _noting(found):
        own = declared_covariates(written.covariates, [*tables.values()])
        lab, field, *new = (with_declared(table, own) for table in tables.values())
        priors = read_priors(folder, written)
        context = written.context or Context()
        case = Case(folder.name, lab, field, known, next(iter(new), None), (), context, priors, own)
        ready = []
        for output, model in known.items():
            with _noting(found):
                ready.append(campaigns(replace(case, models={output: model})))
        for data in ready[:1] if len(ready) == len(known) else ():
            check_names(context, {*with_case_effects(data, EFFECTS)})
    for output in written.models.keys() - known.keys():
        for key in ("calibration", "field"):
            with _noting(found):
                tables[key].must_have(*[OUTPUTS[output]] if output in OUTPUTS else ())
