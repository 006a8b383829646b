"""What a paper takes from a report: tables, a methods paragraph, references.

Everything is made from the manifest and the summary alone, so that it is made again, byte for
byte, wherever these are the same.
"""

from __future__ import annotations

import csv
import io
import re
import shlex
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from jinja2 import UndefinedError

from calib.data.reader import KNOWN_DATA
from calib.inference.estimators import METHODS
from calib.report.document import Output, outputs
from calib.report.labels import joined
from calib.report.markup import bibliography, bibtex, cited, to_latex, to_text
from calib.report.numbers import format_number, format_value
from calib.report.page.template import template, words
from calib.report.publish.tables import TOPICS, Row, Table

type Paragraph = tuple[str, tuple[str, ...]]
"""A heading, empty for the first, and sentences with marks (`calib.report.markup`)."""

_NORMAL = dict.fromkeys(("family", "correlated_along", "depends_on", "against_normal"))


@dataclass(frozen=True)
class Publication:
    """What a paper takes from a report."""

    files: Mapping[str, str]  # text by path in the report's folder
    tables: tuple[tuple[str, str, tuple[str, ...]], ...]  # topic, CSV file and LaTeX files
    methods: tuple[tuple[str, str], ...]  # heading, empty for the first, and text of paragraphs
    references: tuple[str, ...]  # a line for every reference that they cite


def publication(manifest: Mapping[str, Any], summary: Mapping[str, Any]) -> Publication:
    """Make tables, methods and references; nothing where no output was worked out.

    The same text for the same numbers; times are left out, which never are the same.
    """
    found = outputs(manifest, summary)
    if not found:
        return Publication({}, (), (), ())
    version = str(manifest["versions"]["terracalib"])
    paragraphs = methods(manifest, found)
    label = ", ".join(dict.fromkeys(o.label for o in found if o.label))
    gate = manifest["settings"]["gate"]
    by_topic = {}
    for topic, of in TOPICS.items():
        made = [table for o in found for table in of.of_output(o)]
        made += [of.together(found, gate)] if of.together else []
        by_topic[topic] = [_labelled(table, label) for table in made]
    tables = [t for some in by_topic.values() for t in some]
    said = [sentence for _, sentences in paragraphs for sentence in sentences]
    references = bibliography(cited(said), version)
    texts = [(heading, " ".join(map(to_text, sentences))) for heading, sentences in paragraphs]
    files = {
        f"tables/{name}.csv": _csv(rows)
        for name, topic in TOPICS.items()
        if (rows := [{**_whose(o, label), **row} for o in found for row in topic.rows(o)])
    }
    links = tuple(
        (topic.capitalize(), path, tuple(f"tables/{t.label}.tex" for t in some))
        for topic, some in by_topic.items()
        if (path := f"tables/{topic}.csv") in files
    )
    files |= {f"tables/{t.label}.tex": t.latex() for t in tables}
    files["methods.txt"] = _text(texts, references)
    files["methods.tex"] = _tex(paragraphs)
    files["references.bib"] = bibtex(cited([*said, *(t.caption for t in tables)]), version)
    return Publication(files, links, tuple(texts), tuple(references))


def _whose(o: Output, label: str) -> dict[str, str]:
    """Return the first cells of a row for programs; what data are called, if any are labelled."""
    return {"output": o.key, **({"data_label": o.label} if label else {}), "model": o.model.name}


def _csv(rows: Sequence[Row]) -> str:
    """Return rows for programs as CSV (RFC 4180, but for line ends); numbers are in ASCII."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _labelled(table: Table, label: str) -> Table:
    """Say of a table what its data must be called, unless its caption does."""
    if label in table.caption:
        return table
    return replace(table, caption=f"{table.caption} {label.capitalize()} data.")


def methods(manifest: Mapping[str, Any], found: Sequence[Output]) -> list[Paragraph]:
    """Return the methods; a KeyError where manifest or summary lack a number."""
    labels = sorted({o.label for o in found if o.label})
    try:
        text = template("methods.j2", __name__, html=False).render(
            v=manifest["versions"],
            s=manifest["settings"],
            ga=manifest["genetic_algorithm"],
            seed=manifest["seed"],
            command=shlex.join(map(str, manifest["command"])),
            labels=[label for label in labels if label in KNOWN_DATA],
            known=KNOWN_DATA,
            genetic=any("genetic" in o.found["estimates"] for o in found),
            digits=12,  # of a hash, which tell two files apart; the manifest has all of them
            outputs=[(o, _words(o)) for o in found],
            format_value=format_value,
        )
    except UndefinedError as error:
        raise KeyError(str(error)) from None
    blocks = [
        re.sub(r"[ \n]+", " ", block).strip()
        for block in re.split(r"\n\s*\n", text)
        if block.strip()
    ]
    starts = [0, *(i for i, block in enumerate(blocks) if block.startswith("# "))]
    return [
        (blocks[a][2:] if a else "", tuple(blocks[a + bool(a) : b]))
        for a, b in zip(starts, [*starts[1:], len(blocks)], strict=True)
    ]


def likelihood(o: Output) -> str:
    """Say what the likelihood of an output is, with marks."""
    return words("likelihood.j2", __name__, o=o, noise=_NORMAL | o.found.get("noise", {}))


def _words(o: Output) -> dict[str, Any]:
    """What is said of an output beside what stands in its records."""
    v, axis = o.found["validation"], o.axis()
    posterior = o.found["posterior"].items()
    sampled = [f"[${n}]" for n, p in posterior if p["posterior_to_prior_sd"] is not None]
    return {
        "likelihood": likelihood(o),
        "noise": _NORMAL | o.found.get("noise", {}),
        "ranges": [_range(o, name, r) for name, r in o.found["data"]["ranges"].items()],
        "sampled": joined(sampled),
        "methods": [METHODS[m].words if m in METHODS else m for m in o.found["estimates"]],
        "rmse": f"{format_number(axis.factor * (v['rmse'] or 0.0))} {axis.unit}",
        "levels": [f"{level} %" for level in v["coverage"]],
        "hits": [str(o.hits(level)) for level in v["coverage"]],
    }


def _range(o: Output, column: str, found: Mapping[str, float]) -> str:
    axis = o.axis(column)
    low, high = axis.value_text(found["lower"]), axis.value_text(found["upper"])
    both = {1: low, 2: f"{low} and {high}"}.get(int(found["distinct"]), f"{low} to {high}")
    return f"{axis.name[0].lower()}{axis.name[1:]} {both} {axis.unit}"


def _text(paragraphs: Sequence[tuple[str, str]], references: Sequence[str]) -> str:
    blocks = [_filled(f"{heading}. {body}" if heading else body) for heading, body in paragraphs]
    lines = [_filled(line, subsequent_indent="  ") for line in references]
    return "\n\n".join(["Methods", *blocks, "References", "\n".join(lines)]) + "\n"


def _filled(text: str, **kwargs: Any) -> str:
    """Wrap lines at plain spaces; the others become plain once they have done their work."""
    wrapped = textwrap.fill(text, 96, break_long_words=False, break_on_hyphens=False, **kwargs)
    return wrapped.replace("\N{NO-BREAK SPACE}", " ")


def _tex(paragraphs: Sequence[Paragraph]) -> str:
    lines = ["% \\input this file; the keys cited are in references.bib."]
    for heading, sentences in paragraphs:
        lines += ["", *([f"\\paragraph{{{to_latex(heading)}.}}"] if heading else [])]
        lines += [to_latex(sentence) for sentence in sentences]
    return "\n".join(lines) + "\n"
