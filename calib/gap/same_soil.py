"""What it would change to know that field and laboratory have the same soil."""

from __future__ import annotations

from dataclasses import replace

from scipy.special import logsumexp

from calib.gap.case import Context
from calib.gap.constants import SAME_SOIL_SHIFTS, SHIFTS, WORTH_SAYING
from calib.gap.odds import Odds, likelihood_tempering, probabilities
from calib.gap.ranking import Ranking

SHIFT = "parameter_shift"


def shift_if_same_soil(ranking: Ranking) -> float | None:
    """Compute how probable a parameter shift would be if the soil were known to be the same.

    The shifts that were fitted are weighted anew; nothing is fitted.

    Parameters
    ----------
    ranking : Ranking

    Returns
    -------
    float, or None
        In any explanation. None if the case says which soil it is, or no shift is in play.
    """
    shifted = [name for name in ranking.probability if SHIFT in name.split("+")]
    known = any(f.forward.data.case.context.same_soil is not None for f in ranking.fits["none"])
    if known or sum(ranking.probability[name] for name in shifted) < WORTH_SAYING:
        return None
    evidence = dict(ranking.log_evidence)
    for name in shifted:
        sizes = [fit.forward.hypothesis.shift for fit in ranking.fits[name]]
        weights = [len(SHIFTS) / len(SAME_SOIL_SHIFTS) * (s in SAME_SOIL_SHIFTS) for s in sizes]
        evidence[name] = float(logsumexp(ranking.scores[name], b=weights))
    given = Odds.of(ranking.odds.n_single, Context(same_soil=True)).suspicion
    odds = replace(ranking.odds, suspicion={**given, **ranking.odds.suspicion})
    found = probabilities(evidence, odds, likelihood_tempering(ranking.gap))
    return sum(found[name] for name in shifted)
