"""A proposal fitted to a posterior: mixtures of Student-t behind a triangular map, one for a mode.

Curvature at the posterior's modes gives a first proposal; rounds of adaptive importance sampling
(Cappe et al. 2008, doi:10.1007/s11222-008-9059-x) fit it to the posterior. Draws from the result
accept with high probability, so a chain of them is nearly as good as independent draws; the same
weights estimate the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from calib.inference.constants import ROUND_SIZES
from calib.models.base import Array

type LogProb = Callable[[Array], Array]


@dataclass(frozen=True)
class StudentT:
    """A multivariate Student-t: mean (d,), lower factor of the scale matrix (d, d), and dof.

    Or m of them, evaluated at once: means (m, d), factors (m, d, d), dof (m,).
    """

    mean: Array
    cholesky: Array
    dof: float | Array

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Draw from one, shape (size, d)."""
        normal = rng.standard_normal((size, self.mean.size))
        chi2 = rng.chisquare(self.dof, size) / self.dof
        return self.mean + (normal / np.sqrt(chi2)[:, None]) @ self.cholesky.T

    def squared_distance(self, t: Array) -> Array:
        """Squared Mahalanobis distance from each mean, shape (k, d) to (k,) or (m, k)."""
        z = self._inverse @ (t - self.mean[..., None, :]).swapaxes(-1, -2)
        return np.asarray(np.einsum("...dk,...dk->...k", z, z))

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,) or (m, k)."""
        dof = np.asarray(self.dof)[..., None]
        power = 0.5 * (dof + t.shape[1])
        return np.asarray(self._log_top - power * np.log1p(self.squared_distance(t) / dof))

    def __iter__(self) -> Iterator[StudentT]:
        """Each of m by itself."""
        return map(StudentT, self.mean, self.cholesky, np.broadcast_to(self.dof, len(self.mean)))

    @cached_property
    def _inverse(self) -> Array:
        return np.asarray(np.linalg.inv(self.cholesky))

    @cached_property
    def _log_top(self) -> Array:
        d, dof = self.mean.shape[-1], self.dof
        constant = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * np.log(dof * np.pi)
        diagonal = np.diagonal(self.cholesky, axis1=-2, axis2=-1)
        return np.asarray(constant - np.log(diagonal).sum(axis=-1))[..., None]


def log_sum(parts: Array) -> Array:
    """Log of the sum of exponentials over the first axis, all finite."""
    top = parts.max(axis=0)
    return np.asarray(top + np.log(np.exp(parts - top).sum(axis=0)))


def moments(x: Array, weight: Array) -> tuple[Array, Array] | None:
    """Weighted mean and Cholesky factor of the covariance; None where it is degenerate."""
    mean = weight @ x
    centred = x - mean
    covariance = (centred * weight[:, None]).T @ centred
    scale = np.sqrt(np.diag(covariance))
    # Standard deviations that are rounding of the mean are no spread.
    if not (np.isfinite(scale).all() and (scale > 1e-12 * (1.0 + abs(mean))).all()):
        return None
    correlation = covariance / np.outer(scale, scale) + 1e-9 * np.eye(mean.size)
    try:
        return mean, scale[:, None] * np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return None


@dataclass(frozen=True)
class TriangularMap:
    """A one-to-one map of coordinates t to v, in which a bent posterior is nearer to a normal.

    Each standardised coordinate, from the last (the logarithm of the noise scale) to the first, is
    regressed on those before it, their squares and their products; what is left of it, over a scale
    that grows with the last coordinate, is its v. It is the Knothe-Rosenblatt rearrangement to
    second order (Parno & Marzouk 2018, doi:10.1137/17M1134640).

    Parameters
    ----------
    mean, sd : ndarray, shape (d,)
        Of t.
    coefficients : ndarray, shape (1 + d (d + 3)/2, d)
        Of the regressions, in the order last to first; zero from a coordinate's own feature on.
    growth : ndarray, shape (d,)
        Of the logarithm of each coordinate's scale with the last coordinate, in that order.
    """

    mean: Array
    sd: Array
    coefficients: Array
    growth: Array

    @classmethod
    def identity(cls, d: int) -> TriangularMap:
        """Leave d coordinates as they are."""
        return cls(np.zeros(d), np.ones(d), np.zeros((1 + d * (d + 3) // 2, d)), np.zeros(d))

    @classmethod
    def fit(cls, t: Array, weight: Array, effective: float) -> TriangularMap:
        """Fit to draws (k, d) of weights (k,), sum 1, worth so many independent ones."""
        mean = weight @ t
        sd = np.sqrt(weight @ np.square(t - mean))
        z = _from_last((t - mean) / sd)
        features, last = _features(z), _bounded(z[0])
        coefficients = _regress(features, z, weight, effective)
        # With the last coordinate all scales grow alike, and often much.
        left = np.log(np.abs(z - coefficients.T @ features) + 1e-300)
        centred = weight * (last - weight @ last)
        growth = np.clip(left @ centred / (centred @ last), -1.0, 1.0)
        growth[0] = 0.0
        # Where the scale is small a draw says more about the bend.
        precise = weight * np.exp(-2.0 * growth[1:].mean() * last) if len(growth) > 1 else weight
        coefficients = _regress(features, z, precise / precise.sum(), effective)
        return cls(mean, sd, coefficients, growth)

    def straighten(self, t: Array) -> tuple[Array, Array]:
        """Return v, shape (k, d), and the log of the Jacobian |dv/dt|, shape (k,)."""
        z = _from_last((t - self.mean) / self.sd)
        log_scale = np.outer(self.growth, _bounded(z[0]))
        v = (z - self.coefficients.T @ _features(z)) * np.exp(-log_scale)
        return v[::-1].T, -log_scale.sum(axis=0) - np.log(self.sd).sum()

    def bend(self, v: Array) -> Array:
        """Return t, shape (k, d)."""
        z = _from_last(v)
        z[0] += self.coefficients[0, 0]
        z[1:] *= np.exp(np.outer(self.growth[1:], _bounded(z[0])))
        features, bounded = np.ones((len(self.coefficients), len(v))), np.empty_like(z)
        for i in range(1, len(z)):
            # The features of the coordinate before this one follow those of all earlier ones.
            first, last = 1 + (i - 1) * (i + 2) // 2, 1 + i * (i + 3) // 2
            bounded[i - 1] = _bounded(z[i - 1])
            features[first] = z[i - 1]
            features[first + 1 : last] = bounded[i - 1] * bounded[:i]
            z[i] += self.coefficients[:last, i] @ features[:last]
        return np.asarray(z[::-1].T * self.sd + self.mean)


def _from_last(t: Array) -> Array:
    """Coordinates in the order last to first, each by itself in memory, (k, d) to (d, k)."""
    return np.ascontiguousarray(t.T[::-1])


def _bounded(z: Array) -> Array:
    """Saturate at four standard deviations: tails beyond the fitted bulk bend no further."""
    return np.asarray(4.0 * np.tanh(z / 4.0))


def _features(z: Array) -> Array:
    """One, and for each coordinate itself and its products with those up to it, (1 + ..., k).

    The features of the first i coordinates (d, k) come first.
    """
    d, k = z.shape
    features, bounded = np.ones((1 + d * (d + 3) // 2, k)), _bounded(z)
    one, other = np.tril_indices(d)
    features[1 + np.arange(d) * (np.arange(d) + 3) // 2] = z
    features[2 + one * (one + 3) // 2 + other] = bounded[one] * bounded[other]
    return features


def _regress(features: Array, z: Array, weight: Array, effective: float) -> Array:
    """Regress each coordinate on the features of those before it.

    Squares and products are shrunk by as much as noise alone would have made of them (the
    positive-part rule of James and Stein): a posterior that is straight stays straight.
    """
    weighted = features * weight
    gram, moment = weighted @ features.T, weighted @ z.T
    # As if three draws had said that coordinates are unrelated.
    gram[np.diag_indices_from(gram)] += np.where(np.arange(len(gram)) > 0, 3.0 / effective, 0.0)
    coefficients = np.zeros((len(gram), len(z)))
    linear = [0]
    for i in range(len(z)):
        n = 1 + i * (i + 3) // 2  # features of the coordinates before this one
        plain = np.zeros(n)
        plain[linear] = np.linalg.solve(gram[np.ix_(linear, linear)], moment[linear, i])
        full = np.linalg.solve(gram[:n, :n], moment[:n, i])
        gain = float((full - plain) @ moment[:n, i])
        left = float(weight @ np.square(z[i]) - full @ moment[:n, i])
        noise = (n - len(linear)) / effective * left
        share = max(0.0, 1.0 - noise / gain) if gain > 0.0 else 0.0
        coefficients[:n, i] = plain + share * (full - plain)
        linear.append(n)
    return coefficients


def fit_mixture(
    x: Array, weight: Array, effective: float, rng: np.random.Generator
) -> tuple[Array, StudentT]:
    """Fit Student-t components to weighted draws (k, d), weights (k,) of sum 1.

    By expectation maximisation (Peel & McLachlan 2000, doi:10.1023/A:1008981510081). What the
    draws are worth limits the number of components, five for each entry of a covariance; these
    start at draws picked at random. Covariances are drawn towards a half of the whole by as many
    draws as there are dimensions.
    """
    k, d = x.shape
    m = int(np.clip(effective / (5.0 * d**2), 1, 6))
    whole = np.cov(x.T, aweights=weight, ddof=0).reshape(d, d)
    centres = x[rng.choice(k, size=m, p=weight)] if m > 1 else weight @ x[None]
    factor = (0.7 if m > 1 else 1.0) * np.linalg.cholesky(whole)
    shares, parts = np.full(m, 1.0 / m), StudentT(centres, np.tile(factor, (m, 1, 1)), 6.0)
    for _ in range(12):
        logs = np.log(shares)[:, None] + parts.log_prob(x)
        by_part = np.exp(logs - log_sum(logs)) * weight
        mass = by_part.sum(axis=1)
        kept = mass * effective >= d
        kept[mass.argmax()] = True  # however little the draws are worth
        # Draws far out in a component's tails weigh little.
        tail = (by_part * (parts.dof + d) / (parts.dof + parts.squared_distance(x)))[kept]
        means = tail @ x / tail.sum(axis=1)[:, None]
        away = x - means[:, None]
        scatter = (tail[..., None] * away).swapaxes(1, 2) @ away + 0.5 * d / effective * whole
        covariances = scatter / (mass[kept] + d / effective)[:, None, None]
        shares = mass[kept] / mass[kept].sum()
        parts = StudentT(means, np.linalg.cholesky(covariances), 6.0)
    # A little wider: in importance weights light tails cost more than heavy ones.
    return shares, replace(parts, cholesky=1.07 * parts.cholesky)


@dataclass(frozen=True)
class Part:
    """What is proposed about one mode: components of weights (m,), in mapped coordinates."""

    weights: Array
    components: StudentT
    map: TriangularMap

    def draw(self, rng: np.random.Generator, size: int) -> Array:
        """Draw, shape (size, d)."""
        counts = rng.multinomial(size, self.weights)
        drawn = [c.sample(rng, int(n)) for c, n in zip(self.components, counts, strict=True)]
        return self.map.bend(np.concatenate(drawn))

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        v, log_jacobian = self.map.straighten(t)
        return log_sum(np.log(self.weights)[:, None] + self.components.log_prob(v)) + log_jacobian

    def fitted(
        self, draws: Array, weight: Array, effective: float, trust: float, rng: np.random.Generator
    ) -> Part:
        """Return the part fitted to draws (k, d); as it is where they are degenerate or few.

        A broad component covers what the others miss. The less the proposal that the draws came
        from was to be trusted, the larger is its share.
        """
        if effective < 2 * draws.shape[1] or moments(draws, weight) is None:
            return self
        found = TriangularMap.fit(draws, weight, effective)
        v, _ = found.straighten(draws)
        straight = moments(v, weight)
        if straight is None:
            return self
        share = 0.08 + 0.32 * (1.0 - trust) ** 2
        shares, narrow = fit_mixture(v, weight, effective, rng)
        components = StudentT(
            np.concatenate([narrow.mean, straight[0][None]]),
            np.concatenate([narrow.cholesky, 1.3 * straight[1][None]]),
            np.append(np.full(shares.size, narrow.dof), 4.0),
        )
        return Part(np.append((1.0 - share) * shares, share), components, found)


@dataclass(frozen=True)
class Proposal:
    """Parts (m), one for each mode, and their weights (m,)."""

    weights: Array
    parts: tuple[Part, ...]

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return int(self.parts[0].map.mean.size)

    def draw(self, rng: np.random.Generator, size: int) -> Array:
        """Draw, shape (size, d)."""
        counts = rng.multinomial(size, self.weights)
        drawn = [part.draw(rng, int(n)) for part, n in zip(self.parts, counts, strict=True)]
        return np.asarray(np.concatenate(drawn)[rng.permutation(size)])

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        return log_sum(self._log_parts(t))

    def _log_parts(self, t: Array) -> Array:
        return np.log(self.weights)[:, None] + np.stack([part.log_prob(t) for part in self.parts])

    def extended(self, t: Array) -> Proposal:
        """Return the proposal with one more part, fitted to draws (k, d) that the others miss."""
        found = moments(t, np.full(len(t), 1.0 / len(t)))
        if found is None:
            return self
        one = StudentT(found[0][None], found[1][None], np.full(1, 4.0))
        part = Part(np.ones(1), one, TriangularMap.identity(self.n_dim))
        share = 1.0 / (len(self.parts) + 1)
        return Proposal(np.append((1.0 - share) * self.weights, share), (*self.parts, part))

    def fitted(
        self, draws: Array, weight: Array, effective: float, trust: float, rng: np.random.Generator
    ) -> Proposal:
        """Return the proposal fitted to weighted draws (k, d), worth so many independent ones.

        One step of expectation maximisation over the parts: each is fitted to the draws in
        proportion to the probability that it proposed them. A mode that seems to have no mass is
        proposed once in a hundred all the same.
        """
        enough = 4000  # draws; a fit to more is no better
        if weight.size > enough:
            draws = draws[systematic(weight, enough, rng)]
            weight = np.full(enough, 1.0 / enough)
        logs = self._log_parts(draws)
        by_part = np.exp(logs - log_sum(logs)) * weight
        mass = np.maximum(by_part.sum(axis=1), 1e-300)
        parts = [
            part.fitted(draws, own / total, effective * total, trust, rng)
            for part, own, total in zip(self.parts, by_part, mass, strict=True)
        ]
        weights = np.maximum(mass, 0.01)
        return Proposal(weights / weights.sum(), tuple(parts))


def systematic(weight: Array, size: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw so many indices in proportion to weights of sum 1, by systematic resampling."""
    levels = (rng.random() + np.arange(size)) / size
    return np.minimum(np.searchsorted(np.cumsum(weight), levels), weight.size - 1)


