"""The commands `data`, `template`, `priors`, `models`, `effects` and `quantities`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.report.labels import Facts


def data(
    name: Annotated[str, typer.Argument(help="he2019 or he2019-gaps")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder to write; by default named after the data."),
    ] = None,
    overwrite: opt.Overwrite = False,
) -> None:
    """Write the embedded, reconstructed data as CSV files, or as cases for `calib diagnose`."""
    from calib.he2019 import embedded
    from calib.he2019.gaps import paper_gaps, write_cases

    names = ("he2019", "he2019-gaps")
    if name not in names:
        wrong, hint = f"there is no data set {name!r}", "use one of these"
        raise CalibError(wrong, expected=", ".join(names), hint=hint)
    folder = Path(name) if out is None else out
    files = (f"{key}.csv" for key in embedded.tables())
    existing = [f for f in files if name == "he2019" and (folder / f).exists()]
    if existing and not overwrite:
        wrong = f"{', '.join(existing)} exist there already"
        hint = "choose another --out, or pass --overwrite"
        raise CalibError(wrong, where=str(folder), hint=hint)
    try:
        if name == "he2019":
            written = embedded.write(folder)
        else:
            written = write_cases(paper_gaps(), folder, overwrite=overwrite)
    except OSError as error:
        raise _unwritable("folder", folder, error) from None
    for path in written:
        print(f"{path} (reconstructed from published results, not measured)")


def template(
    model: opt.OneModel,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="CSV to write; by default printed.")
    ] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
) -> None:
    """Write an example CSV for a model, to fill in."""
    from calib.models import get_model, template_csv

    text = template_csv(get_model(model).name)
    _emit(text, out)
    if "run_order" in text:
        announce(
            "run_order may be left out: number the rows as they were measured, or delete the column"
        )


def priors(
    model: opt.OneModel,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="TOML to write; by default printed.")
    ] = None,
    from_tir: Annotated[
        Path | None,
        typer.Option(help="Tyre property file to put the priors of magic_formula about."),
    ] = None,
    from_run: Annotated[
        Path | None,
        typer.Option(help="Run of another model on the same soil, whose posterior is the prior."),
    ] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
) -> None:
    """Write a model's shipped priors, to edit."""
    from calib.inference.prior_files import default_priors
    from calib.models import get_model

    name = get_model(model).name
    if from_run is not None:
        from calib import load_calibration
        from calib.inference.prior_files import priors_from_posterior

        _emit(priors_from_posterior(name, load_calibration(from_run), from_run.name), out)
        return
    if from_tir is None:
        _emit(default_priors(name).read_text(encoding="utf-8"), out)
        return
    from calib import read_tir
    from calib.inference.tyre import priors_from_tir

    if name != "magic_formula":
        raise CalibError(
            f"a tyre property file gives no priors of {name}", where="--from-tir",
            expected="the model magic_formula", hint="name that, or leave --from-tir out",
        )  # fmt: skip
    _emit(priors_from_tir(read_tir(from_tir)), out)


def _emit(text: str, out: Path | None) -> None:
    if out is None:
        sys.stdout.write(text)
        return
    from calib.batch.folders import write_whole

    try:
        if out.exists():
            raise CalibError("the file exists already", where=str(out), hint="choose another --out")
        write_whole(out, text)
    except OSError as error:
        raise _unwritable("file", out, error) from None
    print(out)


def _unwritable(what: str, where: Path, error: OSError) -> CalibError:
    wrong = f"the {what} cannot be written ({error.strerror})"
    return CalibError(wrong, where=str(where), hint="choose another --out")


_ABOUT = "Show everything about this one."
_AModel = Annotated[
    str | None, typer.Argument(help=_ABOUT, autocompletion=opt.completing("models"))
]
_AnEffect = Annotated[
    str | None, typer.Argument(help=_ABOUT, autocompletion=opt.completing("effects"))
]
_AQuantity = Annotated[
    str | None, typer.Argument(help=_ABOUT, autocompletion=opt.completing("quantities"))
]


def models(
    name: _AModel = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """List the models, or show one: equation, columns, limits, priors."""
    from calib.models import MODELS, get_model
    from calib.report.labels import model_facts

    if name is not None:
        _tell("models", name, get_model(name), model_facts)
        return
    for model in MODELS.values():
        print(f"{model.name}: {model.title}\n  {model.equation}")
        print(f"  needs {', '.join(model.conditions)}; gives {model.output}")
    facts = ("title", "equation", "conditions", "output", "parameters")
    finish(0, {"models": {m.name: {f: getattr(m, f) for f in facts} for m in MODELS.values()}})


def effects(
    name: _AnEffect = None,
    effects: opt.EffectsFile = None,
    plugins: opt.Models = None,
    json: opt.Json = False,
) -> None:
    """List the effects that a diagnosis considers, or show one: equation, needs, priors."""
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.user import load_effects
    from calib.report.labels import declared, effect_facts, role_columns

    known = {**EFFECTS, **({} if effects is None else load_effects(effects))}
    if name is not None:
        _tell("effects", name, declared("effect", known, name), effect_facts)
        return
    found = {}
    for effect in known.values():
        outputs = role_columns(effect.outputs, output=True)
        covariates = role_columns(effect.covariates, output=False)
        print(f"{effect.name}: {effect.title}")
        print(f"  on {', '.join(outputs)}; needs {', '.join(covariates) or 'nothing more'}")
        facts = {"title": effect.title, "outputs": outputs, "covariates": covariates}
        found[effect.name] = facts
    finish(0, {"effects": found})


def quantities(name: _AQuantity = None, plugins: opt.Models = None, json: opt.Json = False) -> None:
    """List the quantities that a column may hold, or show one: its units and uses."""
    from calib.data.quantities import QUANTITIES
    from calib.data.table import parse_header
    from calib.report.labels import declared, quantity_facts

    if name is not None:
        stems = {s: c for c, q in QUANTITIES.items() for s in (q.stem, *q.synonyms)}
        column = None if name in stems else parse_header(name)
        canonical = stems.get(name, name) if column is None else column.quantity.canonical
        quantity = declared("quantity", QUANTITIES, canonical)
        _tell("quantities", canonical, quantity, quantity_facts)
        return
    found = {}
    for canonical, q in QUANTITIES.items():
        print(f"{canonical}: {q.description}\n  {q.role}, in {', '.join(q.units) or 'no unit'}")
        found[canonical] = {"description": q.description, "role": q.role, "units": [*q.units]}
    finish(0, {"quantities": found})


def _tell[T](what: str, name: str, one: T, facts_of: Callable[[T], Facts]) -> None:
    """Print all that is declared of one."""
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
