"""What all pages share: templates from one set-up, pictures inside them, symbols as HTML."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from calib.data.reader import said_of
from calib.models.card import mathml
from calib.report.labels import (
    MINUS,
    joined,
    odds_text,
    percent,
    plain,
    short,
    unbroken,
    unit_after,
)
from calib.report.numbers import (
    format_number,
    format_value,
)

if TYPE_CHECKING:
    from calib.report.figures.style import Plate

_HERE = "calib.report.page"


def _known(value: float | None, form: str | int = 3) -> str:
    """Write a number that may be missing, to some digits or by a format."""
    if value is None:
        return "undefined"
    return form.format(value) if isinstance(form, str) else format_number(value, form)


_FILTERS: dict[str, Callable[..., Any]] = {
    "unbroken": unbroken,
    # The steps of a text that begins with (1).
    "steps": lambda text: re.split(r"\s*\(\d\) ", text)[1:] if text.startswith("(1) ") else [],
    "plain": plain,
    "basename": lambda path: PurePosixPath(path).name,
    "joined": joined,
    "said_of": said_of,
    "odds": odds_text,
    "percent": percent,
    "short": short,
    "value": format_value,
    "number": format_number,
    "known": _known,
    "unit_after": unit_after,
    "g": lambda value: f"{value:g}",
    "lower_first": lambda text: text[0].lower() + text[1:],
    "upper_first": lambda text: text[:1].upper() + text[1:],
}


def png_size(image: bytes) -> tuple[int, int]:
    """Return width and height of a PNG file, which keep the page from jumping while it loads."""
    return int.from_bytes(image[16:20]), int.from_bytes(image[20:24])


@cache
def template(name: str, package: str = _HERE, *, html: bool = True, trim: bool = True) -> Template:
    """Return a template by the name of its file in a package, which may include those of this one.

    For HTML it escapes what it is given; a name that it is not given is an error. Lines of a block
    alone leave no white space if `trim`.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(p, ".") for p in dict.fromkeys((package, _HERE))]),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=trim,
        lstrip_blocks=trim,
    )
    environment.filters |= _FILTERS
    return environment.get_template(name)


def words(name: str, package: str, **facts: Any) -> str:
    """Fill facts into the sentences of a template; its lines are joined."""
    return _one_line(template(name, package, html=False).render(facts))


def _one_line(text: str) -> str:
    return re.sub(r"[ \n]+", " ", text).strip()


def sentences(**filters: Callable[..., str]) -> Callable[..., str]:
    """Return what fills facts into a sentence, a template in a string; its lines are joined."""
    environment = Environment(undefined=StrictUndefined)
    environment.filters |= _FILTERS | filters
    compiled = cache(environment.from_string)
    return lambda text, **facts: _one_line(compiled(text).render(facts))


def data_uri(image: bytes) -> str:
    """Return a PNG file as an address that holds it; nothing for none."""
    return f"data:image/png;base64,{base64.b64encode(image).decode()}" if image else ""


def picture(plate: Plate, image: bytes, caption: str, narrow: bytes = b"") -> dict[str, Any]:
    """Return what a template shows of a plate, `image` being its file, empty where there is none.

    The caption is that of the plate as the page writes it. For narrow screens there may be another.
    """
    return {
        "heading": plate.heading or plate.name.replace("_", " ").capitalize(),
        "caption": caption,
        "uri": data_uri(image),
        "size": png_size(image) if image else (0, 0),
        "points": plate.points,
        "narrow": data_uri(narrow),
    }


def equation(latex: Iterable[str], numbers: str) -> Markup:
    """Return the equation of a model, with its numbers in the source."""
    written = Markup(", ").join(Markup(mathml(part)) for part in latex)
    number = numbers.replace("-", "\N{EN DASH}")
    mark = Markup(" <span class='eq'>({})</span>").format(number) if number else ""
    return Markup("{}{}").format(written, mark)


def parametrisation(text: str, about: Mapping[str, float]) -> str:
    """Say which parameters of a model are sampled, about which references, and why these."""
    references = dict(about)
    for name, half in about.items():
        stem, middle, unit = name.partition("_half_")
        if middle:
            middle_at = references[f"{stem}_mid_{unit}"]
            references[f"{stem}_low_{unit}"] = middle_at - half
            references[f"{stem}_high_{unit}"] = middle_at + half
    return text.format(**references).replace(" - ", f" {MINUS} ")
