r"""Model cards: what is said of the models, as data in `calib/models/cards`.

A file holds the cards of one module. What stands before its first model holds for all its models:
their own keys come first, and lists and tables are continued by it.

Equations are written once, in LaTeX, and read as plain text and as MathML.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import Any, Literal, NamedTuple
from unicodedata import normalize
from xml.etree import ElementTree

from calib.models.base import (
    Alone,
    Array,
    Conditions,
    Model,
    Parameters,
    as_they_are,
    no_references,
)


class Equation(NamedTuple):
    """The functions of a `Model`."""

    mean_response: Callable[..., Array]
    to_reported: Callable[..., Parameters] = as_they_are
    from_reported: Callable[..., Parameters] = as_they_are
    bind_references: Callable[[Conditions], dict[str, float]] = no_references
    whole: Callable[..., Any] | None = None


def from_cards(module: str, **equations: Equation) -> tuple[Model, ...]:
    """Return the models of a module by the cards in its file, in the order of the equations."""
    path = Path(__file__).parent / "cards" / f"{module}.toml"
    shared = tomllib.loads(path.read_text(encoding="utf-8"))
    models: dict[str, dict[str, Any]] = shared.pop("models")
    return tuple(
        _model(name, _continued(models[name], shared), equation)
        for name, equation in equations.items()
    )


def _model(name: str, card: dict[str, Any], equation: Equation) -> Model:
    """Return a model of its equation and its card.

    A card has fields of `Model`; `parameters` and `reported` with their meanings, and `symbols`,
    the meaning and unit of the other letters: those after a dollar are set as mathematics.
    """
    parameters, symbols = card.pop("parameters"), card.pop("symbols")
    reported: dict[str, dict[str, str]] = card.pop("reported", {})
    published = {p: said["meaning"] for p, said in reported.items() if "meaning" in said}
    letters = [
        f"[{symbol}] the {words}" if symbol.startswith("$") else f"{symbol} the {words}"
        for symbol, words in symbols.items()
    ]
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in card.items()}
    if "alone" in card:
        fields["alone"] = Alone(**card["alone"])
    return Model(
        name=name,
        parameters=tuple(parameters),
        reported={p: said["unit"] for p, said in reported.items()},
        meanings=parameters | published,
        latex=fields.pop("equation"),
        letters=", ".join(letters),
        **fields,
        **equation._asdict(),
    )


def _continued(own: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
    found = shared | own
    for key in own.keys() & shared.keys():
        if isinstance(own[key], list):
            found[key] = own[key] + shared[key]
        elif isinstance(own[key], dict):
            found[key] = own[key] | shared[key]
    return found


def mathml(latex: str) -> str:
    """Return words with mathematics between dollars as HTML with MathML."""
    parts = latex.split("$")
    return "".join(formula(part) if i % 2 else escape(part) for i, part in enumerate(parts))


def formula(latex: str, display: Literal["inline", "block"] = "inline") -> str:
    """Return mathematics as MathML, which browsers draw without script, font or request.

    They do not break its lines: inline, each part from a sign to the next is an element of its own.
    """
    row, signs = _parsed(latex), ("=", "+", "\N{MINUS SIGN}")
    parts: list[list[ElementTree.Element]] = [[]]
    for node in row:
        if display == "inline" and parts[-1] and node.tag == "mo" and node.text in signs:
            node.set("form", "infix")
            parts.append([])
        parts[-1].append(node)
    written = ("".join(ElementTree.tostring(n, "unicode") for n in part) for part in parts)
    return "\N{ZERO WIDTH SPACE}".join(
        f'<math display="{display}"><mrow>{p}</mrow></math>' for p in written
    )


def _parsed(latex: str) -> ElementTree.Element:
    """Return the row of a formula's parts as MathML."""
    from latex2mathml.converter import convert  # late: a tenth of a second

    # Browsers do not set functions off from the letters beside them.
    function = r"\\(?:sin|cos|tan|arctan|exp|ln|log|max|min)\b"
    latex = re.sub(rf"(?<=[\w)\]}}])\s*(?={function})", r"\\,", latex)
    latex = re.sub(rf"({function})\s*(?=[A-Za-z\\])", r"\1\\,", latex)
    # HTML needs no name space.
    return ElementTree.fromstring(re.sub(' xmlns="[^"]*"', "", str(convert(latex))))[0]


def text(latex: str) -> str:
    """Return words with mathematics between dollars as plain text."""
    parts = latex.split("$")
    written = (_row(_parsed(part)) if i % 2 else part for i, part in enumerate(parts))
    return normalize("NFKC", "".join(written)).replace("\N{MINUS SIGN}", "-")


def _row(nodes: Iterable[ElementTree.Element]) -> str:
    """Write parts side by side, spaces about operators and between letters."""
    row, upright = "", False
    for node in nodes:
        part = _part(node)
        operator = node.tag == "mo" and part in "=+\u2212\u00b7\u00d7\u2264\u2265<>"
        if operator and row and row[-1] not in "([{/ ":
            part = f" {part} "
        elif row and _ends_word(row) and _begins_word(part):
            part = part if upright and node.get("mathvariant") == "normal" else f" {part}"
        row, upright = row + part, node.get("mathvariant") == "normal"
    return row


def _ends_word(row: str) -> bool:
    return row[-1].isalnum() or row[-1] in ")]}\u222b"


def _begins_word(part: str) -> bool:
    return part[:1].isalnum() or part[:1] in ("\u221a", "\u222b", "\u2202", "\u221e")


def _part(node: ElementTree.Element) -> str:
    parts = [_row([child]) for child in node]
    match node.tag:
        case "msub":
            return "{}_{}".format(*parts)
        case "msup":
            return parts[0] + _raised(parts[1])
        case "msubsup":
            return "{}_{}".format(*parts) + _raised(parts[2])
        case "mfrac":
            return "({})/({})".format(*parts)
        case "msqrt":
            return f"\u221a({_row(node)})"
    return _row(node) if len(node) else (node.text or "").strip()


def _raised(part: str) -> str:
    return f"^{part}" if len(part) == 1 else f"^({part})"
