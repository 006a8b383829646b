"""The command `diagnose`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish, progress_bars, say
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.data import Table
    from calib.gap.case import Case
    from calib.inference.emulation import Emulation


def diagnose(
    ctx: typer.Context,
    case: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with a case.toml; its table context takes what is suspected or excluded."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("calib-diagnosis"),
    seed: opt.Seed = 1,
    run: Annotated[Path | None, typer.Option(help="Run folder of `calib fit`.")] = None,
    field: Annotated[Path | None, typer.Option(help="CSV of the field campaign.")] = None,
    effects: opt.EffectsFile = None,
    overwrite: opt.Overwrite = False,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Find where a calibrated model misses, which effect it lacks, how far adding it gains."""
    from functools import partial

    from calib.batch.folders import claimed, fresh_folder, keep
    from calib.batch.pool import pool
    from calib.batch.user_code import run_file
    from calib.gap.batch import INPUTS, inputs_record
    from calib.gap.case import case_from_run, read_case
    from calib.gap.describe import gap_document
    from calib.gap.diagnose import diagnose as diagnose_case
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.user import check_effects, load_effects
    from calib.gap.files import write_diagnosis
    from calib.models import get_model
    from calib.models.simulators.emulator import emulator_of, save_emulator
    from calib.report.gap_words import Words
    from calib.report.page.diagnosis import write_page

    ctx.with_resource(claimed(out, overwrite=overwrite))
    if case is not None and run is None and field is None:
        given = read_case(case)
    elif case is None and run is not None and field is not None:
        given = case_from_run(run, field)
    else:
        raise CalibError(
            "it is not clear what to diagnose",
            expected="a case folder, or --run RUN together with --field CSV",
            hint="give one of the two",
        )
    own = {} if effects is None else load_effects(effects)
    files = [] if effects is None else [effects]
    files += [e.prior_file for e in own.values() if e.prior_file is not None]
    considered = {**EFFECTS, **own}
    # The diagnosis looks at them too, but only after simulators have been emulated.
    check_effects(considered, given)
    emulations = prepare_case(given, run, seed, workers)
    with pool(workers, {} if effects is None else {effects: run_file}) as side:
        found = diagnose_case(given, seed, effects=considered, pool=side)
    keep("diagnosis", partial(write_diagnosis, found))
    document = gap_document(found, command=opt.command())
    with fresh_folder(out, overwrite=overwrite) as folder:
        write_diagnosis(found, folder, document)
        for model in given.models.values():
            if (emulator := emulator_of(get_model(model))) is not None:
                save_emulator(emulator, model, folder / "emulators" / f"{model}.npz")
        contents = {path.name: path.read_bytes() for path in files}
        (folder / INPUTS).write_bytes(inputs_record(found.data.case, seed, contents))
        write_page(document, folder)
    for warning in found.warnings:
        announce(warning)
    print(Words(document).terminal())
    print(out / "index.html")
    code = 0 if all(e.passed for e in emulations) else 3
    finish(code, out / "diagnosis.json", folder=str(out), warnings=list(found.warnings))


def prepare_case(case: Case, run: Path | None, seed: int, workers: int) -> list[Emulation]:
    """Emulate the slow simulators of a case for both of its campaigns; say how good each is."""
    import numpy as np

    from calib.data.quantities import OUTPUTS
    from calib.gap.campaigns import campaigns
    from calib.inference.emulation.prepared import prepare, prepare_field, reaches
    from calib.models.simulators.declaration import simulated_by
    from calib.models.simulators.files import load_files

    if run is None and not any(map(simulated_by, case.models.values())):
        return []
    campaigns(case)  # refuses, before any run is made, what cannot be diagnosed
    found: dict[str, Emulation | None] = {}
    others = [case.field, *([] if case.new_conditions is None else [case.new_conditions])]

    def measured(table: Table, column: str) -> Table:
        return table.take(np.isfinite(table[column]))

    with progress_bars() as tell:
        for output, model in case.models.items():
            column, priors = OUTPUTS[output], case.priors.get(output)
            if run is not None and (run / "emulator.npz").exists():
                load_files([run / "emulator.npz"])
            if not reaches(model, [case.lab, *others]):
                found[model] = prepare(
                    model, measured(case.lab, column), seed, priors=priors, elsewhere=others,
                    workers=workers, progress=tell,
                )  # fmt: skip
            found[f"{model}, field"] = prepare_field(
                model, measured(case.field, column), seed, priors=priors, workers=workers,
                progress=tell,
            )  # fmt: skip
    emulations = {what: emulation for what, emulation in found.items() if emulation is not None}
    for what, emulation in emulations.items():
        say(what, emulation)
    return list(emulations.values())
