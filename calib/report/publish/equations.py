"""The equation of every model, for text and for LaTeX, with what its letters mean."""

from __future__ import annotations

from calib.models import get_model
from calib.models.latex import text


def text_equation(model: str) -> str:
    """Return a model's equation as plain text."""
    return ", ".join(text(part) for part in get_model(model).latex)


def latex_equation(model: str) -> str:
    """Return a model's equation as mathematics in a line of text."""
    return ", ".join(get_model(model).latex)


def letters(model: str) -> str:
    """Say, with marks, what the letters of an equation mean that are not parameters."""
    return get_model(model).letters


def equation_numbers(model: str) -> str:
    """Return where the source prints a model: ``Eqs 12-15``."""
    return get_model(model).numbers.replace("-", "\N{EN DASH}")
