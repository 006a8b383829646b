"""Write results.csv, results.md, equality.csv, the figure and README.md."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from report.figure import draw
from report.rows import NAMES, Row, rows_of
from report.text import readme

__all__ = ["write"]


def write(out: Path) -> None:
    """Write the report of all parts that have been measured.

    Parameters
    ----------
    out : Path
        Folder whose ``measured/`` holds a JSON file of each part.
    """
    measured = {
        p.stem: json.loads(p.read_text()) for p in sorted((out / "measured").glob("*.json"))
    }
    rows = rows_of(measured)
    with (out / "results.csv").open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["part", "subject", "quantity", "median", "low", "high", "asked", "met"])
        for r in rows:
            met = "" if r.met is None else "yes" if r.met else "no"
            table.writerow([r.part, r.subject, r.quantity,
                            *("" if v is None else f"{v:.6g}" for v in (r.value, r.low, r.high)),
                            r.asked, met])  # fmt: skip
    (out / "results.md").write_text(_markdown(rows))
    if "posterior" in measured:
        _equality(measured["posterior"]["problems"], out / "equality.csv")
    draw(measured, out / "benchmarks.png")
    (out / "README.md").write_text(readme(measured, rows))


def _markdown(rows: list[Row]) -> str:
    lines = ["# Everything that was measured", ""]
    part = ""
    for r in rows:
        if r.part != part:
            part = r.part
            lines += ["", f"## {part}", "", "| | | median | range | asked | |",
                      "|---|---|---:|---:|---|---|"]  # fmt: skip
        lines.append(r.line)
    return "\n".join(lines) + "\n"


def _equality(problems: Mapping[str, Any], path: Path) -> None:
    """One line for each parameter: z-scores of means and quantiles against each peer."""
    with path.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["problem", "parameter", "against", "z_mean", "z_q5", "z_q50", "z_q95"])
        for key in NAMES:
            p = problems[key]
            for peer, z in p["z_scores"].items():
                for i, name in enumerate(p["names"] if z else ()):
                    scores = (f"{z[what][i]:.2f}" for what in ("mean", "q5", "q50", "q95"))
                    table.writerow([key, name, peer, *scores])
