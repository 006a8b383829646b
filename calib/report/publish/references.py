"""The references that are cited: read from `references.bib`, written as BibTeX and as text.

Authors, volumes and pages are those that the packages and journals give themselves (the citation
files of NumPy, SciPy, Matplotlib, emcee and corner, the bibliography shipped with ArviZ).
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import resources

OWN = "calib"
_ENTRY = re.compile(r"@(\w+)\{(\w+),\n(.*?)\n\}", re.DOTALL)
_FIELD = re.compile(r"^  (\w+) = \{(.*)\},?$", re.MULTILINE)
_ACCENTS = {"'": "\u0301", '"': "\u0308", "^": "\u0302", ".": "\u0307", "`": "\u0300"}
_NAMED = 3


@cache
def _source() -> str:
    return (resources.files("calib.report.publish") / "references.bib").read_text(encoding="utf-8")


@cache
def entries() -> Mapping[str, Mapping[str, str]]:
    """Return the fields of every reference by its key, as BibTeX has them."""
    return {key: dict(_FIELD.findall(body)) for _, key, body in _ENTRY.findall(_source())}


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
    names = [_plain(name).partition(",")[0] for name in entry["author"].split(" and ")]
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
    names = [_plain(name) for name in entry["author"].split(" and ")]
    who = "; ".join(names[:_NAMED]) + ("; et al." if len(names) > _NAMED else "")
    number = f"({entry['number']})" if "number" in entry else ""
    pages = entry["pages"].replace("--", "\N{EN DASH}")
    where = f"doi:{entry['doi']}" if "doi" in entry else entry["url"]
    title = _plain(entry["title"])
    return (
        f"{who} ({entry['year']}) {title}. {_plain(entry['journal'])} {entry['volume']}{number}, "
        f"{pages}. {where}"
    )


def _plain(text: str) -> str:
    """Turn BibTeX's spelling into letters."""
    accented = re.sub(
        r"""\{\\(['"^.`])(\w)\}""",
        lambda m: unicodedata.normalize("NFC", m[2] + _ACCENTS[m[1]]),
        text,
    )
    known = accented.replace(r"$\widehat{R}$", "R-hat").replace(r"\&", "&")
    return known.replace("--", "\N{EN DASH}").replace("{", "").replace("}", "")
