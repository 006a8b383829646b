"""Sentences with citations, symbols, equations and file names, for two readers.

A sentence is plain text with marks: ``[@key]`` or ``[@key; @other]`` cites, ``[$name]`` is a
parameter's symbol, ``[u:unit]`` a unit, ``[=model]`` a model's equation, and backquotes enclose
file names, hashes and commands. `to_text` writes it for any editor, `to_latex` for LaTeX.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from calib.models import get_model
from calib.models.latex import text
from calib.report.labels import joined, plain, symbol, unbroken, unit_plain
from calib.report.publish.latex import escape, latex_unit
from calib.report.publish.references import short_citation

_MARK = re.compile(r"\[@([^\]]+)\]|\[\$(\w+)\]|\[u:([^\]]*)\]|\[=(\w+)\]|`([^`]*)`")


def cited(sentences: Iterable[str]) -> list[str]:
    """Return the keys that are cited, each once, in order."""
    keys = [
        key.strip(" @")
        for sentence in sentences
        for match in _MARK.finditer(sentence)
        if match[1]
        for key in match[1].split(";")
    ]
    return list(dict.fromkeys(keys))


def joined_symbols(names: Iterable[str]) -> str:
    """Return marks of several symbols, as a sentence lists them."""
    return joined([f"[${name}]" for name in names])


def in_brackets(unit: str) -> str:
    """Return the mark of a unit that follows what it is of; nothing where there is none."""
    return "" if unit in ("1", "") else f" ([u:{unit}])"


def with_symbols(text: str, names: Iterable[str]) -> str:
    """Mark the parameters in a text by others; a lone letter may be a word of it, and stays."""
    known = sorted((n for n in names if len(n) > 1), key=len, reverse=True)
    text = text.replace("^2", "\N{SUPERSCRIPT TWO}").replace("^3", "\N{SUPERSCRIPT THREE}")
    if not known:
        return text
    pattern = rf"(?<![\w/])({'|'.join(map(re.escape, known))})(?!\w)"
    return re.sub(pattern, lambda match: f"[${match[0]}]", text)


def to_text(sentence: str) -> str:
    """Write a sentence as plain text."""

    def replaced(match: re.Match[str]) -> str:
        keys, name, unit, model, code = match.groups()
        if keys:
            return f"({'; '.join(short_citation(key.strip(' @')) for key in keys.split(';'))})"
        if unit:
            return unit_plain(unit)
        if model:
            return ", ".join(map(text, get_model(model).latex))
        return plain(name) if name else code

    return _MARK.sub(replaced, unbroken(sentence))


def to_latex(sentence: str) -> str:
    r"""Write a sentence for LaTeX; citations are ``\cite`` with the keys of `references.bib`."""
    written, end = [], 0
    sentence = unbroken(sentence)
    for match in _MARK.finditer(sentence):
        keys, name, unit, model, code = match.groups()
        before = escape(sentence[end : match.start()])
        if keys:
            before = before.rstrip(" ") + "~"
            mark = f"\\cite{{{','.join(key.strip(' @') for key in keys.split(';'))}}}"
        elif name:
            mark = symbol(name)  # mathtext is a part of LaTeX
        elif unit:
            mark = latex_unit(unit)
        elif model:
            mark = ", ".join(get_model(model).latex)
        else:
            # Long names and hashes may break after a slash.
            mark = f"\\texttt{{{escape(code).replace('/', '/' + chr(92) + 'allowbreak{}')}}}"
        written += [before, mark]
        end = match.end()
    return "".join([*written, escape(sentence[end:])])
