"""The equation of every model, for text and for LaTeX, with what its letters mean."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

from calib.models import get_model

__all__ = ["equation_numbers", "latex_equation", "letters", "text_equation"]

_FORMULA = r"$Y = {shift}D \sin\{{C \arctan[B X - E (B X - \arctan B X)]\}}$"
_LATEX: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "ayers_perumpral": (
            r"$\gamma_\mathrm{d} = "
            r"\{(\mathrm{CI}/C_1)[C_2 + (\theta_\mathrm{g} - C_3)^2]\}^{1/C_4}$",
        ),
        "ayers_perumpral_volumetric": (
            r"$\mathrm{CI} = A_1 \gamma_\mathrm{d}^{A_2} / "
            r"[A_3 + (\theta_\mathrm{v}/\gamma_\mathrm{d} - A_4)^2]$",
            r"solved for $\gamma_\mathrm{d}$",
        ),
        "magic_formula": (
            _FORMULA.format(shift=r"S_\mathrm{v} + "), r"$X = x - S_\mathrm{h}$",
        ),
        "magic_formula_pressure": (
            _FORMULA.format(shift="").replace("X", "x"),
            "$B C D = c_4 + c_5 p + c_6 p^2$", "$C = b_0$", "$D = c_1 + c_2 p + c_3 p^2$",
            "$E = c_7 + c_8 p + c_9 p^2$",
        ),
        "bekker": (r"$z_0 = (p_\mathrm{gr}/k)^{1/n}$",),
        "modified_bekker": (r"$z_\mathrm{t} = (p_\mathrm{gr}/k)^{1/(n_0 + n_1 s)}$",),
    }
)  # fmt: skip

_SLIP = "[$Y] the drawbar pull (kN), [$x] the slip (%)"
_LETTERS: Mapping[str, str] = MappingProxyType(
    {
        "ayers_perumpral": (
            "[$gamma_d] the dry bulk density (g/cm³), CI the cone index (kPa), [$theta_g] the "
            "gravimetric water content (g/g)"
        ),
        "ayers_perumpral_volumetric": (
            "[$gamma_d] the dry bulk density (g/cm³), CI the cone index (kPa), [$theta_v] the "
            "volumetric water content (cm³/cm³)"
        ),
        "magic_formula": _SLIP,
        "magic_formula_pressure": f"{_SLIP}, [$p] the inflation pressure (psi)",
        "bekker": "[$z_0] the rut depth (m), [$p_gr] the ground pressure (kPa)",
        "modified_bekker": (
            "[$z_t] the rut depth (m), [$p_gr] the ground pressure (kPa), [$s] the slip (as a "
            "fraction)"
        ),
    }
)


_SPELT = {
    "gamma_": "\N{GREEK SMALL LETTER GAMMA}_", "theta_": "\N{GREEK SMALL LETTER THETA}_",
    "pgr": "p_gr", "zt": "z_t", "z0": "z_0", "kphi": "k_phi", "kc": "k_c",
}  # fmt: skip


def text_equation(model: str) -> str:
    """Return a model's equation as plain text."""
    text = get_model(model).equation.partition("  (Eq")[0]
    return re.sub("|".join(_SPELT), lambda match: _SPELT[match[0]], text)


def latex_equation(model: str) -> str:
    """Return a model's equation as mathematics in a line of text."""
    return ", ".join(_LATEX[model])


def letters(model: str) -> str:
    """Say, with marks, what the letters of an equation mean that are not parameters."""
    return _LETTERS[model]


def equation_numbers(model: str) -> str:
    """Return where the source prints a model: ``Eqs 12-15``."""
    found = re.search(r"\((Eqs? [^)]*)\)$", get_model(model).equation)
    return found[1].replace("-", "\N{EN DASH}") if found else ""
