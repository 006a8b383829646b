"""A strict reader of the LaTeX that tables and methods are made of."""

from __future__ import annotations

import re

GREEK = {
    "alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa", "mu",
    "nu", "xi", "pi", "rho", "sigma", "tau", "phi", "chi", "psi", "omega", "Gamma", "Delta",
    "Theta", "Xi", "Pi", "Sigma", "Phi", "Psi", "Omega",
}  # fmt: skip
COMMANDS = {
    "allowbreak", "arctan", "ast", "begin", "bottomrule", "caption", "centering", "chi", "cite",
    "cos", "exp", "frac", "int", "sqrt", "tan",
    "end", "footnotesize", "gamma", "label", "ldots", "le", "ge", "mathrm", "midrule", "mu",
    "paragraph", "pm", "raggedright", "rlap", "sigma", "sin", "small", "tabularnewline", "tau",
    "textasciicircum", "textbackslash", "texttt", "textwidth", "theta", "times", "toprule",
    "textasciitilde", "textbf", "circ", *GREEK,
}  # fmt: skip
MATH_ONLY = {
    "arctan", "ast", "circ", "cos", "exp", "frac", "int", "le", "ge", "mathrm", "pm", "sin", "sqrt",
    "tan", "times", *GREEK,
}  # fmt: skip


def check(text: str) -> None:
    """Check that braces, environments and mathematics are closed, and every sign is escaped."""
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    # Keys are read as they stand.
    body = re.sub(r"\\(cite|label)\{[\w,:-]+\}", "", body)
    depth, math, environments = 0, False, []
    for token in re.finditer(
        r"\\(begin|end)\{(\w+)\}|\\([A-Za-z]+)|\\(.)|([{}$&%#_^~])|(.)", body, re.DOTALL
    ):
        edge, environment, command, escaped, special, other = token.groups()
        if edge == "begin":
            environments.append(environment)
        elif edge == "end":
            assert environments.pop() == environment
        elif command:
            assert command in COMMANDS, command
            assert math or command not in MATH_ONLY, (command, body[token.start() - 30 :][:60])
        elif escaped:
            assert escaped in r"\&%$#_{}", escaped
        elif special == "{":
            depth += 1
        elif special == "}":
            depth -= 1
            assert depth >= 0
        elif special == "$":
            math = not math
        elif special in ("_", "^"):
            assert math, body[token.start() - 30 :][:60]
        elif special == "&":
            assert environments
            assert environments[-1] == "tabular"
        elif special:
            assert special == "~", special
        elif not other.isascii():
            assert "À" <= other <= "ÿ", other
    assert depth == 0
    assert not math
    assert not environments


def rows(text: str) -> list[list[str]]:
    """The cells of a table's rows, head first."""
    inside = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0].replace(r"\midrule", "")
    lines = [line.strip() for line in inside.split(r"\tabularnewline")]
    return [[c.strip() for c in re.split(r"(?<!\\)&", line)] for line in lines if line]


def columns(text: str) -> int:
    """How many columns a tabular declares."""
    found = re.search(r"\\begin\{tabular\}\{(.*)\}$", text, re.MULTILINE)
    assert found is not None
    return len(re.sub(r"p\{[^}]*\}", "p", found[1]))