class Guess(NamedTuple):
    """A first guess of where a density lies: mean (d,) and Cholesky factor (d, d)."""

    mean: Array
    cholesky: Array


class Assessment(NamedTuple):
    """The evidence of a density and the efficiency of a proposal, by importance sampling.

    The log of the density's integral, and the effective fraction of the draws, in (0, 1]; zero if
    the density was zero at all of them.
    """

    log_evidence: float
    efficiency: float


def adapt(
    log_prob: LogProb, guesses: Sequence[Guess], rng: np.random.Generator
) -> tuple[Proposal, Assessment]:
    """Fit a proposal to an unnormalised density ``(k, d) -> (k,)`` by adaptive importance sampling.

    Every round draws from the proposal that all rounds before it made, and ends the work if it
    resembles the density well enough; the assessment is by the last round's draws. Draws of all
    rounds are weighted as from the mixture of their proposals, so that early, poor proposals do no
    harm (Cornuet et al. 2012, doi:10.1111/j.1467-9469.2011.00756.x). There is a guess for each
    known mode, which often promises too narrow a posterior: the first proposal is wider.
    """
    d = guesses[0].mean.size
    share, scale, dof = np.array([[0.6, 0.25, 0.15], [1.2, 2.0, 4.0], [6.0, 4.0, 3.0]])
    proposal = Proposal(
        np.full(len(guesses), 1.0 / len(guesses)),
        tuple(
            Part(
                share,
                StudentT(np.tile(g.mean, (3, 1)), scale[:, None, None] * g.cholesky, dof),
                TriangularMap.identity(d),
            )
            for g in guesses
        ),
    )
    rounds: list[tuple[Proposal, int]] = []
    all_draws, all_values, log_mixed = np.empty((0, d)), np.empty(0), np.empty(0)
    for size in ROUND_SIZES:
        draws = proposal.draw(rng, size * (d + 5) * len(guesses))
        log_q, value = proposal.log_prob(draws), log_prob(draws)
        found = _assess(value - log_q)
        # Above 0.9 a better proposal is not worth a round.
        if found.efficiency > 0.9 or found.efficiency == 0.0:
            break
        rounds.append((proposal, len(draws)))
        draws, value = draws[np.isfinite(value)], value[np.isfinite(value)]
        earlier = np.log(len(log_q)) + proposal.log_prob(all_draws)
        own = log_sum(np.stack([np.log(n) + q.log_prob(draws) for q, n in rounds]))
        log_mixed = np.concatenate([np.logaddexp(log_mixed, earlier), own])
        all_draws = np.concatenate([all_draws, draws])
        all_values = np.concatenate([all_values, value])
        weight = _tempered(all_values - log_mixed)
        effective = float(1.0 / np.square(weight).sum())
        proposal = proposal.fitted(all_draws, weight, effective, found.efficiency, rng)
    return proposal, found


