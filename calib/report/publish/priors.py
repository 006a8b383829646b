"""Table of the priors, with their reasons and sources."""

from __future__ import annotations

from collections.abc import Sequence

from calib.report.publish.grid import CsvTable, LatexTable
from calib.report.publish.markup import in_brackets, with_symbols
from calib.report.publish.records import Output


def priors_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return the priors of all outputs."""
    head = ("output", "model", "parameter", "unit", "distribution", "reason", "source",
            "file_sha256")  # fmt: skip
    return CsvTable(head, tuple(
        (o.key, o.model, name, p["unit"], p["distribution"], p["reason"], p["source"],
         o.task["priors"]["sha256"])
        for o in outputs for name, p in o.found["priors"].items()
    ))  # fmt: skip


def priors_latex(o: Output) -> LatexTable:
    """Return the priors of an output."""
    file = o.task["priors"]
    return LatexTable(
        label=f"priors_{o.key}",
        caption=(
            f"Priors of the parameters of {o.model_words}, from `{file['source']}` (SHA-256 "
            f"`{file['sha256'][:12]}`): normal(mean, sd), lognormal(median, sd of the logarithm), "
            "on [lower, upper] where truncated."
        ),
        columns=r"lp{0.2\textwidth}p{0.36\textwidth}p{0.24\textwidth}",
        head=("Parameter", "Distribution", "Reason", "Source"),
        groups=(tuple(
            (f"[${name}]{in_brackets(p['unit'])}", p["distribution"].replace(
                " x ", " \N{MULTIPLICATION SIGN} "),
             *(with_symbols(p[k], o.found["priors"]) for k in ("reason", "source")))
            for name, p in o.found["priors"].items()
        ),),
        small=True,
    )  # fmt: skip
