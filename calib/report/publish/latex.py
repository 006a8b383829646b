"""Text, symbols and units for LaTeX."""

from __future__ import annotations

import re
import unicodedata

from calib.report.labels import unit_text

_SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": "$<$", ">": "$>$", "|": "$|$", '"': "''",
}  # fmt: skip
_SIGNS = {
    "\N{MINUS SIGN}": "$-$",
    "\N{PLUS-MINUS SIGN}": r"$\pm$",
    "\N{MULTIPLICATION SIGN}": r"$\times$",
    "\N{LESS-THAN OR EQUAL TO}": r"$\le$",
    "\N{GREATER-THAN OR EQUAL TO}": r"$\ge$",
    "\N{EN DASH}": "--",
    "\N{EM DASH}": "---",
    "\N{HORIZONTAL ELLIPSIS}": r"\ldots{}",
    "\N{LEFT SINGLE QUOTATION MARK}": "`",
    "\N{RIGHT SINGLE QUOTATION MARK}": "'",
    "\N{LEFT DOUBLE QUOTATION MARK}": "``",
    "\N{RIGHT DOUBLE QUOTATION MARK}": "''",
    "\N{DEGREE SIGN}": r"$^{\circ}$",
    "\N{MICRO SIGN}": r"$\mu$",
    "\N{NO-BREAK SPACE}": "~",
    "\N{CHECK MARK}": r"\rlap{$^{\ast}$}",
}
# Letters that LaTeX has by their names; it lacks those that look Latin.
_NAMES = frozenset(
    {
        "ALPHA", "BETA", "GAMMA", "DELTA", "EPSILON", "ZETA", "ETA", "THETA", "IOTA", "KAPPA",
        "MU", "NU", "XI", "PI", "RHO", "SIGMA", "TAU", "PHI", "CHI", "PSI", "OMEGA",
    }
)  # fmt: skip
_CAPITALS = frozenset({"GAMMA", "DELTA", "THETA", "XI", "PI", "SIGMA", "PHI", "PSI", "OMEGA"})
_RAISED = "\N{SUPERSCRIPT MINUS}⁰¹²³⁴⁵⁶⁷⁸⁹"
_TO_PLAIN = str.maketrans(_RAISED, "-0123456789")


def escape(text: str) -> str:
    """Return any text as LaTeX sets it.

    Raised digits, signs and Greek letters become mathematics, letters that LaTeX's default encoding
    lacks lose their accents, and what is left of others is a question mark.
    """
    raised = re.split(f"([{_RAISED}]+)", text)
    return "".join(
        f"$^{{{part.translate(_TO_PLAIN)}}}$" if k % 2 else "".join(map(_letter, part))
        for k, part in enumerate(raised)
    )


def _letter(letter: str) -> str:
    known = _SPECIAL.get(letter) or _SIGNS.get(letter) or _greek(letter)
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
    if script == "GREEK SMALL" and name in _NAMES:
        return f"$\\{name.lower()}$"
    if script == "GREEK CAPITAL" and name in _CAPITALS:
        return f"$\\{name.capitalize()}$"
    return None


def latex_unit(unit: str) -> str:
    """Return a unit with its powers raised; a dash where there is none."""
    return unit_text(unit).replace("%", r"\%").replace("\N{EN DASH}", "--")
