"""How probable a field is under every hypothesis: look everywhere, then closer where it pays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.challenge.build import PAIR_FLOOR, SINGLE_FLOOR
from calib.challenge.effects import LISTED, acts_on
from calib.challenge.mechanism import NONE, RUT, SHIFT
from calib.challenge.oracle.bank import Bank, add_nodes, open_bank
from calib.challenge.oracle.causes import causes_of, kind_of_state, unlisted_states
from calib.challenge.oracle.climb import Peak
from calib.challenge.oracle.closing import closed_share
from calib.challenge.oracle.duos import Duo, Duos, Key
from calib.challenge.oracle.evidence import Singles, around, peaks, singles
from calib.challenge.oracle.fair import Fairness, Kept
from calib.challenge.oracle.finding import Finding, mixed
from calib.challenge.oracle.lab import View
from calib.challenge.oracle.proposal import Proposal
from calib.challenge.oracle.site import Site
from calib.challenge.stage import Stage

type Array = NDArray[np.float64]

_ROUNDS, _AT_ONCE = 4, 8
_HOPEFUL = 40.0  # nats: how far behind the best a cause may be and still be climbed
_CLOSE_BY = 12.0  # nats: how far behind to be worth an integral, or more nodes
_ENOUGH = 0.02  # what the error of a cause may do to the probabilities
_NODES, _DUO_NODES = 48, 24
_LOOKS, _CLOSINGS, _NEAR_BY = 2, (6, 24), 4.0


def able_states(stage: Stage) -> list[str]:
    """Return the states of one cause that can act on a stage."""
    design = stage.design
    found = []
    for state in (*LISTED, *unlisted_states()):
        already = state == "slip_sinkage" and design.models.get(RUT) != "bekker"
        if acts_on(kind_of_state(state), design.outputs, design.varying) and not already:
            found.append(state)
    return [*found, SHIFT]


class Search:
    """The search on one case.

    Parameters
    ----------
    stage : Stage
        The case's.
    view : View
        Its field as it is seen.
    known : View
        Its field as seen by one who knows the soil.
    log_prior : mapping of str to float
        Of each state, pairs joined by ``+``; what is not in it is not looked at.
    rng : numpy.random.Generator
        Source of randomness.
    effort : int
        Multiplies the number of nodes.
    """

    def __init__(
        self,
        stage: Stage,
        view: View,
        known: View,
        log_prior: Mapping[str, float],
        rng: np.random.Generator,
        effort: int = 1,
    ) -> None:
        self._site, self._view, self._known = Site(stage), view, known
        self._prior, self._rng, self._effort = log_prior, rng, effort
        paired = any("+" in state for state in log_prior)
        self._smallest = float(np.log(PAIR_FLOOR if paired else SINGLE_FLOOR))
        self._banks: dict[Key, Bank] = {}
        self._kept: dict[Key, Kept] = {}
        self._single: dict[Key, Singles] = {}
        self._tops: dict[Key, list[Peak]] = {}
        self._duos = Duos(self._site, view, log_prior)

    def findings(self) -> dict[str, Finding]:
        """Return what the field says of every state."""
        self._open()
        self._duos.screen(self._level(), _CLOSE_BY)
        self._climb()
        for _ in range(_ROUNDS):
            if not self._refine():
                break
        found = {NONE: Finding(0.0, 0.0, 0.0, 1.0)}
        for state in dict.fromkeys(state for state, _ in self._single):
            found[state] = self._finding(state)
        if SHIFT in found:
            found[SHIFT] = self._closing(found[SHIFT])
        return found | self._duos.findings(self._known, self._rng)

    def _open(self) -> None:
        """Open the banks of all causes, and judge them by the rules of fairness."""
        states = [state for state in able_states(self._site.stage) if state in self._prior]
        for state in states:
            for i, cause in enumerate(causes_of(state)):
                self._banks[state, i] = open_bank(
                    self._site, cause, self._smallest, self._rng, self._effort
                )
        listed = {
            name: [bank for (state, _), bank in self._banks.items() if state == name]
            for name in states
            if name in LISTED
        }
        self._fair = Fairness(self._site.stage, listed)
        for key in self._banks:
            self._update(key)

    def _update(self, key: Key) -> None:
        bank = self._banks[key]
        self._kept[key] = self._fair.accepts(key[0], bank)
        self._single[key] = singles(bank, self._view, self._kept[key])
        self._duos.take(key, bank)

    def _weight(self, key: Key) -> float:
        """Return the logarithm of a cause's prior probability."""
        return self._prior[key[0]] + float(np.log(self._banks[key].cause.share))

    def _posterior(self) -> dict[Key | Duo, tuple[float, float]]:
        """Return the logarithm of each cause's posterior weight, and its relative error."""
        weights: dict[Key | Duo, tuple[float, float]] = {}
        for key, one in self._single.items():
            weights[key] = self._weight(key) + one.log_evidence, one.error
        for duo, both in self._duos.found.items():
            weights[duo] = self._duos.weight(duo) + both.log_evidence, both.error
        return weights

    def _level(self) -> float:
        """Return the logarithm of the largest posterior weight so far, that of no gap included."""
        weights = [weight for weight, _ in self._posterior().values()]
        return max([self._prior[NONE], *weights])

    def _climb(self) -> None:
        """Climb from the best nodes of every cause that may matter; add nodes where it led."""
        level = self._level()
        for key, one in list(self._single.items()):
            bank = self._banks[key]
            if bank.dials.shape[1] and one.best > level - _HOPEFUL:
                self._tops[key] = peaks(self._site, bank, self._view, one)
                if self._tops[key][0].value + self._weight(key) > level - _CLOSE_BY:
                    self._add(key)

    def _add(self, key: Key) -> None:
        bank = self._banks[key]
        dials = slice(0, bank.dials.shape[1])
        self._grow(key, around(self._tops[key], dials, bank, self._single[key].node), _NODES)

    def _grow(self, key: Key, proposal: Proposal, count: int = _DUO_NODES) -> None:
        self._banks[key] = add_nodes(
            self._site, self._banks[key], proposal, count * self._effort, self._smallest, self._rng
        )
        self._update(key)

    def _refine(self) -> bool:
        """Add nodes where the error matters most; return whether there was any."""
        level, matters = self._level(), {}
        for where, (weight, error) in self._posterior().items():
            if where in self._tops or where in self._duos.found:
                matters[where] = float(np.exp(min(weight - level, 0.0))) * error
        worst = sorted(matters, key=lambda where: -matters[where])[:_AT_ONCE]
        worst = [where for where in worst if matters[where] > _ENOUGH]
        for where in worst:
            if where in self._duos.found:
                self._duos.refine(where, self._grow)
            else:
                self._add(where)  # type: ignore[arg-type]
        return bool(worst)

    def _finding(self, state: str) -> Finding:
        parts, known, kept = [], [], 0.0
        for key in (key for key in self._single if key[0] == state):
            bank, one = self._banks[key], self._single[key]
            sharp = singles(bank, self._known, self._kept[key])
            parts.append((bank.cause.share, one.log_evidence, one.error))
            known.append((bank.cause.share, sharp.log_evidence, 0.0))
            kept += bank.cause.share * one.kept
        log, error = mixed(parts)
        return Finding(log, mixed(known)[0], error, kept)

    def _closing(self, finding: Finding) -> Finding:
        """Allow for the rule that recalibration has to close the gap of a parameter shift."""
        stage, keys = self._site.stage, [key for key in self._single if key[0] == SHIFT]
        banks, found = [self._banks[k] for k in keys], [self._single[k] for k in keys]
        kept = finding.kept * closed_share(stage, banks, None, _LOOKS, self._rng)
        ahead = self._prior[SHIFT] + finding.log_evidence - self._level()
        if ahead < -_CLOSE_BY:
            return replace(finding, kept=kept)
        # Only where the answer hangs on it is it worth many refits.
        count = _CLOSINGS[0] if ahead < -_NEAR_BY else _CLOSINGS[1]
        share = closed_share(stage, banks, (self._view, found), count, self._rng)
        spread = float(np.sqrt((1.0 - share) / (share * (count + 1.0))))
        return Finding(
            log_evidence=finding.log_evidence + float(np.log(share)),
            known_soil=finding.known_soil + float(np.log(share)),
            error=float(np.hypot(finding.error, spread)),
            kept=kept,
        )
