"""Posteriors of hypotheses that were not fitted: about where a test says, as wide as it says."""

from __future__ import annotations

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypothesis import Hypothesis
from calib.gap.noise import Noise
from calib.gap.residuals import Residuals
from tests.gap.cases import NOISE

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}


def fit_at(data: Campaigns, hypothesis: Hypothesis, sd: float = 0.0) -> Fit:
    """Return a posterior about the middle of the priors, of this sd in every coordinate."""
    forward = Forward(data, hypothesis, SIGMA)
    psi = np.array([p.loc for p in forward.priors.free])
    noise = {o.name: Noise(SIGMA[o.name]) for o in data.outputs}
    return Fit(forward, psi, sd**2 * np.eye(psi.size), noise, 0.0, 0.0, {})


def log_joint(found: Fit, psi: np.ndarray) -> np.ndarray:
    """Log likelihood plus log prior at a fit's noise, in all dimensions, shape (k, d) to (k,)."""
    problem = Residuals(found.forward.data, found.forward)
    sds = problem.sds(found.noise)
    with np.errstate(all="ignore"):
        squares = np.square(problem.raw(problem.clip(psi)) / sds).sum(axis=1)
    constant = np.log(sds).sum() + 0.5 * sds.size * np.log(2.0 * np.pi)
    return np.asarray(found.forward.priors.log_prob(psi) - 0.5 * squares - constant)
