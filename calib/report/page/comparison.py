"""The page of a comparison, and its table for the terminal: worded and rounded here."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from calib.models import get_model
from calib.report.numbers import format_number
from calib.report.page.template import template

_HEAD = (
    "Model", "Below the best, elpd", "Standard error", "Stacking weight", "RMSE", "90 % covers",
    "Rows fitted again", "Log evidence",
)  # fmt: skip
_HELD_HEAD = ("held-out elpd", "held-out RMSE", "held-out CRPS", "held-out 90 % covers")


def table(found: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of the table, from the content of `comparison.json`."""
    head = [*_HEAD, *(_HELD_HEAD if found["held_out"] else ())]
    return head, [_row(name, m) for name, m in found["models"].items()]


def _row(name: str, m: Mapping[str, Any]) -> list[str]:
    cells = [
        name, f"{m['below_best']:.1f}", f"{m['below_best_se']:.1f}", f"{m['weight']:.2f}",
        format_number(m["rmse"]), f"{100 * m['coverage_90']:.0f} %", str(m["refitted_rows"]),
        "none" if m["log_evidence"] is None else f"{m['log_evidence']:.1f}",
    ]  # fmt: skip
    held = m.get("held_out")
    if held:
        density = "none" if held["elpd"] is None else f"{held['elpd']:.1f}"
        crps = "none" if held["crps"] is None else format_number(held["crps"])
        cells += [density, format_number(held["rmse"]), crps,
                  f"{100 * held['coverage_90']:.0f} %"]  # fmt: skip
    return cells


def text(found: Mapping[str, Any]) -> str:
    """Lay the table out as text, the verdict below it."""
    head, body = table(found)
    lines = [head, *body]
    widths = [max(len(line[j]) for line in lines) for j in range(len(head))]
    shown = ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in lines]
    return "\n".join([*(line.rstrip() for line in shown), found["verdict"]])


def render(found: Mapping[str, Any], image: str, command: Sequence[str]) -> str:
    """Render the page from the content of `comparison.json` and the figure's data URI."""
    head, body = table(found)
    models = [get_model(name) for name in found["models"]]
    return template("comparison.html.j2").render(
        found=found,
        head=head,
        rows=body,
        image=image,
        models=[{"name": m.name, "title": m.title, "equation": m.equation, "source": m.source}
                for m in models],
        command=shlex.join(command),
    )  # fmt: skip
