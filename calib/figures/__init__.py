"""Figures of a result, each with one sentence on what it shows."""

from calib.figures.collect import plates
from calib.figures.plate import Plate

__all__ = ["Plate", "plates"]
