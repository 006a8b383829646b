"""An example of every verb, for its help and its page."""

from __future__ import annotations

from collections.abc import Iterable

import typer

EXAMPLES = {
    "report": "calib report my.csv --hold-out inflation_pressure_psi=30 --out report",
    "fit": "calib fit my.csv --model magic_formula_pressure --out run",
    "predict": "calib predict run --at conditions.csv --out predicted.csv",
    "data": "calib data he2019-gaps --out cases",
    "template": "calib template magic_formula_pressure --out my.csv",
    "priors": "calib priors magic_formula_pressure --out my.toml",
    "models": "calib models magic_formula",
    "effects": "calib effects slip_sinkage",
    "quantities": "calib quantities rut_depth --json",
    "compare": "calib compare bekker reece plates.csv --hold-out plate_width_mm=80 --out compared",
    "diagnose": "calib diagnose --run run --field field.csv --out diagnosis",
    "check": "calib check run --json > check.json",
    "audit": "calib audit --out audit",
    "campaign": "calib campaign plan.toml --out results --workers 2",
    "sbc": "calib sbc --model bekker --simulations 100 --out sbc",
    "doctor": "calib doctor --quick",
    "make": "calib challenge make --out cases --key key.json --seed 1 --cases 20",
    "run": "calib challenge run cases --out diagnoses",
    "well-specified": "calib challenge well-specified cases --key key.json --out plain --out-key "
    "plain.json",
    "score": "calib challenge score cases --results diagnoses --key key.json",
}


def add_examples(app: typer.Typer) -> None:
    """Put an example under the help of every verb of an app."""
    for command in _commands(app):
        name = command.name or str(getattr(command.callback, "__name__", ""))
        command.epilog = f"Example: {EXAMPLES[name]}"


def _commands(app: typer.Typer) -> Iterable[typer.models.CommandInfo]:
    yield from app.registered_commands
    for group in app.registered_groups:
        if group.typer_instance is not None:
            yield from _commands(group.typer_instance)
