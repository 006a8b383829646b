"""A page for each effect, from its `Effect` and its priors."""

from __future__ import annotations

from declared_text import code, priors_table, role_links, table, words

from calib.gap.effects import EFFECTS, Effect
from calib.gap.forward import FORM_ERROR
from calib.inference.prior_files import DeclaredPriors, default_priors, read_priors

TITLE = "Effects"
LEAD = (
    "What a diagnosis knows by name: each is something that the simulator does not model, acting "
    "in the field only. Each page is made from the effect's declaration and its prior file; "
    "[an effect of your own](../../extend.md) is one class more."
)
_ALONG = {
    "size": "its size", "slip": "slip", "pressure": "inflation pressure", "cone": "cone index",
    "water": "water content", "shape": "what it is named for",
    "extrapolation": "pressures that the simulator was not fitted at",
}  # fmt: skip


def overview() -> list[str]:
    """Return a table of all effects."""
    rows = (
        (f"[{code(e.name)}]({e.name}.md)", words(e.title), role_links(e.outputs, output=True),
         role_links(e.covariates, output=False) or "nothing more")
        for e in EFFECTS.values()
    )  # fmt: skip
    return [table(("effect", "what happens in the field", "touches", "needs recorded"), rows)]


def pages() -> dict[str, str]:
    """Return the page of every effect by its name."""
    return {name: _page(effect) for name, effect in EFFECTS.items()}


def _page(effect: Effect) -> str:
    text = f"{effect.title[0].upper()}{effect.title[1:]}."
    equation = [f"{part}\n" for part in effect.latex]
    note = "The subscript f marks what holds in the field; names are the parameters below.\n"
    return "\n".join(
        [
            f"# {effect.name}\n",
            f"{words(text)}\n",
            *(["## Equation\n", *equation, note] if equation else []),
            *_use(effect),
            *_priors(effect),
        ]
    )


def _use(effect: Effect) -> list[str]:
    found = [
        "## When it can be tested, and its limits\n",
        f"- The case models {_one_of(effect.outputs)}.",
    ]
    if effect.needs:
        found.append(
            f"- Among them must be {role_links(effect.needs, output=True)}: its trace in the "
            "others could be another effect's as well."
        )
    if effect.covariates:
        found.append(f"- The field records {role_links(effect.covariates, output=False)}.")
        if effect.varies:
            found.append("- This varies in the field, or differs from the laboratory's.")
    found.append(
        "\nWhere that does not hold, the diagnosis lists it as not testable, with the reason.\n"
    )
    if effect.form:
        errors = ", ".join(f"{FORM_ERROR[f]:g} along {_ALONG[f]}" for f in effect.form)
        found.append(
            "No formula is exact: its effect may depart from it (relative sd "
            f"{errors}), see [the statistics](../../statistics/diagnosis.md).\n"
        )
    else:
        found.append("The formula is taken as exact.\n")
    return found


def _one_of(outputs: tuple[str, ...]) -> str:
    links = role_links(outputs, output=True)
    return f"one of {links}" if len(outputs) > 1 else links


def _priors(effect: Effect) -> list[str]:
    file = effect.prior_file or default_priors(f"effects/{effect.name}")
    if effect.priors:
        file = DeclaredPriors(f"{effect.name}.toml", effect.priors)
    priors = read_priors(file, effect.name, effect.parameters, {})
    return [
        "## Priors\n",
        priors_table(priors.entries),
        "Distributions are written as on the [models' pages](../models/index.md).\n",
    ]
