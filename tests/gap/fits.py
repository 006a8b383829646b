"""Posteriors of hypotheses that were not fitted: about where a test says, as wide as it says."""

from __future__ import annotations

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypothesis import Hypothesis
from calib.gap.noise import Noise
from tests.gap.cases import NOISE

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}


def fit_at(data: Campaigns, hypothesis: Hypothesis, sd: float = 0.0) -> Fit:
    """Return a posterior about the middle of the priors, of this sd in every coordinate."""
    forward = Forward(data, hypothesis, SIGMA)
    psi = np.array([p.loc for p in forward.priors.free])
    noise = {o.name: Noise(SIGMA[o.name]) for o in data.outputs}
    return Fit(forward, psi, sd**2 * np.eye(psi.size), noise, 0.0, 0.0, {})
