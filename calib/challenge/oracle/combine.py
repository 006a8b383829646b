"""From what each field says to probabilities of hypotheses, for all cases of a tier together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calib.challenge.design import Tier
from calib.challenge.effects import NONE
from calib.challenge.oracle.designs import named, plan_shares
from calib.challenge.oracle.finding import NEVER

type Array = NDArray[np.float64]

_ROUNDS, _SETTLED = 500, 1e-9


def probabilities(
    cases: Mapping[str, Mapping[str, Any]], tier: Tier, which: str = "log_evidence"
) -> dict[str, dict[str, float]]:
    """Return the probability of every hypothesis in every case of a tier.

    Bayes' theorem with the shares of the plan as prior, what a design tells of what it was made
    to show, and the share of all draws that the generator keeps of each state (`log_kept`).

    Parameters
    ----------
    cases : mapping of str to mapping
        From `calib.challenge.oracle.case.examine`.
    tier : str
        All their tier.
    which : str
        ``log_evidence``, or ``known_soil``.
    """
    states = list(plan_shares(tier))
    log_plan = np.log(list(plan_shares(tier).values()))
    told = _table(cases, states, "log_design")
    weights = log_plan + told - log_kept(cases, tier) + _table(cases, states, which)
    weights -= logsumexp(weights, axis=1, keepdims=True)
    return {
        case: _by_hypothesis(states, np.exp(row)) for case, row in zip(cases, weights, strict=True)
    }


def errors(cases: Mapping[str, Mapping[str, Any]], tier: Tier) -> dict[str, float]:
    """Return the Monte Carlo standard error of the probability of each case's truth."""
    found = {}
    states = list(plan_shares(tier))
    relative = _table(cases, states, "error", missing=0.0)
    log_plan = np.log(list(plan_shares(tier).values()))
    weights = log_plan + _table(cases, states, "log_design") - log_kept(cases, tier)
    weights += _table(cases, states, "log_evidence")
    shares = np.exp(weights - logsumexp(weights, axis=1, keepdims=True))
    for case, share, error in zip(cases, shares, relative, strict=True):
        true = np.array([named(state) == cases[case]["truth"] for state in states])
        slope = share * (true - float(share[true].sum()))
        found[case] = float(np.sqrt(np.sum((slope * error) ** 2)))
    return found


def log_kept(cases: Mapping[str, Mapping[str, Any]], tier: Tier) -> Array:
    """Return the logarithm of the share of draws that the generator keeps, of each state.

    The stages of the cases are a sample of those on which the generator kept a draw of one state
    or another, so each state's share over all stages follows from its shares on these, weighted
    as in multistate reweighting [1]_; of no gap it is one.

    Parameters
    ----------
    cases, tier
        As for `probabilities`.

    Returns
    -------
    array
        In the order of `plan_shares`; zero for a state that acts on none of the stages.

    References
    ----------
    .. [1] M. R. Shirts, J. D. Chodera, J. Chem. Phys. 129 (2008) 124105, doi 10.1063/1.2978177.
    """
    states = list(plan_shares(tier))
    log_plan = np.log(list(plan_shares(tier).values()))
    kept = np.maximum(_table(cases, states, "kept", missing=0.0), np.exp(NEVER / 1e4))
    weight = _table(cases, states, "log_design") + np.log(kept)
    able = np.any(weight > NEVER / 2.0, axis=0)
    found = np.zeros(len(states))
    for _ in range(_ROUNDS):
        mixture = logsumexp((log_plan + weight - found)[:, able], axis=1)
        new = np.where(able, logsumexp(weight - mixture[:, None], axis=0), 0.0)
        new = np.where(able, new - new[states.index(NONE)], 0.0)
        moved, found = float(np.max(np.abs(new - found))), new
        if moved < _SETTLED:
            break
    return found


def _table(
    cases: Mapping[str, Mapping[str, Any]], states: list[str], what: str, missing: float = NEVER
) -> Array:
    """Return a number of all cases and states, ``(N, S)``."""
    rows = [
        [case["states"][s][what] if s in case["states"] else missing for s in states]
        for case in cases.values()
    ]
    return np.array(rows, dtype=np.float64)


def _by_hypothesis(states: list[str], row: Array) -> dict[str, float]:
    found: dict[str, float] = {}
    for state, value in zip(states, row, strict=True):
        found[named(state)] = found.get(named(state), 0.0) + float(value)
    return found
