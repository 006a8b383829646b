"""All pairs of causes of one field: those that may matter are found, integrated and refined."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np

from calib.challenge.effects import wheel_effects
from calib.challenge.oracle import pairs
from calib.challenge.oracle.bank import Bank
from calib.challenge.oracle.evidence import around
from calib.challenge.oracle.finding import Finding, mixed
from calib.challenge.oracle.lab import View
from calib.challenge.oracle.pairs import Half, PairEvidence, Point
from calib.challenge.oracle.proposal import Proposal
from calib.challenge.oracle.site import Site

type Key = tuple[str, int]
type Duo = tuple[Key, Key]
type Grow = Callable[[Key, Proposal], None]

_SCREENS = (150.0, 60.0, 30.0)  # nats: how far behind the best fit is looked at again
_OCCAM = 5.0  # nats: what averaging over strengths and dials takes from a best fit, at least
_KEPT = 24
_LOOKS = 8


class Duos:
    """The pairs of a field's causes.

    Parameters
    ----------
    site : Site
        The field.
    view : View
        How it is seen.
    log_prior : mapping of str to float
        Of each pair, named ``a+b``; others are not looked at.

    Attributes
    ----------
    found : dict
        Evidence of every two causes that may matter.
    """

    def __init__(self, site: Site, view: View, log_prior: Mapping[str, float]) -> None:
        self._site, self._view = site, view
        self._prior = {name: value for name, value in log_prior.items() if "+" in name}
        self._halves: dict[Key, Half] = {}
        self._about: dict[Duo, Point] = {}
        self.found: dict[Duo, PairEvidence] = {}

    def take(self, key: Key, bank: Bank) -> None:
        """Take the bank of a cause in, or in the place of the one before."""
        if self._prior and key[0] in wheel_effects():
            self._halves[key] = pairs.half(bank, self._view)

    def weight(self, duo: Duo) -> float:
        """Return the logarithm of the prior probability of two causes."""
        shares = [np.log(self._halves[key].bank.cause.share) for key in duo]
        return self._prior["+".join(state for state, _ in duo)] + float(sum(shares))

    def screen(self, level: float, within: float) -> None:
        """Find the best fit of every two causes, and integrate those that may matter.

        Parameters
        ----------
        level : float
            Logarithm of the largest posterior weight so far.
        within : float
            How far behind it, in nats, still matters.
        """
        fits = self._fits()
        for behind in _SCREENS:
            if not fits:
                return
            best = max(fit.value.max() for fit in fits.values())
            fits = {duo: fit for duo, fit in fits.items() if fit.value.max() > best - behind}
            fits = self._looked_at(fits)
        worth = {duo: float(fit.value.max()) + self.weight(duo) for duo, fit in fits.items()}
        level = max(level, max(worth.values()) - _OCCAM)
        for duo in sorted(worth, key=lambda duo: -worth[duo])[:_KEPT]:
            if worth[duo] > level - within:
                self._integrate(duo)

    def _fits(self) -> dict[Duo, pairs.Fit]:
        nothing = np.zeros(self._site.size)
        fits = {}
        for a, b in combinations(sorted(self._halves), 2):
            if f"{a[0]}+{b[0]}" in self._prior:
                fit = pairs.fit(self._halves[a], self._halves[b], nothing, self._view)
                if np.isfinite(fit.value.max()):
                    fits[a, b] = fit
        return fits

    def _looked_at(self, fits: Mapping[Duo, pairs.Fit]) -> dict[Duo, pairs.Fit]:
        """Simulate the best of each exactly, and fit again with what is beyond the sum."""
        wanted = []
        for (a, b), fit in fits.items():
            i, j = fit.best
            sizes = float(fit.first[i, j]), float(fit.second[i, j])
            wanted.append((self._halves[a], self._halves[b], (i, j), sizes))
        points = pairs.remainders(self._site, wanted)
        self._about |= zip(fits, points, strict=True)
        again = {}
        for (a, b), point in zip(fits, points, strict=True):
            seen = self._view.seen(point.remainder)
            again[a, b] = pairs.fit(self._halves[a], self._halves[b], seen, self._view)
        return again

    def _integrate(self, duo: Duo) -> None:
        a, b = (self._halves[key] for key in duo)
        self.found[duo] = pairs.evidence(self._site, a, b, self._about[duo], self._view)

    def refine(self, duo: Duo, grow: Grow) -> None:
        """Climb to the best fits of two causes, add nodes there to both, and integrate again.

        Parameters
        ----------
        duo : tuple
            The causes.
        grow : callable
            Adds nodes to the bank of a cause.
        """
        a, b = (self._halves[key] for key in duo)
        sizes = self.found[duo].first.size, self.found[duo].second.size
        if sizes != (len(a.bank.dials), len(b.bank.dials)):
            self._integrate(duo)  # another pair has added nodes since
        evidence = self.found[duo]
        if not evidence.tops:
            return
        tops = pairs.pair_peaks(self._site, a, b, self._view, evidence.tops[:2])
        first, second = a.bank.dials.shape[1], b.bank.dials.shape[1]
        slices = slice(0, first), slice(first + 1, first + 1 + second)
        for key, dials, node in zip(duo, slices, (evidence.first, evidence.second), strict=True):
            bank = self._halves[key].bank
            if bank.dials.shape[1]:
                grow(key, around(tops, dials, bank, node))
        self._integrate(duo)

    def findings(self, known: View, rng: np.random.Generator) -> dict[str, Finding]:
        """Return what the field says of every pair.

        Parameters
        ----------
        known : View
            The field as seen by one who knows the soil.
        rng : numpy.random.Generator
            Source of randomness.
        """
        sharp = {key: pairs.half(self._halves[key].bank, known) for key in set(sum(self.found, ()))}
        found = {}
        for name in self._prior:
            one, two = name.split("+")
            sides = [[key for key in self._halves if key[0] == state] for state in (one, two)]
            if not all(sides):
                continue
            parts, parts_known = [], []
            for duo, evidence in self.found.items():
                if (duo[0][0], duo[1][0]) == (one, two):
                    share = float(np.exp(self.weight(duo) - self._prior[name]))
                    a, b = (sharp[key] for key in duo)
                    got = pairs.evidence(self._site, a, b, self._about[duo], known)
                    parts.append((share, evidence.log_evidence, evidence.error))
                    parts_known.append((share, got.log_evidence, 0.0))
            log, error = mixed(parts)
            found[name] = Finding(log, mixed(parts_known)[0], error, self._kept(sides, rng))
        return found

    def _kept(self, sides: list[list[Key]], rng: np.random.Generator) -> float:
        """Return the share of draws of a pair that the generator goes on with."""
        shares = []
        for _ in range(_LOOKS):
            picked = []
            for keys in sides:
                weight = np.array([self._halves[key].bank.cause.share for key in keys])
                picked.append(self._halves[keys[int(rng.choice(len(keys), p=weight))]])
            shares.append(pairs.kept_share(picked[0], picked[1], rng))
        return float(np.mean(shares))
