"""Probabilities of hypotheses before the data, and after them from their evidence.

No formula is right to the last: besides the form errors that a hypothesis has, some shape of a real
gap stays that nothing explains. Of a small gap it is a part of its size, lost in the noise; of a
large one form errors, whose freedom grows with the gap, take up what is beyond half a noise sd or
so. Evidence that reckons with the noise alone would be surer than the data are. So posterior
probabilities p become p^(1/T), renormalised,

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

from calib.gap.context import Context
from calib.gap.fit import Fit
from calib.gap.hypotheses import LN_PAIR_TO_SINGLE, LN_PRIOR, REMAINDER

__all__ = ["LEFT", "MOST_LEFT", "Odds", "coarsening", "left_of", "probabilities", "with_prior"]

# Part of a gap that no formula has the shape of, and the most of that in noise sds. Where true
# single effects of other mechanics, of 5 to 24 noise sds, were fitted free of noise, 0.1 to 1.4
# noise sds were left, mostly half a one. Of 600 large gaps of `calib challenge make` (seeds
# 11127825, 266368679, 69484247, 77595611, 113300765) the mean log score is -1.170 with these,
# -1.217 with none, -1.195 with 0.05 of the gap however large it is, and 6 are wrong at 0.9 or more
# (18, 14) where 5.4 are expected (9.5, 7.0). 0.07 to 0.1 with 0.5 to 0.7 do equally well.
LEFT, MOST_LEFT = 0.08, 0.6


def left_of(gap: float) -> float:
    """Return what no formula has the shape of, in noise sds as the gap's size is."""
    return min(LEFT * gap, MOST_LEFT)


def coarsening(gap: float) -> float:
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
            name: float(np.exp(plain.ln_prior(name)) / (1.0 - REMAINDER))
            for name in context.suspected
        }
        return cls(
            n_single,
            {n: _logit(p) - _logit(usual[n]) for n, p in context.suspected.items()},
        )

    def ln_prior(self, name: str) -> float:
        """Log probability of a hypothesis, up to a constant."""
        if name in ("none", "unknown"):
            return LN_PRIOR[name]
        causes = name.split("+")
        listed = [c for c in causes if c != "unknown"]
        rest = REMAINDER if len(listed) < len(causes) else 1.0 - REMAINDER
        prior = float(np.log(rest)) + sum(self.suspicion.get(c, 0.0) for c in listed)
        if listed == ["parameter_shift"]:
            return LN_PRIOR["parameter_shift"] + prior
        single = LN_PRIOR["single"] - float(np.log(max(self.n_single, 1)))
        return single + (len(listed) - 1) * LN_PAIR_TO_SINGLE + prior


def _logit(p: float) -> float:
    return float(np.log(p / (1.0 - p)))


def with_prior(found: Fit, odds: Odds) -> float:
    """Log of evidence times the prior of a variant of a hypothesis."""
    hypothesis = found.forward.hypothesis
    prior = odds.ln_prior(hypothesis.name) + float(np.log(hypothesis.share))
    return found.log_evidence + prior
