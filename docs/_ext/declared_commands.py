"""The page of the commands, from their declarations."""

from __future__ import annotations

from typing import Any

import typer
from declared_text import code, table, words

from calib.cli.app import app


def page() -> str:
    """Return the page of all commands."""
    group: Any = typer.main.get_command(app)
    parts = [_command(name, command) for name, command in group.commands.items()]
    return "# Commands\n\n" + (
        "What `calib COMMAND --help` says, made from the same declarations. Exit codes: 0 all "
        "well; 1 something failed or differs; 2 input to fix, said in a line or two; 3 a "
        "posterior that did not converge; 130 interrupted.\n\n" + "\n".join(parts)
    )


def _command(name: str, command: Any) -> str:
    if hasattr(command, "commands"):
        return "\n".join(_command(f"{name} {n}", c) for n, c in command.commands.items())
    rows = [_parameter(p) for p in command.params if p.name != "help"]
    about = f"{words(command.help or '')}\n\n{_example(command)}"
    return f"## calib {name}\n\n{about}\n\n" + table(
        ("argument or option", "default", "what"), rows
    )


def _example(command: Any) -> str:
    """Return the example of a command as it is typed."""
    typed = (command.epilog or "").removeprefix("Example: ")
    return f"```console\n{typed}\n```"


def _default(p: Any) -> str:
    # The number of processes is the machine's that the pages are made on.
    unsaid = p.default in (None, (), [], False) or callable(p.default) or p.name == "workers"
    return "" if unsaid else code(str(p.default))


def _parameter(p: Any) -> tuple[str, str, str]:
    optional = p.param_type_name == "option"
    names = [*p.opts, *p.secondary_opts] if optional else [(p.metavar or p.name).upper()]
    default = "required" if p.required else _default(p)
    return ", ".join(map(code, names)), default, words(getattr(p, "help", "") or "")
