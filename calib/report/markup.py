"""Sentences with citations, symbols, equations and file names, for three readers.

A sentence is plain text with marks: ``[@key]`` or ``[@key; @other]`` cites, ``[$name]`` is a
parameter's symbol, ``[u:unit]`` a unit, ``[=model]`` a model's equation, ``[!words]`` are strong,
and backquotes enclose file names, hashes and commands. `to_text` writes it for any editor,
`to_html` for a page, `to_latex` for LaTeX.

The references are read from `references.bib`. Authors, volumes and pages are those that the
packages and journals give themselves (the citation files of NumPy, SciPy, Matplotlib, emcee and
corner, the bibliography shipped with ArviZ).
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib import resources

from markupsafe import Markup
from markupsafe import escape as html_escape

from calib.models import get_model
from calib.models.card import mathml, text
from calib.report.labels import (
    degrees,
    plain,
    stem_and_subscript,
    symbol,
    unbroken,
    unit_plain,
    unit_text,
)
from calib.report.numbers import RAISED, lowered

_LATEX = tomllib.loads((resources.files("calib.report") / "latex.toml").read_text("utf-8"))


def escape(text: str) -> str:
    """Return any text as LaTeX sets it.

    Raised digits, signs and Greek letters become mathematics, letters that LaTeX's default encoding
    lacks lose their accents, and what is left of others is a question mark.
    """
    raised = re.split(f"([{RAISED}]+)", text)
    return "".join(
        f"$^{{{lowered(part)}}}$" if k % 2 else "".join(map(_letter, part))
        for k, part in enumerate(raised)
    )


@cache
def _letter(letter: str) -> str:
    known: str | None = _LATEX["letters"].get(letter) or _greek(letter)
    if known is not None:
        return known
    if letter.isascii():
        return letter if letter.isprintable() else " "
    if "\u00c0" <= letter <= "\u00ff":  # Latin-1, without the signs
        return letter
    plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
    return "".join(map(_letter, plain)) or "?"


def _greek(letter: str) -> str | None:
    script, _, name = unicodedata.name(letter, "").partition(" LETTER ")
    name = {"GREEK SMALL": name.lower(), "GREEK CAPITAL": name.capitalize()}.get(script, "")
    return f"$\\{name}$" if name in _LATEX["greek"] else None


def latex_unit(unit: str) -> str:
    """Return a unit with its powers raised; a dash where there is none."""
    text = unit_text(unit).replace("%", r"\%").replace("\N{EN DASH}", "--")
    return text.replace("\N{DEGREE SIGN}", _letter("\N{DEGREE SIGN}"))


OWN = "calib"
_ENTRY = re.compile(r"@(\w+)\{(\w+),\n(.*?)\n\}", re.DOTALL)


@cache
def _source() -> str:
    return (resources.files("calib.report") / "references.bib").read_text(encoding="utf-8")


@cache
def entries() -> Mapping[str, Mapping[str, str]]:
    """Return the fields of every reference by its key, as BibTeX has them."""
    return {
        key: dict(re.findall(r"^  (\w+) = \{(.*)\},?$", body, re.MULTILINE))
        for _, key, body in _ENTRY.findall(_source())
    }


def bibtex(keys: Iterable[str], version: str) -> str:
    """Return the cited references as BibTeX, this package with its version."""
    wanted = list(keys)
    found = [match[0] for match in _ENTRY.finditer(_source()) if match[2] in wanted]
    own = (
        f"@misc{{{OWN},\n  author = {{{{The calib authors}}}},\n"
        "  title = {calib: probabilistic calibration of tyre-soil models},\n"
        f"  note = {{Version {version}}}\n}}"
    )
    return "\n\n".join([*found, *([own] if OWN in wanted else [])]) + "\n"


def short_citation(key: str) -> str:
    """Return a citation in a sentence: ``Harris et al. 2020``."""
    if key == OWN:
        return "The calib authors"
    entry = entries()[key]
    names = [_spelled(name).partition(",")[0] for name in entry["author"].split(" and ")]
    who = f"{names[0]} et al." if len(names) > 2 else " and ".join(names)
    return f"{who} {entry['year']}"


def bibliography(keys: Iterable[str], version: str) -> list[str]:
    """Return the cited references as lines of text, sorted by author and year."""
    lines = [_line(entries()[key]) for key in keys if key != OWN]
    if OWN in list(keys):
        lines.append(
            f"The calib authors. calib: probabilistic calibration of tyre-soil models. Version "
            f"{version}."
        )
    return sorted(lines, key=str.casefold)


def _line(entry: Mapping[str, str]) -> str:
    names = [_spelled(name) for name in entry["author"].split(" and ")]
    who = "; ".join(names[:3]) + ("; et al." if len(names) > 3 else "")
    number = f"({entry['number']})" if "number" in entry else ""
    pages = entry["pages"].replace("--", "\N{EN DASH}")
    where = f"doi:{entry['doi']}" if "doi" in entry else entry["url"]
    title = _spelled(entry["title"])
    return (
        f"{who} ({entry['year']}) {title}. {_spelled(entry['journal'])} {entry['volume']}{number}, "
        f"{pages}. {where}"
    )


def _spelled(text: str) -> str:
    """Turn BibTeX's spelling into letters."""
    accents = dict(zip("'\"^.`", "\u0301\u0308\u0302\u0307\u0300", strict=True))
    accented = re.sub(
        r"""\{\\(['"^.`])(\w)\}""",
        lambda m: unicodedata.normalize("NFC", m[2] + accents[m[1]]),
        text,
    )
    known = accented.replace(r"$\widehat{R}$", "R-hat").replace(r"\&", "&")
    return known.replace("--", "\N{EN DASH}").replace("{", "").replace("}", "")


