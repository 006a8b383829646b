"""All figures of an audit, in reading order; one that fails does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from calib.he2019.audit import Audit
from calib.he2019.figures.audit_costs import costs_plate
from calib.he2019.figures.audit_pull import chord_plate, digits_plate, signs_plate
from calib.he2019.figures.audit_rut import rut_plate
from calib.report.figures.plate import Plate, draw_all

_DRAWINGS: dict[str, Callable[[Audit], Plate]] = {
    "audit_costs": costs_plate,
    "audit_digits": digits_plate,
    "audit_rut": rut_plate,
    "audit_chord": chord_plate,
    "audit_signs": signs_plate,
}


def audit_plates(audit: Audit) -> list[Plate]:
    """Draw the figures of an audit; one that failed has a caption saying why instead."""
    return draw_all({name: partial(draw, audit) for name, draw in _DRAWINGS.items()})
