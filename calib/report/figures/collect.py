"""The figures of one output, in reading order; one that cannot be drawn does not stop the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

from calib.report.figures import bands, posterior, style, validation
from calib.report.figures.style import Plate
from calib.report.labels import units_of
from calib.report.reference import NOTHING, Reference, reference_of
from calib.report.study import OutputResult


def plates(result: OutputResult, reference: Reference = NOTHING) -> list[Plate]:
    """Draw the figures of an output, beside what the source of the data printed.

    They are in reading order. A figure that failed has ``figure=None`` and a caption saying why.
    """
    by_cone = bands.cone_and_water(result.calibration.problem.bound.model)
    drawings = {
        "bands": bands.density_plate if by_cone else bands.bands_plate,
        "validation": validation.validation_plate,
        "prior_predictive": bands.prior_predictive_plate,
        "learned": posterior.learned_plate,
        "corner": posterior.corner_plate,
        "ensembles": posterior.ensembles_plate,
        "residuals": validation.residuals_plate,
        "estimates": posterior.estimates_plate,
        "by_pressure": posterior.by_pressure_plate,
    }
    return style.draw_all({n: partial(draw, result, reference) for n, draw in drawings.items()})


NARROW = "_narrow"  # of the first figure, its panels below each other


@dataclass(frozen=True)
class Drawn:
    """Figures of an output: PNG, and PDF where it was asked for, by file name."""

    plates: tuple[Plate, ...]  # in reading order, without their figures
    files: Mapping[str, bytes]


def draw(key: str, result: OutputResult, *, pdf: bool = False) -> Drawn:
    """Draw the figures of an output, a key of `OUTPUTS`, in the units of its file."""
    with units_of(result.task.table.header):
        label = result.task.table.label
        drawn = style.marked(plates(result, reference_of(label)), label)
    files = {}
    for plate in drawn:
        if plate.figure is not None:
            files[f"{key}_{plate.name}.png"] = style.png(plate)
            if pdf:
                files[f"{key}_{plate.name}.pdf"] = style.pdf_bytes(plate.figure)
    points = {p.name: style.said_of_points(p.figure) for p in drawn if p.figure is not None}
    for first in drawn[:1]:
        if first.figure is not None and style.stack(first.figure):
            files[f"{key}_{first.name}{NARROW}.png"] = style.png(first)
    kept = (replace(p, figure=None, points=points.get(p.name, ())) for p in drawn)
    return Drawn(tuple(kept), files)
