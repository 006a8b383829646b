"""What tables and methods read of a manifest and a summary, and a table as CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from calib.inference.calibration import ParameterSummary
from calib.models import get_model
from calib.report.labels import Axis, axis_of, units_of
from calib.report.publish.markup import to_latex
from calib.report.reference import Reference, reference_of
from calib.report.study_tasks import HoldOut

type Row = Mapping[str, str]
"""Cells by the head of their column."""

_NAN = float("nan")


@dataclass(frozen=True)
class Output:
    """One output that was worked out: its entries in manifest and summary."""

    key: str
    model: str
    task: Mapping[str, Any]
    found: Mapping[str, Any]

    @property
    def name(self) -> str:
        """In words."""
        return self.key.replace("_", " ").capitalize()

    @property
    def model_words(self) -> str:
        """The model by its title and its place in the source, with marks."""
        model = get_model(self.model)
        source = f"the source [@{model.cited}]" if model.cited else model.source
        numbers = model.numbers.replace("-", "\N{EN DASH}")
        origin = f"{numbers} of {source}" if numbers and source else source
        return f"\u201c{model.title}\u201d" + (f" ({origin})" if origin else "")

    @property
    def label(self) -> str:
        """What the data are called; empty for measurements."""
        return str(self.found["data"]["label"])

    @property
    def reference(self) -> Reference:
        """What was printed on these data."""
        return reference_of(self.label)

    @property
    def data_words(self) -> str:
        """What to call the data."""
        return f"{self.label} data" if self.label else "data"

    def axis(self, column: str) -> Axis:
        """Return how a column is shown, in the unit of the file."""
        with units_of(self.task["data"].get("header", ())):
            return axis_of(column)

    @property
    def converged(self) -> bool:
        """Whether the posterior passed the gate."""
        return bool(self.found["sampling"]["converged"])

    @property
    def held_out(self) -> str:
        """Which rows were held out, in words; empty where none were."""
        held = self.task["held_out"]
        if held is None or self.found["validation"]["method"] != "held_out":
            return ""
        return HoldOut(**held).words

    @property
    def estimates_use_all_rows(self) -> bool:
        """Whether point estimates are of more rows than the posterior: the source's were."""
        data = self.found["data"]
        return get_model(self.model).estimates_all_rows and bool(data["n_all"] > data["n"])

    @property
    def n_estimated(self) -> int:
        """Of how many rows the point estimates are."""
        return int(self.found["data"]["n_all" if self.estimates_use_all_rows else "n"])

    @property
    def posterior(self) -> tuple[ParameterSummary, ...]:
        """Summaries of all parameters."""
        return tuple(_read_summary(name, entry) for name, entry in self.found["posterior"].items())


def outputs(manifest: Mapping[str, Any], summary: Mapping[str, Any]) -> list[Output]:
    """Return the outputs that were worked out; those that failed are left out."""
    return [
        Output(key, str(manifest["tasks"][key]["model"]), manifest["tasks"][key], found)
        for key, found in summary["models"].items()
        if "error" not in found
    ]


def _read_summary(name: str, entry: Mapping[str, Any]) -> ParameterSummary:
    """Read a posterior summary back; what JSON has no number for is NaN."""
    spelled = {**entry, "sd_ratio": entry["posterior_to_prior_sd"]}
    numbers: dict[str, Any] = {
        f.name: _NAN if spelled.get(f.name) is None else spelled[f.name]
        for f in fields(ParameterSummary)
        if f.name != "name"
    }
    return ParameterSummary(name=name, **numbers)


@dataclass(frozen=True)
class LatexTable:
    """Rows for print, cells by the head of their column, in groups with a rule between them.

    The label names its file too. Caption, heads and cells have marks, see
    `calib.report.publish.markup`; `columns` is LaTeX's column specification.
    """

    label: str
    caption: str
    columns: str
    groups: Sequence[Sequence[Row]]


def write_csv(rows: Sequence[Row]) -> str:
    """Return rows for programs as CSV (RFC 4180, but for line ends).

    Numbers are in ASCII, units in a column or in the header.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_latex(table: LatexTable) -> str:
    """Return a table as a LaTeX float that needs the package booktabs."""
    groups = [group for group in table.groups if group]
    body = "\n    \\midrule\n".join(
        "\n".join(f"    {_latex_row(row.values(), table.columns)}" for row in group)
        for group in groups
    )
    return "\n".join(
        [
            "% Needs \\usepackage{booktabs}; the references cited are in references.bib.",
            "\\begin{table}",
            "  \\centering",
            "  \\footnotesize",
            f"  \\caption{{{to_latex(table.caption)}}}",
            f"  \\label{{tab:{table.label.replace('_', '-')}}}",
            f"  \\begin{{tabular}}{{{table.columns}}}",
            "    \\toprule",
            f"    {_latex_row(groups[0][0], table.columns)}",
            "    \\midrule",
            body,
            "    \\bottomrule",
            "  \\end{tabular}",
            "\\end{table}",
            "",
        ]
    )


def _latex_row(cells: Iterable[str], columns: str) -> str:
    # Justified text in a narrow column has gaps; after \raggedright a row's end is spelt out.
    ragged = "\\raggedright " if "p{" in columns else ""
    first, *others = map(to_latex, cells)
    return " & ".join([first, *(ragged + cell for cell in others)]) + r" \tabularnewline"
