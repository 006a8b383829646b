"""From what each field says to probabilities of hypotheses, for all cases of a tier together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calib.challenge.design import Tier
from calib.challenge.oracle.designs import named, plan_shares
from calib.challenge.oracle.finding import NEVER

type Array = NDArray[np.float64]

_ROUNDS, _SETTLED = 500, 1e-9
_NOTHING = 1e-12


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
    rows = zip(cases, _shares(cases, tier, which), strict=True)
    return {case: _by_hypothesis(list(plan_shares(tier)), row) for case, row in rows}


def _shares(cases: Mapping[str, Mapping[str, Any]], tier: Tier, which: str) -> Array:
    """Return the posterior probability of every state in every case, ``(N, S)``."""
    states = list(plan_shares(tier))
    weights = np.log(list(plan_shares(tier).values())) - log_kept(cases, tier)
    weights = weights + _table(cases, states, "log_design") + _table(cases, states, which)
    return np.exp(weights - logsumexp(weights, axis=1, keepdims=True))


def errors(cases: Mapping[str, Mapping[str, Any]], tier: Tier) -> dict[str, float]:
    """Return the Monte Carlo standard error of the probability of each case's truth."""
    found = {}
    states = list(plan_shares(tier))
    relative = _table(cases, states, "error", missing=0.0)
    shares = _shares(cases, tier, "log_evidence")
    for case, share, error in zip(cases, shares, relative, strict=True):
        true = np.array([named(state) == cases[case]["truth"] for state in states])
        slope = share * (true - float(share[true].sum()))
        found[case] = float(np.sqrt(np.sum((slope * error) ** 2)))
    return found


def log_kept(cases: Mapping[str, Mapping[str, Any]], tier: Tier) -> Array:
    """Return the logarithm of the share of draws that the generator keeps, of each state.

    The stages of the cases are those on which the generator kept a draw of one state or another.
    Weighted back, as in multistate reweighting [1]_, they are a sample of the stages that are
    drawn for each state, and the share it keeps is its mean over them.

    Parameters
    ----------
    cases, tier
        As for `probabilities`.

    Returns
    -------
    array
        In the order of `plan_shares`, at most zero; zero for no gap.

    References
    ----------
    .. [1] M. R. Shirts, J. D. Chodera, J. Chem. Phys. 129 (2008) 124105, doi 10.1063/1.2978177.
    """
    states = list(plan_shares(tier))
    plan = np.array(list(plan_shares(tier).values()))
    # Only ratios between states matter, so a stage's own scale is taken out.
    told = _table(cases, states, "log_design")
    drawn = np.exp(told - told.max(axis=1, keepdims=True))
    kept = np.clip(_table(cases, states, "kept", missing=0.0), 0.0, 1.0)
    found = np.ones(len(states))
    for _ in range(_ROUNDS):
        mixture = (drawn * kept) @ (plan / found)
        weight = drawn / mixture[:, None]
        total = np.maximum(weight.sum(axis=0), _NOTHING)
        new = np.maximum((weight * kept).sum(axis=0) / total, _NOTHING)
        moved, found = float(np.max(np.abs(np.log(new / found)))), new
        if moved < _SETTLED:
            break
    # A state that acts nowhere here, or is never kept, has no share that could matter.
    return np.where(found > _NOTHING, np.log(found), 0.0)


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