def refit(
    log_prob: LogProb, old: Proposal, draws: Array, effective: float, rng: np.random.Generator
) -> tuple[Proposal, Assessment]:
    """Fit a proposal to draws (k, d), worth so many, of a chain that the old one left short."""
    weight = np.full(len(draws), 1.0 / len(draws))
    proposal = old.fitted(draws, weight, effective, 1.0, rng)
    drawn = proposal.draw(rng, ROUND_SIZES[-2] * (draws.shape[1] + 5))
    return proposal, _assess(log_prob(drawn) - proposal.log_prob(drawn))


def tempered_moments(draws: Array, log_weight: Array) -> tuple[Array, Array] | None:
    """Mean (d,) and Cholesky factor (d, d) of weighted draws (k, d); None if they are degenerate.

    Log weights (k,) are flattened where few draws carry them.
    """
    return moments(draws, _tempered(log_weight)) if np.isfinite(log_weight.max()) else None


def _assess(log_weight: Array) -> Assessment:
    if not np.isfinite(log_weight).any():
        return Assessment(-np.inf, 0.0)
    total, n = float(logsumexp(log_weight)), log_weight.size
    squares = float(np.square(np.exp(log_weight - total)).sum())
    return Assessment(total - float(np.log(n)), 1.0 / (n * squares))


def _tempered(log_weight: Array) -> Array:
    """Return weights of sum 1, flattened until enough draws carry them to estimate a covariance."""
    n = log_weight.size
    for power in (1.0, 0.7, 0.5, 0.35, 0.25, 0.15):
        weight = np.exp(power * (log_weight - log_weight.max()))
        weight /= weight.sum()
        if 1.0 / np.square(weight).sum() >= min(0.1 * n, 300.0):
            break
    return np.asarray(weight)
