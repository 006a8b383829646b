r"""Equations: written once, in LaTeX, and read as plain text and as HTML.

What is understood: letters, numbers and signs, Greek letters and functions (``\gamma``, ``\exp``),
``\mathrm{...}``, ``\frac{a}{b}``, ``\sqrt{a}``, sub- and superscripts, ``\{`` and ``\}``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from html import escape

_TOKEN = re.compile(r"\\[A-Za-z]+|\\.|[{}^_]|\d+(?:\.\d+)?|\s+|.", re.DOTALL)
_FUNCTIONS = frozenset({"sin", "cos", "tan", "arctan", "exp", "ln", "log", "max", "min"})
_SIGNS = {"cdot": "\N{DOT OPERATOR}", "times": "\N{MULTIPLICATION SIGN}", "le": "\u2264",
          "ge": "\u2265", "int": "\u222b", "infty": "\u221e", "partial": "\u2202",
          "quad": " ", "left": "", "right": ""}  # fmt: skip
_GREEK = dict(zip(
    ("alpha", "beta", "gamma", "delta", "epsilon", "eta", "theta", "kappa", "lambda", "mu", "nu",
     "rho", "sigma", "tau", "phi", "chi", "psi", "omega"),
    "\u03b1\u03b2\u03b3\u03b4\u03b5\u03b7\u03b8\u03ba\u03bb\u03bc\u03bd"
    "\u03c1\u03c3\u03c4\u03c6\u03c7\u03c8\u03c9", strict=True,
))  # fmt: skip
_SPACES = {",", ";", "!", " "}


@dataclass(frozen=True)
class _Writer:
    """How the parts of an equation are written."""

    letter: Callable[[str], str]
    upright: Callable[[str], str]
    below: Callable[[str], str]
    above: Callable[[str], str]
    minus: str

    def group(self, tokens: Iterator[str], end: str = "") -> str:
        """Write all up to a closing brace."""
        written = []
        for token in tokens:
            if token == end:
                break
            written.append(self.one(token, tokens))
        return "".join(written)

    def argument(self, tokens: Iterator[str]) -> str:
        """Write what a command or a script applies to."""
        token = next(tokens, "")
        while token.isspace():
            token = next(tokens, "")
        return self.group(tokens, "}") if token == "{" else self.one(token, tokens)

    def one(self, token: str, tokens: Iterator[str]) -> str:
        if token in "^_" and token:
            return (self.above if token == "^" else self.below)(self.argument(tokens))
        if token == "{":
            return self.group(tokens, "}")
        if not token.startswith("\\"):
            if token == "-":
                return self.minus
            return self.letter(token) if token.isalpha() else self.upright(token)
        name = token[1:]
        if name in ("mathrm", "text"):
            next(tokens)
            return self.upright("".join(iter(lambda: next(tokens, "}"), "}")))
        if name == "frac":
            over, under = self.argument(tokens), self.argument(tokens)
            return f"({over})/({under})"
        if name == "sqrt":
            return f"{self.upright('\u221a')}({self.argument(tokens)})"
        if name in _FUNCTIONS:
            return self.upright(name)
        if name in _GREEK:
            return self.letter(_GREEK[name])
        return "" if name in _SPACES else self.upright(_SIGNS.get(name, name))


def _same(part: str) -> str:
    return part


_TEXT = _Writer(
    _same, _same, lambda s: f"_{s}", lambda s: f"^{s}" if len(s) == 1 else f"^({s})", "-"
)
_HTML = _Writer(
    lambda s: f"<i>{s}</i>", escape, lambda s: f"<sub>{s}</sub>", lambda s: f"<sup>{s}</sup>",
    "\N{MINUS SIGN}",
)  # fmt: skip


def _written(latex: str, writer: _Writer) -> str:
    parts = latex.split("$")
    return "".join(
        writer.group(iter(_TOKEN.findall(part))) if i % 2 else part for i, part in enumerate(parts)
    )


def text(latex: str) -> str:
    """Return words with mathematics between dollars as plain text."""
    return _written(latex, _TEXT)


def html(latex: str) -> str:
    """Return words with mathematics between dollars as HTML."""
    return _written(latex, _HTML)
