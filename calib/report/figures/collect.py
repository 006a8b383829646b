"""All figures of one output, in reading order; one that cannot be drawn does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable

from calib.report.figures.bands import (
    bands_plate,
    cone_and_water,
    density_plate,
    prior_predictive_plate,
)
from calib.report.figures.estimates import by_pressure_plate, estimates_plate
from calib.report.figures.plate import Plate, draw_all
from calib.report.figures.posterior import corner_plate, ensembles_plate, learned_plate
from calib.report.figures.validation import residuals_plate, validation_plate
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult

type _Draw = Callable[[], Plate | None]


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
    model = result.calibration.problem.bound.model
    drawings: dict[str, _Draw] = {
        "bands": (
            (lambda: density_plate(result))
            if cone_and_water(model)
            else (lambda: bands_plate(result, reference=reference))
        ),
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
