"""Draw the posterior of a hypothesis and estimate its evidence, by adaptive importance sampling.

What is linear is not searched. With psi = (u, c, a), the coefficients a of a free discrepancy are
normal given the rest and integrated out. The form errors c are drawn from the normal q(c | u) that
they have where effects add up, and u is weighted with p(u, c, y) / q(c | u), an unbiased estimate
of p(u, y) (Fearnhead, Papaspiliopoulos & Roberts 2008, doi:10.1111/j.1467-9868.2008.00661.x).
Draws of u of all rounds count, weighted as from the mixture of their proposals (Cornuet et al.
2012, doi:10.1111/j.1467-9469.2011.00756.x); large weights are truncated (Ionides 2008,
doi:10.1198/106186008X320456). The mean weight is the evidence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calib.gap.fit import Fit, Residuals
from calib.gap.forward import FieldPrediction, Forward
from calib.gap.noise import Noise
from calib.inference.proposal import StudentT, log_sum, tempered_moments
from calib.models.base import Array

_LN_2_PI = float(np.log(2.0 * np.pi))
# Degrees of freedom of proposals, and the sd of form errors' over the normal's: longer tails.
DOF, _LONGER = 6.0, 1.1
_DRAWS = 1500  # of a posterior that are kept
# Of what is searched, and its weight among several.
type Proposed = tuple[StudentT, float]


def searched(forward: Forward) -> NDArray[np.int64]:
    """Return the places of the coordinates of psi that are not linear."""
    every = np.arange(forward.n_dim)
    return np.delete(every, np.concatenate([every[_integrated(forward)], _forms(forward)]))


def _integrated(forward: Forward) -> slice:
    # Where something sets in, its shapes depend on where, and of coefficients there are few.
    return slice(0, 0) if forward.hypothesis.onset_over is not None else forward.smooth


def _forms(forward: Forward) -> NDArray[np.int64]:
    slices = [s for of_output in forward.form_slices.values() for s in of_output]
    return np.concatenate([np.arange(0), *(np.arange(s.start, s.stop) for s in slices)])


def as_normal(forward: Forward) -> tuple[Array, Array]:
    """Return means and inverse sds of the priors, shape (d,), uniform ones as normal as well."""
    loc, _, lower, upper, precision = forward.priors._arrays
    normal = precision > 0.0
    with np.errstate(invalid="ignore"):
        middle, width = 0.5 * (lower + upper), np.sqrt(12.0) / (upper - lower)
    return np.where(normal, loc, middle), np.where(normal, precision, width)


class Density:
    """Likelihood times prior of a hypothesis, averaged over the noise.

    Parameters
    ----------
    noise : mapping of str to Noise
        At which a discrepancy is integrated out and form errors are drawn.
    """

    def __init__(self, forward: Forward, noise: Mapping[str, Noise]) -> None:
        self._forward = forward
        self.problem = Residuals(forward.data, forward)
        self._noise = self.problem.whitening(noise)
        self._field_noise = self._noise.take(self.problem.field)
        every = np.arange(forward.n_dim)
        self._integrated = every[_integrated(forward)]
        _, scale, *_ = forward.priors._arrays
        self._prior_sd = scale[self._integrated]
        self._forms = _forms(forward)
        self._form_precision = np.diag(scale[self._forms] ** -2.0)
        self._searched = searched(forward)

    def evaluate(self, u: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Estimate the log of likelihood times prior, the other coordinates integrated out.

        Parameters
        ----------
        u : ndarray, shape (k, u)

        Returns
        -------
        ndarray, shape (k,)
            ``-inf`` outside the prior's bounds.
        ndarray, shape (k, d)
            Whole psi, form errors drawn; coefficients of a discrepancy are zero, see `completed`.
        """
        psi = np.zeros((len(u), self._forward.n_dim))
        psi[:, self._searched] = u
        found = np.full(len(psi), -np.inf)
        inside = np.flatnonzero(np.isfinite(self._forward.priors.log_prob(psi)))
        for i in range(0, inside.size, 512):
            some = inside[i : i + 512]
            found[some], psi[some] = self._evaluate(psi[some], rng)
        return found, psi

    @np.errstate(all="ignore")
    def _evaluate(self, psi: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        forward, view = self._forward, self._forward.data.view
        lab, plain = forward.plain(psi)
        acting = forward.acting(psi, view, plain)
        full = acting.at(psi)
        ln_q: Array | float = 0.0
        if self._forms.size:
            left = self._field_noise(self.problem.beside(lab, full)[:, self.problem.field])
            psi[:, self._forms], ln_q = self._forms_given(
                self._white(left), self._form_basis(psi, acting, full), rng
            )
            full = acting.at(psi)
        return self._log_joint(psi, self.problem.beside(lab, full)) - ln_q, psi

    def _log_joint(self, psi: Array, raw: Array) -> Array:
        """Log likelihood plus log prior, what can be integrated out, by residuals (k, N)."""
        total = self._forward.log_prior(psi)
        if self._integrated.size:
            left = self._noise(raw)
            left[:, self.problem.field] = self._white(left[:, self.problem.field])
            total = total - 0.5 * np.square(left).sum(axis=1) + self._constant
        else:
            total = total + self.problem.ln_averaged(raw)
        return np.where(np.isfinite(total), total, -np.inf)

    def _form_basis(self, psi: Array, acting: FieldPrediction, full: Mapping[str, Array]) -> Array:
        """Derivatives of the white field rows by form errors, where these are zero, (k, m, n)."""
        forward = self._forward
        found = np.zeros((len(psi), self._forms.size, self.problem.field.size))
        for i, basis in enumerate(forward.form(forward.data.view)):
            if not basis.shape[1]:
                continue
            without = acting.at(psi, i)
            end = 0
            for o in forward.data.outputs:
                rows, end = slice(end, end + o.rows.size), end + o.rows.size
                part = forward.form_slices[o.name][i]
                change = np.nan_to_num((full[o.name] - without[o.name])[:, o.rows])
                at = slice(*np.searchsorted(self._forms, (part.start, part.stop)))
                if part.stop > part.start:
                    np.multiply(change[:, None], basis[o.rows].T, out=found[:, at, rows])
        return self._white(self._field_noise(found))

    def _forms_given(
        self, left: Array, basis: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Draw form errors given the rest, shape (k, m), and the log density they are drawn from.

        White residuals without them are `left`, shape (k, n).
        """
        precision = basis @ basis.swapaxes(1, 2) + self._form_precision
        moment = (basis @ np.nan_to_num(left)[..., None])[..., 0]
        root = np.linalg.cholesky(precision)
        normal = rng.standard_normal(moment.shape)
        moment += _LONGER * (root @ normal[..., None])[..., 0]
        ln_q = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        ln_q -= 0.5 * np.square(normal).sum(axis=1)
        ln_q -= self._forms.size * (np.log(_LONGER) + 0.5 * _LN_2_PI)
        return np.linalg.solve(precision, moment[..., None])[..., 0], ln_q

    def completed(self, psi: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Draw the coefficients that were integrated out, given the rest of psi, (k, d).

        Returns
        -------
        psi : ndarray, shape (k, d)
        raw : ndarray, shape (k, N)
            Residuals.
        ln_factor : ndarray, shape (k,)
            Log of the factor by which averaging over the noise changes the likelihood of each.
        """
        psi, raw = np.array(psi), self.problem.raw(psi)
        if not self._integrated.size:
            return psi, raw, np.zeros(len(psi))  # averaged already
        root = np.linalg.cholesky(self._basis @ self._basis.T + np.diag(self._prior_sd**-2.0))
        left = self._field_noise(raw[:, self.problem.field])
        white = np.linalg.solve(root, self._basis @ left.T)
        drawn = np.linalg.solve(root.T, white + rng.standard_normal(white.shape)).T
        psi[:, self._integrated] = drawn
        raw[:, self.problem.field] -= drawn @ self._shapes
        at_noise = -0.5 * np.square(self._noise(raw)).sum(axis=1) - self._noise.ln_scale
        at_noise -= 0.5 * raw.shape[1] * _LN_2_PI
        return psi, raw, self.problem.ln_averaged(raw) - at_noise

    @cached_property
    def _shapes(self) -> Array:
        """What is integrated out does at the field's rows, (m, n)."""
        return self.problem.linear_jacobian(np.zeros(self._forward.n_dim))

    @cached_property
    def _basis(self) -> Array:
        """The same with the noise made white."""
        return self._field_noise(self._shapes)

    @cached_property
    def _root(self) -> Array:
        """Of the covariance of the field's rows, their noise made white, shape (n, n)."""
        scaled = self._basis * self._prior_sd[:, None]
        return np.asarray(np.linalg.cholesky(np.eye(scaled.shape[1]) + scaled.T @ scaled))

    @cached_property
    def _whitening(self) -> Array:
        return np.asarray(np.linalg.inv(self._root).T)

    def _white(self, left: Array) -> Array:
        """Residuals of the field's rows, their noise white, made independent, shape (..., n)."""
        return np.asarray(left @ self._whitening if self._integrated.size else left)

    @cached_property
    def _constant(self) -> float:
        total = -0.5 * self._noise.sd.size * _LN_2_PI - self._noise.ln_scale
        total -= float(np.log(np.diag(self._root)).sum())
        # The prior has the density of coefficients of zero in it, which are integrated out.
        return total + float((np.log(self._prior_sd) + 0.5 * _LN_2_PI).sum())


def sample(
    forward: Forward,
    noise: Mapping[str, Noise],
    guesses: Sequence[Proposed],
    rng: np.random.Generator,
    effective: float,
    rounds: Sequence[int],
) -> tuple[Fit, list[Proposed]]:
    """Draw a posterior.

    Parameters
    ----------
    noise : mapping of str to Noise
        A first guess.
    guesses : sequence of (StudentT, float)
        Proposals of what is searched (`searched`), and the weight of each.
    effective : float
        Effective draws that are enough.
    rounds : sequence of int
        Draws of each round; as many rounds are made as it takes.

    Returns
    -------
    Fit
    list of (StudentT, float)
        Proposals that fit the posterior.
    """
    density, proposals = Density(forward, noise), list(guesses)
    whole = sum(weight for _, weight in proposals)
    pool = _Pool(density, proposals[0][0].mean.size)
    for size in rounds:
        for proposal, weight in proposals:
            pool.add(proposal, rng, max(int(size * weight / whole), 50))
        log_weight = pool.log_weight()
        total = float(logsumexp(log_weight))
        if not np.isfinite(total):  # a guess may lie outside the bounds
            proposals, whole = [(_of_prior(forward), 1.0)], 1.0
            continue
        share = np.exp(log_weight - total)
        reached = 1.0 / float(np.square(share).sum())
        moved = _moved(forward, pool, log_weight, share)
        if not moved:
            break
        proposals, whole = moved, sum(weight for _, weight in moved)
        if reached >= effective:
            break
    if not np.isfinite(total):  # nowhere has the model a value
        share, reached = np.full(log_weight.size, 1.0 / log_weight.size), 0.0
    # Systematic resampling: equal weights at the least added noise.
    at = (rng.random() + np.arange(_DRAWS)) / _DRAWS
    picked = np.minimum(np.searchsorted(np.cumsum(share), at), share.size - 1)
    # Draws of what was integrated out stay those at the noise: weighted with the factor most
    # would be lost.
    psi, raw, ln_factor = density.completed(pool.psi[picked], rng)
    known = np.isfinite(raw).all(axis=1)
    raw = raw[known] if known.any() else np.ones_like(raw)
    # The mean square over the posterior is not too small for what parameters have taken up.
    products = density.problem.products(raw, raw)
    found = density.problem.noise_of({o: p.mean(axis=0) for o, p in products.items()})
    standardised = (raw.mean(axis=0) / density.problem.sds(found))[density.problem.field]
    ends = np.cumsum([o.rows.size for o in forward.data.outputs])[:-1]
    left = dict(zip(forward.data.names, np.split(standardised, ends), strict=True))
    fit = Fit(forward, found, total + _ln_mean(ln_factor), left, psi, reached)
    return fit, proposals


def _of_prior(forward: Forward) -> StudentT:
    """Return a proposal as wide as the prior."""
    u, (loc, precision) = searched(forward), as_normal(forward)
    return StudentT(loc[u], np.diag(1.0 / precision[u]), DOF)


def _moved(forward: Forward, pool: _Pool, log_weight: Array, share: Array) -> list[Proposed]:
    """Fit proposals to what was drawn: one where sizes are usual, another where one is wide."""
    ln_usual = forward.ln_usual(pool.psi)
    usual = float(share @ np.exp(ln_usual))
    with np.errstate(divide="ignore"):
        ln_wide = np.log(-np.expm1(ln_usual))
    found = []
    for ln, weight in ((ln_usual, usual), (ln_wide, 1.0 - usual)):
        moments = tempered_moments(pool.draws, log_weight + ln)
        if moments is not None:
            found.append((StudentT(*moments, DOF), max(weight, 0.2)))
    return found


def _ln_mean(ln: Array) -> float:
    """Log of the mean of exp(ln); by its first two cumulants where few draws carry that mean."""
    weight = np.exp(ln - ln.max())
    if weight.sum() ** 2 >= 120.0 * np.square(weight).sum():
        return float(logsumexp(ln) - np.log(ln.size))
    return float(ln.mean() + 0.5 * ln.var())


class _Pool:
    """Draws of all rounds, weighted as from the mixture of all their proposals."""

    def __init__(self, density: Density, dim: int) -> None:
        self._density = density
        self._proposals: list[tuple[float, StudentT]] = []
        self.draws: Array = np.empty((0, dim))
        self._psi: list[Array] = []
        self._log_joint: Array = np.empty(0)
        # Of the mixture at each draw, each proposal times the number of its draws.
        self._log_q: Array = np.empty(0)

    def add(self, proposal: StudentT, rng: np.random.Generator, size: int) -> None:
        """Draw a round."""
        drawn = proposal.sample(rng, size)
        ln_size = float(np.log(size))
        self._proposals.append((ln_size, proposal))
        before = np.logaddexp(self._log_q, ln_size + proposal.log_prob(self.draws))
        new = log_sum(np.stack([n + q.log_prob(drawn) for n, q in self._proposals]))
        self.draws = np.concatenate([self.draws, drawn])
        self._log_q = np.concatenate([before, new])
        log_joint, psi = self._density.evaluate(drawn, rng)
        self._log_joint = np.concatenate([self._log_joint, log_joint])
        self._psi.append(psi)

    @property
    def psi(self) -> Array:
        """Whole psi of all draws."""
        return np.concatenate(self._psi)

    def log_weight(self) -> Array:
        """Log weights of all draws, at most sqrt(k) times their mean, shape (k,)."""
        log_weight = self._log_joint - self._log_q
        log_weight = np.where(np.isfinite(log_weight), log_weight, -np.inf)
        most = logsumexp(log_weight) - 0.5 * np.log(log_weight.size)
        return np.asarray(np.minimum(log_weight, most))
