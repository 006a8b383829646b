"""A table for print and for programs: the same cells as LaTeX (booktabs) and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

from calib.report.publish.markup import to_latex


@dataclass(frozen=True)
class CsvTable:
    """Rows for programs: numbers in ASCII, units in a column or in the header."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class LatexTable:
    """Rows for print, in groups with a rule between them; a wide table is in a small font.

    The label names its file too. Caption, head and cells have marks, see
    `calib.report.publish.markup`; `columns` is LaTeX's column specification.
    """

    label: str
    caption: str
    columns: str
    head: tuple[str, ...]
    groups: tuple[tuple[tuple[str, ...], ...], ...]
    small: bool = False


def write_csv(table: CsvTable) -> str:
    """Return a table as CSV (RFC 4180, but for line ends)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.head)
    writer.writerows(table.rows)
    return text.getvalue()


def write_latex(table: LatexTable) -> str:
    """Return a table as a LaTeX float that needs the package booktabs."""
    body = "\n    \\midrule\n".join(
        "\n".join(f"    {_row(row, table.columns)}" for row in group)
        for group in table.groups
        if group
    )
    return "\n".join(
        [
            "% Needs \\usepackage{booktabs}; the references cited are in references.bib.",
            "\\begin{table}",
            "  \\centering",
            "  \\footnotesize" if table.small else "  \\small",
            f"  \\caption{{{to_latex(table.caption)}}}",
            f"  \\label{{tab:{table.label.replace('_', '-')}}}",
            f"  \\begin{{tabular}}{{{table.columns}}}",
            "    \\toprule",
            f"    {_row(table.head, table.columns)}",
            "    \\midrule",
            body,
            "    \\bottomrule",
            "  \\end{tabular}",
            "\\end{table}",
            "",
        ]
    )


def _row(cells: Sequence[str], columns: str) -> str:
    # Justified text in a narrow column has gaps; after \raggedright a row's end is spelt out.
    ragged = "\\raggedright " if "p{" in columns else ""
    first, *others = map(to_latex, cells)
    return " & ".join([first, *(ragged + cell for cell in others)]) + r" \tabularnewline"
