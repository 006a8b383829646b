"""All figures of a diagnosis, in reading order; one that fails does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from calib.gap.diagnose import Diagnosis
from calib.report.figures.gap_design import isolability_plate, left_over_plate
from calib.report.figures.gap_shrink import how_far_plate
from calib.report.figures.gap_where import conditions_plate, where_plate
from calib.report.figures.gap_which import placebo_plate, which_plate
from calib.report.figures.plate import Plate, draw_all

__all__ = ["GAP_FIGURES", "gap_plates"]

type _Draw = Callable[[Diagnosis], Plate | None]

_DRAWINGS: dict[str, _Draw] = {
    "isolability": isolability_plate,
    "where": where_plate,
    "where_conditions": conditions_plate,
    "which": which_plate,
    "how_far": how_far_plate,
    "placebo": placebo_plate,
    "left_over": left_over_plate,
}


GAP_FIGURES = tuple(_DRAWINGS)


def gap_plates(found: Diagnosis, names: Sequence[str] = GAP_FIGURES) -> list[Plate]:
    """Draw the figures of a diagnosis.

    Parameters
    ----------
    found : Diagnosis
    names : sequence of str, optional
        Of those to draw; all by default.

    Returns
    -------
    list of Plate
        In reading order. A figure that failed has ``figure=None`` and a caption saying why.
    """
    return draw_all({name: partial(_DRAWINGS[name], found) for name in names})
