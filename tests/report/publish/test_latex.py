"""Text as LaTeX sets it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.models import MODELS
from calib.report.numbers import TIMES
from calib.report.publish.markup import (
    cited,
    escape,
    joined_symbols,
    latex_unit,
    to_latex,
    to_text,
    with_symbols,
)
from tests.report.publish.reader import check


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("50 % of a_b & {c} #1 $5", r"50 \% of a\_b \& \{c\} \#1 \$5"),
        (r"a\b~c^d", r"a\textbackslash{}b\textasciitilde{}c\textasciicircum{}d"),
        (f"(3.3 ± 1.2){TIMES}10⁵", r"(3.3 $\pm$ 1.2)$\times$10$^{5}$"),
        (f"\N{MINUS SIGN}0.5{TIMES}10⁻¹¹", r"$-$0.5$\times$10$^{-11}$"),
        ("g/cm³ \N{EN DASH} \N{GREEK SMALL LETTER SIGMA} Ω", "g/cm$^{3}$ -- $\\sigma$ $\\Omega$"),
        ("Cappé, Şahin, 雪", "Cappé, Sahin, ?"),
    ],
)
def test_escape(text, latex):
    assert escape(text) == latex


@given(st.text())
def test_any_text_is_well_formed(text):
    check(escape(text))


def test_symbols_and_units():
    assert to_latex("[$K_lo]") == r"$K_\mathrm{lo}$"
    assert latex_unit("kPa (g/cm^3)^-C4") == "kPa (g/cm$^{3}$)$^{-C4}$"
    assert latex_unit("kN/%") == r"kN/\%"
    assert latex_unit("1") == "--"


@pytest.mark.parametrize("name", MODELS)
def test_every_model_has_its_equation(name):
    equation = to_latex(f"[={name}]")
    check(equation)
    check(to_latex(MODELS[name].letters))
    assert "Eq" not in to_text(f"[={name}]")
    # Of other sources than the paper the numbers are not known.
    numbers = MODELS[name].numbers
    assert numbers.startswith("Eq") if MODELS[name].cited == "He_2019" else not numbers
    # The parameters that the source prints are all in it.
    for parameter in MODELS[name].reported:
        digits = parameter.strip("ABCDEKSbcknvh")
        assert parameter[0] in equation
        assert not digits or digits in equation


def test_marks():
    sentence = "By [@He_2019; @Vehtari_2021], [$K_lo] in [u:kN/%] from `data/a_b.csv`: 5 %."
    assert cited([sentence, "[@He_2019]"]) == ["He_2019", "Vehtari_2021"]
    assert to_text(sentence) == (
        "By (He et al. 2019; Vehtari et al. 2021), K_lo in kN/% from data/a_b.csv: 5\u00a0%."
    )
    assert to_latex(sentence) == (
        r"By~\cite{He_2019,Vehtari_2021}, $K_\mathrm{lo}$ in kN/\% from "
        r"\texttt{data/\allowbreak{}a\_b.csv}: 5~\%."
    )
    assert joined_symbols(["a", "b", "c"]) == "[$a], [$b] and [$c]"


def test_parameters_in_a_text_become_symbols():
    assert with_symbols("As K_lo and C2, not C23; C in g/cm^3", ["K_lo", "C2", "C"]) == (
        "As [$K_lo] and [$C2], not C23; C in g/cm³"
    )
    assert with_symbols("As C", ["C"]) == "As C"
