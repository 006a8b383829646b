"""Prior odds, relevance and posterior probabilities of hypotheses.

Every hypothesis but `none` claims that its effect has at least a minimum size: in some output its
root mean square over the field rows is `MIN_EFFECT_SIZE` noise sds or more (each of several causes:
`MIN_EFFECT_SIZE_IN_PAIR`).
Restricting its prior to relevant sizes multiplies its evidence by

    P(relevant | data, hypothesis) / P(relevant | hypothesis),

both estimated from draws. It keeps the probability of `none` from being shared out among effects
too small to see, and that of one effect among pairs whose other half is idle.

No formula is exact: even with its form errors, a hypothesis leaves some part of a real gap
unexplained. If the gap is small, that part is lost in the noise. If it is large, the form errors,
whose freedom grows with the gap, absorb what exceeds about half a noise sd. Evidence that allowed
for the noise alone would be overconfident. So posterior probabilities p become p^(1/T),
renormalised,

    T = 1 + min(0.08 g, 0.6)^2,

with g the gap's size in noise sds: the likelihood is coarsened as if the noise had what is left in
it (J. W. Miller, D. B. Dunson, J. Am. Stat. Assoc. 114 (2019) 1113-1125, doi
10.1080/01621459.2018.1469995), and with it the prior, so that the order of hypotheses stays. T is 1
where there is no gap, 1.1 for one of four noise sds, 1.36 from 7.5 on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calib.gap.campaigns import Campaigns
from calib.gap.case import Context
from calib.gap.constants import (
    LEFT,
    MIN_EFFECT_SIZE,
    MIN_EFFECT_SIZE_IN_PAIR,
    MOST_LEFT,
    PAIR_TO_SINGLE,
    PRIOR,
    RESIDUAL_DISCREPANCY,
)
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.noise import Noise
from calib.models.base import Array


def ln_relevant(size: Array) -> float:
    """Log of the part of draws, by the sizes of their causes, in which all causes count."""
    # Draws for which the model has no value say nothing either way.
    size = size[np.isfinite(size).all(axis=1)]
    threshold = MIN_EFFECT_SIZE if size.shape[1] == 1 else MIN_EFFECT_SIZE_IN_PAIR
    return float(np.log(((size >= threshold).all(axis=1).sum() + 0.2) / (len(size) + 0.4)))


def sizes(forward: Forward, noise: Mapping[str, Noise], psi: Array) -> Array:
    """Size of each cause in noise sds, rms over an output's field rows, shape (k, n_causes).

    Of several outputs, that in which it is largest: what it does to the pull is no smaller because
    ruts, which it leaves alone, were measured as well. A parameter shift or a free discrepancy
    counts as one cause; one of several has the size of what goes when it alone is taken away.
    A discrepancy of several outputs is as large as in the output where it is smallest: what changes
    one output only is not one of several.
    """
    data, view = forward.data, forward.data.view
    full, plain = forward.field_and_plain(psi, view)
    columns: list[Array] = []
    for cause in forward.causes:
        other = forward.without(psi, view, cause) if len(forward.causes) > 1 else plain
        each = _rms(data, noise, {name: full[name] - other[name] for name in full})
        smooth = forward.hypothesis.smooth_outputs
        if len(forward.causes) == 1 and len(smooth) > 1:
            columns.append(np.stack([each[name] for name in smooth]).min(axis=0))
        else:
            columns.append(np.stack(list(each.values())).max(axis=0))
    return np.stack(columns, axis=1)


def gap_size(fit: Fit) -> float:
    """Size of all that a fit adds to its simulators, in noise sds (rms, where it is largest)."""
    full, plain = fit.forward.field_and_plain(fit.psi[None], fit.forward.data.view)
    each = _rms(fit.forward.data, fit.noise, {name: full[name] - plain[name] for name in full})
    return float(np.nanmax([size[0] for size in each.values()]))


def _rms(
    data: Campaigns, noise: Mapping[str, Noise], change: Mapping[str, Array]
) -> dict[str, Array]:
    """Rms of changes (k, n) of each output over its field rows, in noise sds, shape (k,)."""
    each = data.in_noise(change, noise)
    return {name: np.sqrt(np.square(values).mean(axis=1)) for name, values in each.items()}


def left_of(gap: float) -> float:
    """Return what no formula has the shape of, in noise sds as the gap's size is."""
    return min(LEFT * gap, MOST_LEFT)


def likelihood_tempering(gap: float) -> float:
    """Return the exponent's inverse T for a gap's size in noise sds."""
    return 1.0 + left_of(gap) ** 2


def probabilities(
    log_evidence: Mapping[str, float], odds: Odds, coarse: float = 1.0
) -> dict[str, float]:
    """Posterior probabilities of hypotheses from their evidence, coarsened by T."""
    score = {name: (value + odds.ln_prior(name)) / coarse for name, value in log_evidence.items()}
    total = logsumexp(list(score.values()))
    return {name: float(np.exp(value - total)) for name, value in score.items()}


@dataclass(frozen=True)
class Odds:
    """Probabilities of hypotheses before the data.

    Parameters
    ----------
    n_single : int
        Effects among which the prior probability of one listed effect is shared out.
    suspicion : mapping of str to float
        Cause to the logarithm of the ratio of its odds to act to what they are without a context.
    """

    n_single: int
    suspicion: Mapping[str, float]

    @classmethod
    def of(cls, n_single: int, context: Context) -> Odds:
        """Take what is suspected into account."""
        plain = cls(n_single, {})
        usual = {
            name: float(np.exp(plain.ln_prior(name)) / (1.0 - RESIDUAL_DISCREPANCY))
            for name in context.suspected
        }
        return cls(
            n_single,
            {n: _logit(p) - _logit(usual[n]) for n, p in context.suspected.items()},
        )

    def ln_prior(self, name: str) -> float:
        """Log probability of a hypothesis, up to a constant."""
        if name in ("none", "unknown"):
            return float(np.log(PRIOR[name]))
        causes = name.split("+")
        listed = [c for c in causes if c != "unknown"]
        rest = RESIDUAL_DISCREPANCY if len(listed) < len(causes) else 1.0 - RESIDUAL_DISCREPANCY
        prior = float(np.log(rest)) + sum(self.suspicion.get(c, 0.0) for c in listed)
        if listed == ["parameter_shift"]:
            return float(np.log(PRIOR["parameter_shift"])) + prior
        single = float(np.log(PRIOR["single"] / max(self.n_single, 1)))
        return single + (len(listed) - 1) * float(np.log(PAIR_TO_SINGLE)) + prior


def _logit(p: float) -> float:
    return float(np.log(p / (1.0 - p)))
