"""What a paper takes from a report: tables, a methods paragraph, references.

Everything is made from the manifest and the summary alone, so that it is made again, byte for
byte, wherever these are the same.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from calib.report.publish.markup import bibliography, bibtex, cited, to_latex, to_text
from calib.report.publish.records import (
    LatexTable,
    Output,
    Paragraph,
    Row,
    convergence_csv,
    convergence_latex,
    methods,
    outputs,
    validation_csv,
    validation_latex,
    write_csv,
    write_latex,
)
from calib.report.publish.tables import (
    estimates_csv,
    estimates_latex,
    posterior_csv,
    posterior_latex,
    pressure_latex,
    priors_csv,
    priors_latex,
)

_WIDTH = 96


@dataclass(frozen=True)
class Publication:
    """What a paper takes from a report: text by path in its folder.

    And heading, empty for the first, and text of every paragraph of the methods; a line for every
    reference that they cite.
    """

    files: Mapping[str, str]
    methods: tuple[tuple[str, str], ...]
    references: tuple[str, ...]

    def tables(self) -> list[tuple[str, str, tuple[str, ...]]]:
        """Return topic, CSV file and LaTeX files of every table."""
        topics = []
        for path in self.files:
            if path.endswith(".csv"):
                stem = path.removesuffix(".csv")
                tex = tuple(p for p in self.files if p.startswith(stem) and p.endswith(".tex"))
                topics.append((stem.removeprefix("tables/").capitalize(), path, tex))
        return topics


def publication(manifest: Mapping[str, Any], summary: Mapping[str, Any]) -> Publication:
    """Make tables, methods and references; nothing where no output was worked out.

    The same text for the same numbers; times are left out, which never are the same.
    """
    found = outputs(manifest, summary)
    if not found:
        return Publication({}, (), ())
    version = str(manifest["versions"]["terracalib"])
    paragraphs = methods(manifest, found)
    tables = [_labelled(t, found) for t in _latex_tables(found, manifest["settings"]["gate"])]
    said = [sentence for _, sentences in paragraphs for sentence in sentences]
    keys = cited([*said, *(t.caption for t in tables)])
    references = bibliography(cited(said), version)
    files = {f"tables/{name}.csv": write_csv(t) for name, t in _csv_tables(found).items() if t}
    files |= {f"tables/{t.label}.tex": write_latex(t) for t in tables}
    files["methods.txt"] = _text(paragraphs, references)
    files["methods.tex"] = _tex(paragraphs)
    files["references.bib"] = bibtex(keys, version)
    return Publication(
        files,
        tuple((heading, " ".join(map(to_text, sentences))) for heading, sentences in paragraphs),
        tuple(references),
    )


def _labelled(table: LatexTable, found: Sequence[Output]) -> LatexTable:
    """Say of a table what its data must be called, unless its caption does."""
    label = ", ".join(dict.fromkeys(o.label for o in found if o.label))
    if label in table.caption:
        return table
    return replace(table, caption=f"{table.caption} {label.capitalize()} data.")


def _csv_tables(found: Sequence[Output]) -> dict[str, list[Row]]:
    labels = {o.key: o.label for o in found}
    return {
        name: [
            {"output": row["output"], "data_label": labels[row["output"]], **row} for row in rows
        ]
        if any(labels.values())
        else rows
        for name, rows in _rows(found).items()
    }


def _rows(found: Sequence[Output]) -> dict[str, list[Row]]:
    return {
        "posterior": posterior_csv(found),
        "estimates": estimates_csv(found),
        "validation": validation_csv(found),
        "convergence": convergence_csv(found),
        "priors": priors_csv(found),
    }


def _latex_tables(found: Sequence[Output], gate: Mapping[str, float]) -> list[LatexTable]:
    made = [
        *(posterior_latex(o) for o in found),
        *(estimates_latex(o) for o in found),
        *(pressure_latex(o) for o in found),
        validation_latex(found),
        convergence_latex(found, gate),
        *(priors_latex(o) for o in found),
    ]
    return [table for table in made if table is not None]


def _text(paragraphs: Sequence[Paragraph], references: Sequence[str]) -> str:
    blocks = []
    for heading, sentences in paragraphs:
        body = " ".join(map(to_text, sentences))
        blocks.append(_filled(f"{heading}. {body}" if heading else body))
    lines = [_filled(line, subsequent_indent="  ") for line in references]
    return "\n\n".join(["Methods", *blocks, "References", "\n".join(lines)]) + "\n"


def _filled(text: str, **kwargs: Any) -> str:
    """Wrap lines at plain spaces; the others become plain once they have done their work."""
    wrapped = textwrap.fill(
        text, _WIDTH, break_long_words=False, break_on_hyphens=False, **kwargs
    )  # fmt: skip
    return wrapped.replace("\N{NO-BREAK SPACE}", " ")


def _tex(paragraphs: Sequence[Paragraph]) -> str:
    lines = ["% \\input this file; the keys cited are in references.bib."]
    for heading, sentences in paragraphs:
        lines += ["", *([f"\\paragraph{{{to_latex(heading)}.}}"] if heading else [])]
        lines += [to_latex(sentence) for sentence in sentences]
    return "\n".join(lines) + "\n"
