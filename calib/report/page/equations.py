"""Equations, likelihood and parametrisation of each model, as HTML fragments."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from string import ascii_letters

from markupsafe import Markup, escape

from calib.models import BoundModel
from calib.report.figures.labels import MINUS, plain, stem_and_subscript, unbroken

__all__ = [
    "equation", "likelihood", "parametrisation", "prose", "symbol_html", "unit_html",
]  # fmt: skip

_GREEK = {"sigma": Markup("&sigma;"), "gamma": Markup("&gamma;"), "theta": Markup("&theta;")}


def symbol_html(name: str) -> Markup:
    """Return a parameter's symbol: ``K_lo`` as K with a subscript."""
    stem, below = stem_and_subscript(name)
    inside = Markup("<i>{}</i>").format(_GREEK.get(stem, stem))
    return inside + Markup("<sub>{}</sub>").format(below) if below else inside


def unit_html(unit: str) -> Markup:
    """Return a unit with its powers raised; a dash where there is none."""
    if unit in ("1", ""):
        return Markup("&ndash;")
    raised = re.sub(r"\^(-?)(\w+)", r"<sup>\1\2</sup>", str(escape(unit)))
    return Markup(raised.replace("<sup>-", "<sup>&minus;"))


def prose(text: str, names: Iterable[str]) -> Markup:
    """Escape a sentence and set the parameters in it as symbols.

    Single letters stay as they are: a lone C or n may be a word of the sentence.
    """
    spellings = {plain(name): name for name in names} | {name: name for name in names}
    telling = sorted((s for s in spellings if len(s) > 1 or s not in ascii_letters), key=len)
    escaped = str(escape(unbroken(text)))
    if telling:
        pattern = "|".join(re.escape(s) for s in reversed(telling))
        escaped = re.sub(
            rf"(?<![\w/])({pattern})(?!\w)",
            lambda match: str(symbol_html(spellings[match.group()])),
            escaped,
        )
    return Markup(escaped)


_MAGIC = (
    "<i>Y</i> = {shift}<i>D</i> sin{{<i>C</i> arctan[<i>B X</i> &minus; <i>E</i>(<i>B X</i> "
    "&minus; arctan <i>B X</i>)]}}"
)
_EQUATIONS: Mapping[str, str] = {
    "ayers_perumpral": (
        "<i>&gamma;</i><sub>d</sub> = {(CI/<i>C</i><sub>1</sub>) [<i>C</i><sub>2</sub> + "
        "(<i>&theta;</i><sub>g</sub> &minus; <i>C</i><sub>3</sub>)<sup>2</sup>]}"
        "<sup>1/<i>C</i><sub>4</sub></sup> <span class='eq'>(Eq 1)</span>"
    ),
    "ayers_perumpral_volumetric": (
        "CI = <i>A</i><sub>1</sub> <i>&gamma;</i><sub>d</sub><sup><i>A</i><sub>2</sub></sup> / "
        "[<i>A</i><sub>3</sub> + (<i>&theta;</i><sub>v</sub>/<i>&gamma;</i><sub>d</sub> &minus; "
        "<i>A</i><sub>4</sub>)<sup>2</sup>], solved for <i>&gamma;</i><sub>d</sub> "
        "<span class='eq'>(Eq 2)</span>"
    ),
    "magic_formula": _MAGIC.format(shift="<i>S</i><sub>v</sub> + ")
    + ", <i>X</i> = slip (%) &minus; <i>S</i><sub>h</sub> <span class='eq'>(Eqs 3&ndash;5)</span>",
    "magic_formula_pressure": _MAGIC.format(shift="")
    + ", <i>X</i> = slip (%)<br><i>BCD</i> = <i>c</i><sub>4</sub> + <i>c</i><sub>5</sub><i>p</i> + "
    "<i>c</i><sub>6</sub><i>p</i><sup>2</sup>, <i>C</i> = <i>b</i><sub>0</sub>, <i>D</i> = "
    "<i>c</i><sub>1</sub> + <i>c</i><sub>2</sub><i>p</i> + <i>c</i><sub>3</sub><i>p</i>"
    "<sup>2</sup>, <i>E</i> = <i>c</i><sub>7</sub> + <i>c</i><sub>8</sub><i>p</i> + "
    "<i>c</i><sub>9</sub><i>p</i><sup>2</sup> <span class='eq'>(Eqs 12&ndash;15)</span>",
    "bekker": (
        "<i>z</i> = (<i>p</i><sub>gr</sub>/<i>k</i>)<sup>1/<i>n</i></sup> "
        "<span class='eq'>(Eqs 17, 19, 20)</span>"
    ),
    "modified_bekker": (
        "<i>z</i> = (<i>p</i><sub>gr</sub>/<i>k</i>)<sup>1/(<i>n</i><sub>0</sub> + "
        "<i>n</i><sub>1</sub><i>s</i>)</sup> <span class='eq'>(Eqs 18, 20, 21)</span>"
    ),
}


def equation(bound: BoundModel) -> Markup:
    """Return the equation of a model."""
    known = _EQUATIONS.get(bound.model.name)
    return Markup(known) if known else escape(bound.model.equation)


def likelihood(bound: BoundModel, output: str) -> str:
    """Say what the likelihood is."""
    what = f"the logarithm of {output}" if bound.model.response == "log" else output
    return (
        f"Rows are independent; {what} is normal about the prediction, with one unknown standard "
        "deviation sigma for all rows."
    )


_GAMMA = (
    "The density gamma_ref at a cone index of {ci_ref_kpa:.4g} kPa and a water content of "
    "{water_ref:.3g} (means of the data) is sampled in the place of {first}, with which the "
    "other coefficients are almost collinear; {first} follows from it."
)
_DEPTH = (
    "The rut z_ref of a towed wheel at {p_ref_kpa:.4g} kPa (mean of the data) is sampled in the "
    "place of k, which is almost collinear with {exponent}; k follows from it."
)
_PARAMETRISATIONS: Mapping[str, str] = {
    "ayers_perumpral": _GAMMA,
    "ayers_perumpral_volumetric": _GAMMA,
    "bekker": _DEPTH,
    "modified_bekker": _DEPTH,
    "magic_formula": (
        "The initial slope K = BCD is sampled in the place of B, and G = 1 {minus} E in that "
        "of E; B and E follow."
    ),
    "magic_formula_pressure": (
        "Each quadratic in pressure is sampled through its values at the lowest (_lo) and highest "
        "(_hi) calibrated pressure, {p_low:.4g} and {p_high:.4g} psi, and its relative curvature "
        "between them (_bend): K = BCD, D and G = 1 {minus} E. All three quadratics must stay "
        "positive between these pressures, which truncates the priors (bends below about 1). The "
        "coefficients c1 to c9 of the source follow."
    ),
}


def parametrisation(bound: BoundModel) -> str:
    """Say which parameters are sampled, and why these."""
    references = dict(bound.references)
    if "p_mid_psi" in references:
        references["p_low"] = references["p_mid_psi"] - references["p_half_psi"]
        references["p_high"] = references["p_mid_psi"] + references["p_half_psi"]
    name = bound.model.name
    words = {
        "first": "A1" if name.endswith("volumetric") else "C1",
        "exponent": "n" if name == "bekker" else "n0",
        "minus": MINUS,
    }
    template = _PARAMETRISATIONS.get(name, "The parameters of the equation are sampled.")
    return template.format(**references, **words)
