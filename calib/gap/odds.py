"""Probabilities of hypotheses before the data, and after them from their evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calib.gap.context import Context
from calib.gap.fit import Fit
from calib.gap.hypotheses import LN_PAIR_TO_SINGLE, LN_PRIOR, REMAINDER

__all__ = ["Odds", "probabilities", "with_prior"]


def probabilities(log_evidence: Mapping[str, float], odds: Odds) -> dict[str, float]:
    """Posterior probabilities of hypotheses from their evidence."""
    score = {name: value + odds.ln_prior(name) for name, value in log_evidence.items()}
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
