"""What set each parameter: the data, the prior, or both."""

from __future__ import annotations

import numpy as np

from calib.inference.calibration import Calibration
from calib.validation.sensitivity import CONTRACTION_MIN

DATA, BOTH = "set by the data", "partly by the prior"
MOVED, PRIOR = "moved, not narrowed", "set by the prior"
ROLES = (DATA, BOTH, MOVED, PRIOR)

# The same limit as that of an identified parameter: nine tenths of the prior's sd.
PRIOR_SET, PARTLY_SET = (1.0 - CONTRACTION_MIN) ** 0.5, 0.5
MOVED_SDS = 0.5


def role_of(sd_ratio: float, moved: float) -> str:
    """Say what set a parameter.

    From its posterior over prior sd (NaN if derived) and the distance of the means in prior sds.
    """
    if np.isnan(sd_ratio):
        return ""
    if sd_ratio > PRIOR_SET:
        return MOVED if moved > MOVED_SDS else PRIOR
    return BOTH if sd_ratio > PARTLY_SET else DATA


def shift(calibration: Calibration, name: str) -> float:
    """Distance of posterior and prior mean in prior sds, in internal coordinates."""
    priors = calibration.problem.priors
    j = priors.names.index(name)
    drawn = priors.ppf(((np.arange(199) + 0.5) / 199.0)[:, None] * np.ones(len(priors.free)))[:, j]
    return float(abs(calibration.draws.flat[:, j].mean() - drawn.mean()) / drawn.std())


def role(calibration: Calibration, name: str) -> str:
    """Say what set a parameter of a calibration; empty for one that is derived or fixed."""
    if name not in calibration.problem.names:
        return ""
    return role_of(calibration.summary[name].sd_ratio, shift(calibration, name))
