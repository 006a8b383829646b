"""Figures of a result, each with one sentence on what it shows.

`calib.report.figures.collect` draws those of a report. It is not imported here: the figures of a
diagnosis need neither a study nor a sampler.
"""

from calib.report.figures.plate import Plate

__all__ = ["Plate"]
