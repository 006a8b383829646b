"""The commands `diagnose`, `models`, `effects` and `quantities`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish
from calib.errors import CalibError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from calib.report.labels import Facts


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
    effects: Annotated[
        Path | None, typer.Option(help="Python file with effects of this diagnosis alone.")
    ] = None,
    overwrite: opt.Overwrite = False,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Find where a calibrated model misses, which effect it lacks, how far adding it gains."""
    from functools import partial

    from calib.batch.folders import claimed, fresh_folder
    from calib.batch.pool import pool

    ctx.with_resource(claimed(out, overwrite=overwrite))
    from calib.batch.foreign import keep
    from calib.cli.options import progress_bars
    from calib.cli.simulators import keep_emulators, prepare_case, say
    from calib.data.quantities import OUTPUTS, QUANTITIES
    from calib.gap.batch import INPUTS, inputs_record
    from calib.gap.case import case_from_run, read_case
    from calib.gap.diagnose import diagnose as find
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.user import check_effects, load_effects
    from calib.gap.files import write_diagnosis
    from calib.report.gap_evidence import gap_verdict
    from calib.report.gap_facts import track_record_text
    from calib.report.numbers import format_number

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
    files: dict[str, bytes] = {}
    if effects is not None:
        paths = [effects, *(e.prior_file for e in own.values() if e.prior_file is not None)]
        files = {path.name: path.read_bytes() for path in paths}
    considered = {**EFFECTS, **own}
    # The diagnosis looks at them too, but only after simulators have been emulated.
    check_effects(considered, given)
    with progress_bars() as tell:
        emulations = prepare_case(given, run, seed, workers, tell)
    told = [say(what, emulation) for what, emulation in emulations]
    manifest = {"seed": seed, "command": opt.command()}
    own_files = [] if effects is None else [effects]
    with pool(workers, own_files) as side:
        found = find(given, seed, effects=considered, pool=side)
        keep("diagnosis", partial(write_diagnosis, found))
        from calib.report.page.diagnosis import begin_page

        write_page = begin_page(found, manifest, pool=side)
        with fresh_folder(out, overwrite=overwrite) as folder:
            write_diagnosis(found, folder)
            keep_emulators(given.models.values(), folder)
            (folder / INPUTS).write_bytes(inputs_record(found.data.case, seed, files))
            write_page(folder)
    for warning in found.warnings:
        print(f"calib: {warning}", file=sys.stderr)
    judged = gap_verdict(found)
    print(f"verdict: {found.verdict} ({judged.headline})")
    for name in found.ranking.order[:4]:
        p = found.ranking.probability[name]
        text = ">0.999" if p >= 0.9995 else "<0.001" if p < 0.0005 else f"{p:.3f}"
        print(f"  {text:>6}  {name}")
    print(track_record_text(found.ranking.probability[found.ranking.order[0]]))
    for output, s in found.shrink.items():
        low, high = s.interval
        unit = QUANTITIES[OUTPUTS[output]].unit_word
        print(
            f"{output}: error {format_number(s.rmse_before)} -> {format_number(s.rmse_after)} "
            f"{unit} rms, shrink {100 * s.fraction:.0f} % (90 % interval {100 * low:.0f} to "
            f"{100 * high:.0f} %), noise sd {format_number(s.noise_floor)} {unit}"
        )
    for label, said in judged.facts:
        if label in ("Not tested", "Assumed"):
            print(f"{label.lower()}: {said}")
    print(out / "index.html")
    finish(
        0 if all(told) else 3, out / "diagnosis.json", folder=str(out),
        warnings=list(found.warnings),
    )  # fmt: skip


Name = Annotated[str | None, typer.Argument(help="One of them: all that is declared of it.")]


def models(
    name: Name = None, plugins: opt.Models = None, simulator: opt.Simulators = None,
    json: Json = False,
) -> None:  # fmt: skip
    """List the models with their equations and columns; of one also limits and priors."""
    from calib.models import MODELS, get_model
    from calib.report.labels import model_facts

    if name is not None:
        _tell("models", {name: get_model(name)}, model_facts)
        return
    for model in MODELS.values():
        print(f"{model.name}: {model.title}\n  {model.equation}")
        print(f"  needs {', '.join(model.conditions)}; gives {model.output}")
    facts = ("title", "equation", "conditions", "output", "parameters")
    finish(0, {"models": {m.name: {f: getattr(m, f) for f in facts} for m in MODELS.values()}})


def effects(
    name: Name = None,
    effects: Annotated[
        Path | None, typer.Option("--effects", help="Python file with effects of your own.")
    ] = None,
    plugins: opt.Models = None,
    json: Json = False,
) -> None:
    """List the effects that a diagnosis knows; of one also equation, what it needs, and priors."""
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.user import load_effects
    from calib.report.labels import declared, effect_facts, role_columns

    known = {**EFFECTS, **({} if effects is None else load_effects(effects))}
    if name is not None:
        _tell("effects", {name: declared("effect", known, name)}, effect_facts)
        return
    found = {}
    for effect in known.values():
        outputs = role_columns(effect.outputs, output=True)
        covariates = role_columns(effect.covariates, output=False)
        print(f"{effect.name}: {effect.title}")
        print(f"  on {', '.join(outputs)}; needs {', '.join(covariates) or 'nothing more'}")
        found[effect.name] = {
            "title": effect.title, "outputs": outputs, "covariates": covariates,
        }  # fmt: skip
    finish(0, {"effects": found})


def quantities(name: Name = None, plugins: opt.Models = None, json: Json = False) -> None:
    """List the quantities that a column may hold; of one also its units and who uses it."""
    from calib.data.quantities import QUANTITIES
    from calib.data.table import parse_header
    from calib.report.labels import declared, quantity_facts

    if name is not None:
        stems = {s: c for c, q in QUANTITIES.items() for s in (q.stem, *q.synonyms)}
        column = None if name in stems else parse_header(name)
        canonical = stems.get(name, name) if column is None else column.quantity.canonical
        quantity = declared("quantity", QUANTITIES, canonical)
        _tell("quantities", {canonical: quantity}, quantity_facts)
        return
    found = {}
    for canonical, q in QUANTITIES.items():
        print(f"{canonical}: {q.description}\n  {q.role}, in {', '.join(q.units) or 'no unit'}")
        found[canonical] = {"description": q.description, "role": q.role, "units": [*q.units]}
    finish(0, {"quantities": found})


def _tell[T](what: str, chosen: Mapping[str, T], facts_of: Callable[[T], Facts]) -> None:
    """Print all that is declared of one."""
    ((name, one),) = chosen.items()
    facts = facts_of(one)
    print(f"{name}: {facts['title']}")
    for label, value in facts.items():
        if label == "title" or not value:
            continue
        if isinstance(value, dict):
            print(f"  {label}")
            for key, part in value.items():
                print(f"    {key}: {part if isinstance(part, str) else '; '.join(part.values())}")
        else:
            print(f"  {label}: {value if isinstance(value, str) else ', '.join(value)}")
    finish(0, {what: {name: facts}})
