"""Ask for the figures of a study's outputs, which are drawn where there is time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from calib.batch.pool import Later, Pool
from calib.report.figures.plate import Plate
from calib.report.labels import units_of
from calib.report.reference import reference_of
from calib.report.study import OutputResult, Study


@dataclass(frozen=True)
class Drawn:
    """Figures of an output.

    Parameters
    ----------
    plates : tuple of Plate
        In reading order, without their canvases.
    images, prints : mapping of str to bytes
        By file name: PNG, and PDF where it was asked for.
    """

    plates: tuple[Plate, ...]
    images: Mapping[str, bytes]
    prints: Mapping[str, bytes]


def begin_figures(study: Study, pool: Pool, *, pdf: bool = False) -> dict[str, Later[Drawn]]:
    """Ask for the figures of every output that was worked out, as PDF too if they are to be."""
    return {key: pool.submit(_drawn, key, r, pdf) for key, r in study.successes.items()}


def _drawn(key: str, result: OutputResult, pdf: bool) -> Drawn:
    # Late: where the figures are drawn, which as a rule is another process.
    from calib.report.figures.collect import plates
    from calib.report.figures.plate import marked
    from calib.report.figures.style import pdf_bytes, png_bytes

    with units_of(result.task.table.header):
        label = result.task.table.label
        drawn = marked(plates(result, reference_of(label)), label)
    figures = {f"{key}_{p.name}": p.figure for p in drawn if p.figure is not None}
    return Drawn(
        tuple(replace(plate, figure=None) for plate in drawn),
        {f"{name}.png": png_bytes(figure) for name, figure in figures.items()},
        {f"{name}.pdf": pdf_bytes(figure) for name, figure in figures.items() if pdf},
    )
