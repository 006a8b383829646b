"""What the wrong hypotheses would have left of the gap: all on one noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.gap.diagnose import Diagnosis
from calib.gap.noise import noise_conditions
from calib.models.base import Array


@dataclass(frozen=True)
class Placebo:
    """What each single hypothesis leaves of the gap on the field rows.

    Parameters
    ----------
    left : mapping of str to float
        Root-mean-square residual over the noise of the best hypothesis, all outputs.
    before : float
        The same for the simulator as it was calibrated.
    """

    left: dict[str, float]
    before: float

    def shrink(self, name: str) -> float:
        """Part of the misfit that a hypothesis removes."""
        return 1.0 - self.left[name] / self.before


def placebos(found: Diagnosis) -> Placebo:
    """Work out what every single hypothesis leaves on the rows it was fitted to.

    A fit's own residuals are standardised by its own noise, which a wrong hypothesis inflates:
    they are put on the noise of the best hypothesis first.
    """
    at = noise_conditions(found.data.view)
    best = found.ranking.best(found.ranking.order[0])
    rows = {o.name: o.rows for o in found.data.outputs}
    reference = {o: n.sd(at.rows(rows[o])) for o, n in best.noise.items()}
    left = {}
    for name in found.ranking.fits:
        if "+" in name and name != found.ranking.order[0]:
            continue
        fit = found.ranking.best(name)
        left[name] = _rms(
            [
                r * fit.noise[o].sd(at.rows(rows[o])) / reference[o]
                for o, r in fit.field_residuals.items()
            ]
        )
    before = found.corrected.calibrated(found.data.view.conditions)
    response = [
        (o.field - o.problem.bound.to_response(before[o.name][o.rows])) / reference[o.name]
        for o in found.data.outputs
    ]
    return Placebo(left, _rms(response))


def _rms(parts: list[Array]) -> float:
    values = np.concatenate(parts)
    return float(np.sqrt(np.nanmean(np.square(values))))
