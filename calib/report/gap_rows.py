"""What the pictures of a diagnosis share: field rows with their gaps, groups, names in words."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib.data.numbers import plain_number
from calib.data.quantities import OUTPUTS, role_of
from calib.gap.declared import words_of
from calib.gap.diagnose import Diagnosis, field_parts
from calib.gap.effects import EFFECTS
from calib.gap.where import Region
from calib.models.base import Array
from calib.report.labels import MINUS, NO_UNIT, Axis, axis_of

# The words for a region that covers all rows.
EVERYWHERE = "all conditions measured"

_WORDS = {
    "none": "no gap beyond the noise",
    "unknown": "a real gap that nothing listed explains",
    "parameter_shift": "the same model with other parameter values",
}
_SHORT = {"none": "none (noise)", "unknown": "unknown effect", "parameter_shift": "parameter shift"}
# What is not listed, as a part of an explanation.
_PART = {"unknown": "something unlisted"}
_MOST_PANELS = 4
# Pulls below this (kN) are those of a single small wheel, written in newtons.
_SMALL_PULL = 0.1


def short_name(name: str) -> str:
    """Return a hypothesis's name in words."""
    if name in _SHORT:
        return _SHORT[name]
    return " + ".join(_PART.get(part, part.replace("_", " ")) for part in name.split("+"))


def title_of(found: Diagnosis, name: str) -> str:
    """Say what a hypothesis claims, in plain words."""
    if name in _WORDS:
        return _WORDS[name]
    titles = {e.name: e.title for e in EFFECTS.values()}
    titles |= _PART | {"parameter_shift": _WORDS["parameter_shift"]}
    for fit in found.ranking.fits.get(name, ()):
        titles |= {e.name: e.title for e in fit.forward.hypothesis.effects}
    return ", and ".join(titles.get(part) or part.replace("_", " ") for part in name.split("+"))


def unit_after(axis: Axis) -> str:
    """Return a unit to be put after a number; nothing for counts."""
    return "" if axis.unit in ("number", NO_UNIT) else f" {axis.unit}"


def region_text(found: Diagnosis, region: Region) -> str:
    """Say over which stretch of which condition a region lies, or that it is everywhere."""
    column, ends = next(iter(region.conditions.items()))
    rows = next(o.rows for o in found.data.outputs if o.name == region.output)
    values = found.data.view.conditions[column][rows]
    if ends[0] <= values.min() and ends[1] >= values.max():
        return EVERYWHERE
    axis = axis_of(column)
    words = words_of(found.data.case.covariates, column, *ends)
    if words:
        return f"{axis.name.lower()} {words}"
    low, high = (condition_text(column, axis.factor * v) for v in ends)
    span = low if low == high else f"{low} to {high}"
    return f"{axis.name.lower()} {span}{unit_after(axis)}"


def shrink_place(found: Diagnosis) -> str:
    """Say on which rows it was judged how far the gap shrinks."""
    if found.data.case.new_conditions is not None:
        return "at the new conditions, of which there are no readings"
    parts = len(field_parts(found.data, found.seed))
    if parts:
        return (
            "at the field's own conditions, each row predicted without it (the rows are left out "
            f"in {parts} parts)"
        )
    return "at the field's own rows, which were fitted: they are too few to leave some out"


def condition_text(column: str, value: float) -> str:
    """Write a condition, in the unit of its axis, to the digits that a plan or a stretch needs."""
    if role_of(column) in ("slip", "order"):
        return f"{value:.0f}".replace("-", MINUS)
    return plain_number(value, 2 if abs(value) < 10.0 else 3).replace("-", MINUS)


def output_word(output: str) -> str:
    """Return an output's name in a sentence."""
    return output.replace("_", " ")


@dataclass(frozen=True)
class OutputRows:
    """Field rows of one output, as they are drawn, arrays of shape (n,).

    On the scale of the axis the reading, the calibrated simulator before and the corrected one
    after; the sd of a reading; truth minus simulator, its sd, and the probability that it exceeds
    the noise.
    """

    name: str
    axis: Axis
    rows: NDArray[np.int64]
    measured: Array
    before: Array
    after: Array
    noise: Array
    gap: Array
    sd: Array
    probability: Array


def output_rows(found: Diagnosis) -> list[OutputRows]:
    """Gather the field rows of every output."""
    gathered = []
    view, truth = found.data.view, found.truth
    for o, gap in zip(found.data.outputs, found.gaps, strict=True):
        axis = output_axis(found, o.name)
        theta = o.priors.to_natural(found.ranking.lab_mode[o.name][None])
        before = o.problem.bound.predict(theta, o.problem.bound.model.select(view.conditions))[0]
        gathered.append(
            OutputRows(
                o.name,
                axis,
                o.rows,
                axis.scale(found.data.case.field[OUTPUTS[o.name]][o.rows]),
                axis.scale(np.asarray(before)[o.rows]),
                axis.scale(truth.mean(truth.truth[o.name])[o.rows]),
                axis.scale(truth.mean(truth.noise[o.name])[o.rows]),
                axis.scale(gap.gap),
                axis.scale(gap.sd),
                gap.probability,
            )
        )
    return gathered


def output_axis(found: Diagnosis, output: str) -> Axis:
    """Return how an output is written: drawbar pulls of a small wheel in newtons."""
    axis = axis_of(OUTPUTS[output])
    if (
        axis.unit == "kN"
        and np.nanmax(np.abs(found.data.case.field[OUTPUTS[output]])) < _SMALL_PULL
    ):
        return Axis(axis.name, "N", 1000.0)
    return axis


def panel_groups(
    found: Diagnosis, rows: NDArray[np.int64]
) -> list[tuple[str, NDArray[np.bool_]]]:  # fmt: skip
    """Split rows by inflation pressure into a few panels: titles and masks."""
    column = found.data.view.column("pressure") or ""
    pressure = found.data.view.conditions.get(column)
    everything = np.ones(rows.size, dtype=np.bool_)
    if pressure is None or np.ptp(pressure) == 0.0:
        return [("", everything)]
    distinct, axis = np.unique(pressure), axis_of(column)
    if distinct.size <= _MOST_PANELS:
        return [(f"{axis.value_text(p)} {axis.unit}", pressure[rows] == p) for p in distinct]
    edges = np.quantile(pressure, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
    groups = []
    for low, high in pairwise(edges):
        inside = (pressure[rows] >= low) & (pressure[rows] <= high)
        if low > edges[0]:
            inside &= pressure[rows] > low
        groups.append((axis.range_text(np.array([low, high])), inside))
    return groups