_MARK = re.compile(r"\[@([^\]]+)\]|\[\$(\w+)\]|\[u:([^\]]*)\]|\[=(\w+)\]|\[!([^\]]*)\]|`([^`]*)`")


def cited(sentences: Iterable[str]) -> list[str]:
    """Return the keys that are cited, each once, in order."""
    marks = (match for sentence in sentences for match in _MARK.finditer(sentence) if match[1])
    return list(dict.fromkeys(key for match in marks for key in _keys(match[1])))


def _keys(mark: str) -> list[str]:
    return [key.strip(" @") for key in mark.split(";")]


def with_symbols(text: str, names: Iterable[str]) -> str:
    """Mark the parameters in a text by others; a lone letter may be a word of it, and stays."""
    text = text.replace("^2", "\N{SUPERSCRIPT TWO}").replace("^3", "\N{SUPERSCRIPT THREE}")
    spelt = {spelling: name for name in names for spelling in (plain(name), name)}
    known = sorted((s for s in spelt if len(s) > 1 or not s.isascii()), key=len, reverse=True)
    if not known:
        return text
    pattern = rf"(?<![\w/$])({'|'.join(map(re.escape, known))})(?!\w)"
    return re.sub(pattern, lambda match: f"[${spelt[match[0]]}]", text)


def _written(
    sentence: str, escape: Callable[[str], str], marks: Sequence[Callable[[str], str]]
) -> str:
    """Write a sentence: text by `escape`, marks of each kind in the order of `_MARK`."""
    sentence, written, end = unbroken(sentence), [], 0
    for match in _MARK.finditer(sentence):
        kind = next(i for i, text in enumerate(match.groups()) if text is not None)
        written += [escape(sentence[end : match.start()]), marks[kind](match.groups()[kind])]
        end = match.end()
    return "".join([*written, escape(sentence[end:])])


def _cite(mark: str) -> str:
    return f"({'; '.join(map(short_citation, _keys(mark)))})"


def _equations(write: Callable[[str], str]) -> Callable[[str], str]:
    return lambda model: ", ".join(map(write, get_model(model).latex))


def to_text(sentence: str) -> str:
    """Write a sentence as plain text."""
    return _written(sentence, str, (_cite, plain, unit_plain, _equations(text), str, str))


def to_html(sentence: str) -> Markup:
    """Write a sentence for a page."""
    return Markup(
        _written(
            sentence, lambda part: str(html_escape(part)),
            (lambda mark: str(html_escape(_cite(mark))), symbol_html, unit_html, _equations(mathml),
             lambda strong: f"<strong>{html_escape(strong)}</strong>",
             lambda code: f"<code>{html_escape(code)}</code>"),
        )
    )  # fmt: skip


def prose(text: str, names: Iterable[str]) -> Markup:
    """Write a plain sentence for a page, the parameters in it as symbols."""
    return to_html(with_symbols(text, names))


def to_latex(sentence: str) -> str:
    r"""Write a sentence for LaTeX; citations are ``\cite`` with the keys of `references.bib`."""
    written = _written(
        sentence, escape,
        (lambda mark: f"\\cite{{{','.join(_keys(mark))}}}",
         symbol,  # mathtext is a part of LaTeX
         latex_unit, _equations(str), lambda strong: f"\\textbf{{{escape(strong)}}}",
         # Long names and hashes may break after a slash.
         lambda code: f"\\texttt{{{escape(code).replace('/', '/' + chr(92) + 'allowbreak{}')}}}"),
    )  # fmt: skip
    return written.replace(" \\cite", "~\\cite")


def symbol_html(name: str) -> Markup:
    """Return a parameter's symbol: ``K_lo`` as K with a subscript."""
    stem, below = stem_and_subscript(name)
    inside = Markup("<i>{}</i>").format(plain(stem))
    return inside + Markup("<sub>{}</sub>").format(below) if below else inside


def unit_html(unit: str) -> Markup:
    """Return a unit with its powers raised; a dash where there is none."""
    if unit in ("1", ""):
        return Markup("&ndash;")
    raised = re.sub(r"\^(-?)(\w+)", r"<sup>\1\2</sup>", str(html_escape(degrees(unit))))
    return Markup(raised.replace("<sup>-", "<sup>&minus;"))
