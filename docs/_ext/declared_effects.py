"""A page for each effect, from its `Effect` and its priors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import effect_pictures
from declared_text import (
    code,
    picture_name,
    priors_table,
    quantity_link,
    role_links,
    table,
    with_picture,
    words,
)

from calib.gap.effects import EFFECTS, Effect
from calib.gap.hypotheses import read_effect_priors
from calib.report.labels import form_words, how_testable, known_words

TITLE = "Effects"
LEAD = (
    "What a diagnosis knows by name: each is something that the simulator does not model, acting "
    "in the field only. Each page is made from the effect's declaration and its prior file; "
    "`calib effects NAME` says the same in a terminal, of your own as well; "
    "[an effect of your own](../../extend.md) is one class more."
)


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


def pictures() -> dict[str, Callable[[], bytes]]:
    """Return how to draw what each effect does, by the name of its file."""
    return {
        picture_name(e.name, _page_without_picture(e)): partial(effect_pictures.drawn, e)
        for e in EFFECTS.values()
    }


def _page(effect: Effect) -> str:
    what, how = effect_pictures.said(effect)
    said = f"{words(effect.title)}: {what}"
    return with_picture(_page_without_picture(effect), effect.name, said, f"{how}\n\n")


def _page_without_picture(effect: Effect) -> str:
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
    form = form_words(effect)
    more = "See [the statistics](../../statistics/diagnosis.md)." if effect.form else ""
    return [
        "## When it can be tested, and its limits\n",
        *(f"- {sentence}" for sentence in how_testable(effect, quantity_link)),
        "\nWhere that does not hold, the diagnosis lists it as not testable, with the reason.\n",
        f"{' '.join([form, *known_words(effect), more])}".rstrip() + "\n",
    ]


def _priors(effect: Effect) -> list[str]:
    return [
        "## Priors\n",
        priors_table(read_effect_priors(effect, {}).entries),
        "Distributions are written as on the [models' pages](../models/index.md).\n",
    ]
