"""Verbs of what is registered: models, effects, quantities."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from calib.report.declared import Facts

Name = Annotated[str | None, typer.Argument(help="One of them: all that is declared of it.")]


def models(
    name: Name = None, plugins: opt.Models = None, simulator: opt.Simulators = None,
    json: Json = False,
) -> None:  # fmt: skip
    """List the models with their equations and columns; of one also limits and priors."""
    from calib.models import MODELS, get_model
    from calib.report.declared import model_facts

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
    from calib.gap.effects.load import load_effects
    from calib.report.declared import declared, effect_facts, role_columns

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
    from calib.data.headers import parse_header
    from calib.data.quantities import QUANTITIES
    from calib.report.declared import declared, quantity_facts

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
