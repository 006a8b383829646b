"""A parameter of an effect in words: value, sd, unit, and whether the data told of it."""

from __future__ import annotations

import math

from calib.inference.priors import Prior
from calib.report.labels import degrees
from calib.report.numbers import format_number, format_value

# An sd above this part of the prior's says that the data did not narrow the parameter.
_NOT_NARROWED = 0.9


def unit_of(prior: Prior) -> str:
    """A parameter's unit, to be put after a number."""
    return "" if prior.unit in ("1", "", "dimensionless") else f" {degrees(prior.unit)}"


def parameter_text(prior: Prior, value: float, sd: float) -> str:
    """Write a parameter, in internal coordinates, with its sd and unit.

    One that cannot be told from its bound at zero is an upper limit (95 %); one that the data did
    not narrow is called so.
    """
    unit = unit_of(prior)
    half = prior.lower == 0.0 and prior.loc == 0.0
    spread = prior.scale * (math.sqrt(1.0 - 2.0 / math.pi) if half else 1.0)
    if not math.isfinite(prior.scale):  # uniform between its bounds
        spread = (prior.upper - prior.lower) / math.sqrt(12.0)
    narrow = math.isfinite(spread) and sd > _NOT_NARROWED * spread
    if narrow and not math.isfinite(prior.scale):
        value, sd = 0.5 * (prior.lower + prior.upper), spread
    mark = " (prior)" if narrow else ""
    if prior.log:
        centre = math.exp(value)
        if sd < 0.35:
            return f"{format_value(centre, centre * sd)}{unit}{mark}"
        low, high = (math.exp(value + z * sd) for z in (-1.645, 1.645))
        return (
            f"{format_number(centre, 2)} ({format_number(low, 2)} to {format_number(high, 2)})"
            f"{unit}{mark}"
        )
    if prior.lower == 0.0 and value < sd:
        limit = min(value + 1.645 * sd, prior.upper)
        return f"< {format_number(limit, 2)}{unit}{mark}"
    return f"{format_value(value, sd)}{unit}{mark}"
