"""An independence proposal that knows the posterior: a mixture of Student-t fitted to it.

Curvature at the posterior's mode gives a first Student-t; rounds of adaptive importance sampling
(Cappe et al. 2008, doi:10.1007/s11222-008-9059-x) move it to the posterior's own mean and
covariance. Draws from the result accept with high probability, so a chain of them is nearly as
good as independent draws; the same weights estimate the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.special import gammaln, logsumexp

from calib.models.base import Array
from calib.sampling.straighten import Straightener

__all__ = [
    "AnyProposal", "Assessment", "Guess", "Mixture", "Proposal", "StudentT", "adapt", "refit",
    "tempered_moments",
]  # fmt: skip

type LogProb = Callable[[Array], Array]


@dataclass(frozen=True)
class StudentT:
    """A multivariate Student-t.

    Parameters
    ----------
    mean : ndarray, shape (d,)
    cholesky : ndarray, shape (d, d)
        Lower factor of the scale matrix.
    dof : float
        Degrees of freedom.
    """

    mean: Array
    cholesky: Array
    dof: float

    def sample(self, rng: np.random.Generator | np.random.RandomState, size: int) -> Array:
        """Draw, shape (size, d)."""
        normal = rng.standard_normal((size, self.mean.size))
        chi2 = rng.chisquare(self.dof, size) / self.dof
        return self.mean + (normal / np.sqrt(chi2)[:, None]) @ self.cholesky.T

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        d = self.mean.size
        z = np.linalg.solve(self.cholesky, (t - self.mean).T)
        constant = (
            gammaln(0.5 * (self.dof + d))
            - gammaln(0.5 * self.dof)
            - 0.5 * d * np.log(self.dof * np.pi)
            - np.log(np.diag(self.cholesky)).sum()
        )
        squared = np.einsum("dk,dk->k", z, z)
        return np.asarray(constant - 0.5 * (self.dof + d) * np.log1p(squared / self.dof))


@dataclass(frozen=True)
class Mixture:
    """A mixture of Student-t components.

    Parameters
    ----------
    weights : ndarray, shape (m,)
    components : tuple of StudentT, length m
    """

    weights: Array
    components: tuple[StudentT, ...]

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return int(self.components[0].mean.size)

    @cached_property
    def _stacked(self) -> tuple[Array, Array, Array, Array]:
        """Whitening matrices (m d, d), whitened means (m, d, 1), constants and dof (m, 1)."""
        d, m = self.n_dim, len(self.components)
        inverses = np.linalg.inv(np.stack([c.cholesky for c in self.components]))
        means = np.stack([c.mean for c in self.components])
        dof = np.array([[c.dof] for c in self.components])
        constant = (
            np.log(self.weights)[:, None]
            + gammaln(0.5 * (dof + d))
            - gammaln(0.5 * dof)
            - 0.5 * d * np.log(dof * np.pi)
            + np.log(np.diagonal(inverses, axis1=1, axis2=2)).sum(axis=1)[:, None]
        )
        whitened = inverses @ means[:, :, None]
        return inverses.reshape(m * d, d), whitened, constant, dof

    def sample(self, rng: np.random.Generator | np.random.RandomState, size: int) -> Array:
        """Draw, shape (size, d)."""
        which = rng.choice(self.weights.size, size=size, p=self.weights)
        drawn = np.empty((size, self.n_dim))
        for j, component in enumerate(self.components):
            mine = np.flatnonzero(which == j)
            drawn[mine] = component.sample(rng, mine.size)
        return drawn

    def squared_distances(self, t: Array) -> Array:
        """Squared Mahalanobis distances from each component, shape (k, d) to (m, k)."""
        whiten, centre, _, _ = self._stacked
        z = (whiten @ t.T).reshape(len(self.components), self.n_dim, -1)
        z -= centre
        z *= z
        return np.asarray(z.sum(axis=1))

    def log_parts(self, squared: Array) -> Array:
        """Log of each weighted component density at squared distances, shape (m, k)."""
        _, _, constant, dof = self._stacked
        return np.asarray(constant - 0.5 * (dof + self.n_dim) * np.log(1.0 + squared / dof))

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        return _log_sum(self.log_parts(self.squared_distances(t)))


def _log_sum(parts: Array) -> Array:
    """Log of the sum of exponentials over the first axis, all finite."""
    top = parts.max(axis=0)
    return np.asarray(top + np.log(np.exp(parts - top).sum(axis=0)))


@dataclass(frozen=True)
class Proposal:
    """A mixture of Student-t in straightened coordinates, beside a broad one in the plain ones.

    Parameters
    ----------
    straightener : Straightener
    mixture : Mixture
        Of straightened coordinates.
    broad : StudentT
        Of plain coordinates; it covers what the mixture misses.
    share : float
        Of the broad component.
    """

    straightener: Straightener
    mixture: Mixture
    broad: StudentT
    share: float

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return self.mixture.n_dim

    def sample(self, rng: np.random.Generator | np.random.RandomState, size: int) -> Array:
        """Draw, shape (size, d)."""
        drawn = self.straightener.bend(self.mixture.sample(rng, size))
        broad = np.flatnonzero(rng.random(size) < self.share)
        drawn[broad] = self.broad.sample(rng, broad.size)
        return drawn

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        v, log_jacobian = self.straightener.straighten(t)
        straight = self.mixture.log_prob(v) + log_jacobian + np.log1p(-self.share)
        return np.asarray(np.logaddexp(straight, self.broad.log_prob(t) + np.log(self.share)))


type AnyProposal = Mixture | Proposal


@dataclass
class _Memory:
    """Draws of all rounds, weighted as from the mixture of all their proposals.

    So weighted, draws of early, poor proposals help where they happen to lie well and do no harm
    elsewhere (Cornuet et al. 2012, doi:10.1111/j.1467-9469.2011.00756.x).
    """

    proposals: list[AnyProposal] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    draws: list[Array] = field(default_factory=list)
    log_probs: list[Array] = field(default_factory=list)

    def add(self, proposal: AnyProposal, draws: Array, log_prob: Array) -> None:
        """Remember a round."""
        possible = np.isfinite(log_prob)
        self.proposals.append(proposal)
        self.sizes.append(draws.shape[0])
        self.draws.append(draws[possible])
        self.log_probs.append(log_prob[possible])

    def weighted(self) -> tuple[Array, Array]:
        """Return all draws (k, d), and their normalised weights (k,)."""
        draws = np.concatenate(self.draws)
        log_q = np.stack(
            [np.log(n) + q.log_prob(draws) for n, q in zip(self.sizes, self.proposals, strict=True)]
        )
        log_weight = np.concatenate(self.log_probs) - _log_sum(log_q)
        weight = np.exp(log_weight - log_weight.max())
        return draws, weight / weight.sum()


# Shares, scales and degrees of freedom of the first proposal, about the first guess: the curvature
# at a mode often promises too narrow a posterior.
_FIRST = ((0.6, 1.2, 6.0), (0.25, 2.0, 4.0), (0.15, 4.0, 3.0))
# Draws of each round per dimension plus five, and the efficiency beyond which more are no use.
_ROUNDS, _GOOD = (60, 120, 250, 400), 0.9
_MOST_COMPONENTS = 8
# Effective draws per component and dimension.
_DRAWS_PER_COMPONENT = 20.0
_EM_STEPS, _EM_DRAWS = 10, 6000
# Components are widened a little: tails that are too light cost far more than too heavy ones.
_WIDEN = 1.05
_BROAD_SCALE, _BROAD_DOF = 1.5, 4.0
_LEAST_BROAD, _MOST_BROAD = 0.05, 0.4
_DOFS = (3.0, 6.0, 12.0, 30.0)


@dataclass(frozen=True)
class Guess:
    """A first guess of where a density lies: mean (d,) and Cholesky factor (d, d)."""

    mean: Array
    cholesky: Array


@dataclass(frozen=True)
class Assessment:
    """What importance sampling from a proposal says of it and of the density.

    Parameters
    ----------
    log_evidence : float
        Log of the density's integral.
    efficiency : float
        Effective fraction of the draws, in (0, 1]; zero if the density was zero at all of them.
    """

    log_evidence: float
    efficiency: float


def _assess(log_weight: Array) -> Assessment:
    if not np.isfinite(log_weight).any():
        return Assessment(-np.inf, 0.0)
    total = float(logsumexp(log_weight))
    weight = np.exp(log_weight - total)
    n = log_weight.size
    return Assessment(total - float(np.log(n)), float(1.0 / (n * np.square(weight).sum())))


def adapt(
    log_prob: LogProb, guesses: Sequence[Guess], rng: np.random.Generator
) -> tuple[AnyProposal, Assessment]:
    """Fit a proposal to a density by adaptive importance sampling.

    Every round draws from the proposal that all rounds before it made, and ends the work if it
    resembles the density well enough.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``, unnormalised.
    guesses : sequence of Guess
        One for each mode that is known.
    rng : Generator

    Returns
    -------
    Proposal
    Assessment
        By the last round's draws.
    """
    proposal: AnyProposal = Mixture(
        np.array([share / len(guesses) for _ in guesses for share, _, _ in _FIRST]),
        tuple(
            StudentT(guess.mean, scale * guess.cholesky, dof)
            for guess in guesses
            for _, scale, dof in _FIRST
        ),
    )
    d = proposal.n_dim
    memory = _Memory()
    for size in _ROUNDS:
        draws = proposal.sample(rng, size * (d + 5))
        value = log_prob(draws)
        found = _assess(value - proposal.log_prob(draws))
        if found.efficiency > _GOOD or found.efficiency == 0.0:
            break
        memory.add(proposal, draws, value)
        draws, weight = memory.weighted()
        weight = _tempered(weight)
        proposal = _fit(proposal, draws, weight, _effective(weight), found.efficiency, rng)
    return proposal, found


def refit(
    log_prob: LogProb,
    old: AnyProposal,
    draws: Array,
    effective: float,
    rng: np.random.Generator,
) -> tuple[AnyProposal, Assessment]:
    """Fit a proposal to draws of a chain that did not converge with the old one.

    Parameters
    ----------
    log_prob : callable
    old : Proposal
    draws : ndarray, shape (k, d)
    effective : float
        What the draws are worth.
    rng : Generator
    """
    weight = np.full(draws.shape[0], 1.0 / draws.shape[0])
    proposal = _fit(old, draws, weight, effective, 1.0, rng)
    fresh = proposal.sample(rng, _ROUNDS[-2] * (draws.shape[1] + 5))
    return proposal, _assess(log_prob(fresh) - proposal.log_prob(fresh))


def _effective(weight: Array) -> float:
    return float(1.0 / np.square(weight).sum())


def _tempered(weight: Array) -> Array:
    """Flatten weights until enough draws carry them to estimate a covariance."""
    n = weight.size
    for power in (1.0, 0.7, 0.5, 0.35, 0.25, 0.15):
        w = weight**power
        w /= w.sum()
        if 1.0 / np.square(w).sum() >= min(0.1 * n, 300.0):
            return np.asarray(w)
    return np.asarray(w)


def _resampled(
    draws: Array, weight: Array, rng: np.random.Generator, most: int
) -> tuple[Array, Array]:
    """Thin weighted draws to a bounded number of equally weighted ones (systematic resampling)."""
    if weight.size <= most:
        return draws, weight
    levels = (rng.random() + np.arange(most)) / most
    picked = np.minimum(np.searchsorted(np.cumsum(weight), levels), weight.size - 1)
    return draws[picked], np.full(most, 1.0 / most)


def _moments(x: Array, weight: Array) -> tuple[Array, Array] | None:
    """Weighted mean and Cholesky factor of the covariance; None where it is degenerate."""
    mean = weight @ x
    centred = x - mean
    covariance = (centred * weight[:, None]).T @ centred
    scale = np.sqrt(np.diag(covariance))
    if not (np.isfinite(scale).all() and (scale > 0.0).all()):
        return None
    correlation = covariance / np.outer(scale, scale) + 1e-9 * np.eye(mean.size)
    try:
        return mean, scale[:, None] * np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return None


def tempered_moments(draws: Array, log_weight: Array) -> tuple[Array, Array] | None:
    """Mean and Cholesky factor of weighted draws, weights flattened where few draws carry them.

    Parameters
    ----------
    draws : ndarray, shape (k, d)
    log_weight : ndarray, shape (k,)

    Returns
    -------
    tuple of ndarray, shapes (d,) and (d, d), or None
        None where the draws are degenerate.
    """
    total = logsumexp(log_weight)
    if not np.isfinite(total):
        return None
    return _moments(draws, _tempered(np.exp(log_weight - total)))


def _fit(
    old: AnyProposal,
    draws: Array,
    weight: Array,
    effective: float,
    trust: float,
    rng: np.random.Generator,
) -> AnyProposal:
    """Fit a proposal to weighted draws; return the old one if they are degenerate.

    The less the proposal they came from was to be trusted, the larger the share of the broad
    component.
    """
    whole = _moments(draws, weight)
    draws, weight = _resampled(draws, weight, rng, _EM_DRAWS)
    try:
        straightener = Straightener.fit(draws, weight)
    except np.linalg.LinAlgError:
        return old
    v, _ = straightener.straighten(draws)
    straight = _moments(v, weight)
    if whole is None or straight is None:
        return old
    return Proposal(
        straightener,
        _fit_mixture(v, weight, *straight, effective, rng),
        StudentT(whole[0], _BROAD_SCALE * whole[1], _BROAD_DOF),
        _LEAST_BROAD + (_MOST_BROAD - _LEAST_BROAD) * (1.0 - trust) ** 2,
    )


def _fit_mixture(
    v: Array,
    weight: Array,
    mean: Array,
    cholesky: Array,
    effective: float,
    rng: np.random.Generator,
) -> Mixture:
    """Fit a mixture to weighted draws of known moments by expectation maximisation."""
    d = mean.size
    m = int(np.clip(effective / (_DRAWS_PER_COMPONENT * d), 1, _MOST_COMPONENTS))
    # In coordinates where the draws have no correlation and unit variance.
    x = np.linalg.solve(cholesky, (v - mean).T).T
    centres = x[rng.choice(weight.size, size=m, p=weight)] if m > 1 else np.zeros((1, d))
    parts = tuple(StudentT(c, (0.7 if m > 1 else 1.0) * np.eye(d), _DOFS[2]) for c in centres)
    fitted = Mixture(np.full(m, 1.0 / m), parts)
    for step in range(_EM_STEPS):
        choose_dof = step in (_EM_STEPS // 2 - 1, _EM_STEPS - 1)
        fitted = _improved(fitted, x, weight, effective, choose_dof=choose_dof)
    back = (
        StudentT(mean + cholesky @ c.mean, _WIDEN * cholesky @ c.cholesky, c.dof)
        for c in fitted.components
    )
    return Mixture(fitted.weights, tuple(back))


def _improved(
    mixture: Mixture, x: Array, weight: Array, effective: float, *, choose_dof: bool
) -> Mixture:
    """One step of expectation maximisation on weighted, whitened draws.

    Covariances are drawn towards a half of the whole by as many draws as there are dimensions.
    """
    d = mixture.n_dim
    squared = mixture.squared_distances(x)
    parts = mixture.log_parts(squared)
    share = np.exp(parts - _log_sum(parts))
    share *= weight
    dofs = np.array([c.dof for c in mixture.components])
    if choose_dof:
        dofs = _likeliest_dof(squared, share, d)
    # Draws far out in a component's tails weigh little: the Student-t's own weighting.
    tail = share * ((dofs[:, None] + d) / (dofs[:, None] + squared))
    mass = share.sum(axis=1)
    pseudo = d / effective
    components, masses = [], []
    for j in range(dofs.size):
        if mass[j] * effective < d:
            continue
        mean = tail[j] @ x / tail[j].sum()
        scaled = (x - mean) * np.sqrt(tail[j])[:, None]
        covariance = (scaled.T @ scaled + 0.5 * pseudo * np.eye(d)) / (mass[j] + pseudo)
        components.append(StudentT(mean, np.linalg.cholesky(covariance), float(dofs[j])))
        masses.append(mass[j])
    return Mixture(np.array(masses) / np.sum(masses), tuple(components))


def _likeliest_dof(squared: Array, share: Array, d: int) -> Array:
    dof = np.array(_DOFS)
    constant = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * np.log(dof)
    value = [
        (share * (c - 0.5 * (v + d) * np.log(1.0 + squared / v))).sum(axis=1)
        for v, c in zip(dof, constant, strict=True)
    ]
    return np.asarray(dof[np.argmax(value, axis=0)])
