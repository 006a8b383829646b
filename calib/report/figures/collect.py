"""The figures of one output, in reading order; one that cannot be drawn does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from calib.report.figures import style
from calib.report.figures.bands import (
    bands_plate,
    cone_and_water,
    density_plate,
    prior_predictive_plate,
)
from calib.report.figures.plate import Plate, draw_all, marked
from calib.report.figures.posterior import (
    by_pressure_plate,
    corner_plate,
    ensembles_plate,
    estimates_plate,
    learned_plate,
)
from calib.report.figures.validation import residuals_plate, validation_plate
from calib.report.labels import units_of
from calib.report.reference import NOTHING, Reference, reference_of
from calib.report.study import OutputResult


def plates(result: OutputResult, reference: Reference = NOTHING) -> list[Plate]:
    """Draw the figures of an output.

    Parameters
    ----------
    reference : Reference, optional
        What the source of the data printed, to be shown beside them.

    Returns
    -------
    list of Plate
        In reading order. A figure that failed has ``figure=None`` and a caption saying why.
    """
    by_cone = cone_and_water(result.calibration.problem.bound.model)
    drawings: dict[str, Callable[[], Plate | None]] = {
        "bands": (lambda: density_plate(result))
        if by_cone
        else (lambda: bands_plate(result, reference=reference)),
        "validation": lambda: validation_plate(result, reference=reference),
        "prior_predictive": lambda: prior_predictive_plate(result),
        "learned": lambda: learned_plate(result, reference=reference),
        "corner": lambda: corner_plate(result, reference=reference),
        "ensembles": lambda: ensembles_plate(result),
        "residuals": lambda: residuals_plate(result),
        "estimates": lambda: estimates_plate(result, reference=reference),
        "by_pressure": lambda: by_pressure_plate(result, reference=reference),
    }
    return draw_all(drawings)


@dataclass(frozen=True)
class Drawn:
    """Figures of an output.

    Parameters
    ----------
    plates : tuple of Plate
        In reading order, without their figures.
    files : mapping of str to bytes
        PNG, and PDF where it was asked for, by file name.
    """

    plates: tuple[Plate, ...]
    files: Mapping[str, bytes]


def draw(key: str, result: OutputResult, *, pdf: bool = False) -> Drawn:
    """Draw the figures of an output, a key of `OUTPUTS`, in the units of its file."""
    with units_of(result.task.table.header):
        label = result.task.table.label
        drawn = marked(plates(result, reference_of(label)), label)
    files = {}
    for plate in drawn:
        if plate.figure is not None:
            files[f"{key}_{plate.name}.png"] = style.png(plate)
            if pdf:
                files[f"{key}_{plate.name}.pdf"] = style.pdf_bytes(plate.figure)
    return Drawn(tuple(replace(plate, figure=None) for plate in drawn), files)
