"""What all pages share: templates from one set-up, pictures inside them, symbols as HTML."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import PurePosixPath
from string import ascii_letters
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from calib.data.reader import said_of
from calib.inference.problem import Problem
from calib.models import BoundModel
from calib.models.latex import html
from calib.report.figures.plate import Plate
from calib.report.labels import (
    MINUS,
    axis_of,
    degrees,
    joined,
    percent,
    plain,
    short,
    stem_and_subscript,
    unbroken,
)
from calib.report.numbers import (
    format_number,
    format_value,
)

_HERE = "calib.report.page"


def _known(value: float | None, form: str | int = 3) -> str:
    """Write a number that may be missing, to some digits or by a format."""
    if value is None:
        return "undefined"
    return form.format(value) if isinstance(form, str) else format_number(value, form)


_FILTERS: dict[str, Callable[..., str]] = {
    "unbroken": unbroken,
    "basename": lambda path: PurePosixPath(path).name,
    "joined": joined,
    "said_of": said_of,
    "percent": percent,
    "short": short,
    "value": format_value,
    "number": format_number,
    "known": _known,
    "g": lambda value: f"{value:g}",
    "lower_first": lambda text: text[0].lower() + text[1:],
}


def png_size(image: bytes) -> tuple[int, int]:
    """Return width and height of a PNG file, which keep the page from jumping while it loads."""
    return int.from_bytes(image[16:20]), int.from_bytes(image[20:24])


@cache
def template(name: str, package: str = _HERE, *, html: bool = True) -> Template:
    """Return a template by the name of its file in a package, which may include those of this one.

    For HTML it escapes what it is given; a name that it is not given is an error.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(p, ".") for p in dict.fromkeys((package, _HERE))]),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= _FILTERS
    return environment.get_template(name)


def sentences(**filters: Callable[..., str]) -> Callable[..., str]:
    """Return what fills facts into a sentence, a template in a string; its lines are joined."""
    environment = Environment(undefined=StrictUndefined)
    environment.filters |= _FILTERS | filters
    compiled = cache(environment.from_string)
    return lambda text, **facts: re.sub(r"[ \n]+", " ", compiled(text).render(facts)).strip()


def data_uri(image: bytes) -> str:
    """Return a PNG file as an address that holds it; nothing for none."""
    return f"data:image/png;base64,{base64.b64encode(image).decode()}" if image else ""


def picture(plate: Plate, image: bytes, caption: str) -> dict[str, Any]:
    """Return what a template shows of a plate, `image` being its file, empty where there is none.

    The caption is that of the plate as the page writes it.
    """
    return {
        "heading": plate.heading or plate.name.replace("_", " ").capitalize(),
        "caption": caption,
        "uri": data_uri(image),
        "size": png_size(image) if image else (0, 0),
    }


def symbol_html(name: str) -> Markup:
    """Return a parameter's symbol: ``K_lo`` as K with a subscript."""
    stem, below = stem_and_subscript(name)
    inside = Markup("<i>{}</i>").format(plain(stem))
    return inside + Markup("<sub>{}</sub>").format(below) if below else inside


def unit_html(unit: str) -> Markup:
    """Return a unit with its powers raised; a dash where there is none."""
    if unit in ("1", ""):
        return Markup("&ndash;")
    raised = re.sub(r"\^(-?)(\w+)", r"<sup>\1\2</sup>", str(escape(degrees(unit))))
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


def equation(bound: BoundModel) -> Markup:
    """Return the equation of a model."""
    model = bound.model
    written = Markup(", ").join(Markup(html(part)) for part in model.latex)
    number = model.numbers.replace("-", "\N{EN DASH}")
    mark = Markup(" <span class='eq'>({})</span>").format(number) if number else ""
    return Markup("{}{}").format(written, mark)


def likelihood(problem: Problem, output: str) -> str:
    """Say what the likelihood is."""
    noise = problem.noise
    what = f"the logarithm of {output}" if problem.bound.model.response == "log" else output
    law, scale = ("normal", "standard deviation")
    if noise.student:
        law, scale = "Student-t, of unknown degrees of freedom nu,", "scale"
    rows = "Rows are independent"
    if noise.choice.correlated_along:
        rows = (
            f"Rows are correlated along {noise.choice.correlated_along}, by rho to the power of "
            "how many rows they are apart"
        )
    text = f"{rows}; {what} is {law} about the prediction, with "
    if not noise.column:
        return f"{text}one unknown {scale} sigma for all rows."
    column = axis_of(noise.column)
    return (
        f"{text}a {scale} that is sigma at the mean {column.name.lower()} of the rows, "
        f"{column.value_text(noise.centre)} {column.unit}, and whose logarithm changes by "
        f"sigma_slope for each sd of it, {column.value_text(noise.spread)} {column.unit}."
    )


def parametrisation(bound: BoundModel) -> str:
    """Say which parameters are sampled, and why these."""
    references = dict(bound.references)
    for name, half in bound.references.items():
        stem, middle, unit = name.partition("_half_")
        if middle:
            middle_at = references[f"{stem}_mid_{unit}"]
            references[f"{stem}_low_{unit}"] = middle_at - half
            references[f"{stem}_high_{unit}"] = middle_at + half
    return bound.model.parametrisation.format(**references).replace(" - ", f" {MINUS} ")
