"""Replace Laplace's normal by weighted draws, for the hypotheses that matter.

Where parameters multiply each other (the size of an effect, its exponent, its form) the posterior
is bent and the normal about its mode is too wide along the bend. Importance sampling from that
normal, moved to the posterior's own mean and covariance in a few rounds, gives draws of the
posterior itself, conditional on the noise. The draws of all rounds count, weighted as from the
mixture of all their proposals (Cornuet et al. 2012, doi:10.1111/j.1467-9469.2011.00756.x): a round
whose proposal happens to be too narrow for the bend then costs little, where by itself one draw
from beyond it would carry all the weight; what weight such a draw still has is truncated (Ionides
2008, doi:10.1198/106186008X320456). The sum of the weights is the evidence. Only what is not linear
is searched (`Density`): drawn in all their dimensions, hypotheses of two to four causes had an
evidence 0.3 to 2 nats too low, free discrepancies one 1 to 5 nats too low (70 hypotheses of ten
development cases, against thirty times as many draws), the more the larger they were.

The posterior of a hypothesis as importance sampling takes it: what is linear is not searched.

Draws in a hundred dimensions carry their weight on a few of them. But most of psi is linear, or
nearly, once the other coordinates u are given:

- Residuals r = r_0 - B c are linear in the coefficients c of a free discrepancy, whose prior is
  normal with covariance S: integrated out, they leave r_0 normal with covariance D + B S B'.
- What an effect adds is (1 + sum_j c_j b_j(x)) times what its formula says, e(x): with u given and
  form errors c that leave the factor positive, r is linear in c wherever effects add up. They are
  drawn from the normal which that makes of them, and u is weighted with p(u, c, y) / q(c | u): an
  unbiased estimate of p(u, y), exact where the linearity is (a random-weight importance sampler; P.
  Fearnhead, O. Papaspiliopoulos, G. O. Roberts, J. R. Stat. Soc. B 70 (2008) 755-777,
  doi:10.1111/j.1467-9868.2008.00661.x).

The likelihood is averaged over the noise. A discrepancy is integrated out at the noise of the fit
and its coefficients are drawn there; its evidence has what averaging changes in it (`completed`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calib.gap.constants import PLENTY
from calib.gap.fit import Fit
from calib.gap.forward import FieldPrediction
from calib.gap.gauss_newton import Residuals
from calib.inference.proposal import StudentT, log_sum, tempered_moments
from calib.inference.random import generator
from calib.models.base import Array


class Density:
    """Likelihood times prior of a fit's hypothesis, averaged over the noise.

    Attributes
    ----------
    drawn : ndarray of int, shape (u,)
        Coordinates of psi that are searched.
    """

    drawn: NDArray[np.int64]

    def __init__(self, fit: Fit) -> None:
        forward, data = fit.forward, fit.forward.data
        self._fit, self._forward = fit, forward
        self._problem = problem = Residuals(data, forward)
        self._sds = problem.sds(fit.noise)
        # Where something sets in its shapes depend on where, and of coefficients there are few.
        integrated = problem.linear if forward.hypothesis.onset_over is None else slice(0, 0)
        self._integrated = np.arange(problem.loc.size)[integrated]
        self._prior_sd = 1.0 / problem.precision[self._integrated]
        forms = [np.arange(s.start, s.stop) for o in forward.form_slices.values() for s in o]
        self._forms = np.concatenate([np.empty(0, dtype=np.int64), *forms])
        self.drawn = np.delete(
            np.arange(problem.loc.size), np.concatenate([self._integrated, self._forms])
        )
        self._field = np.concatenate(
            [
                np.arange(p.start + o.problem.response.size, p.stop)
                for o, p in zip(data.outputs, problem.parts.values(), strict=True)
            ]
        )

    @property
    def covariance(self) -> Array:
        """Of what is searched, as the fit has it."""
        return self._fit.covariance[np.ix_(self.drawn, self.drawn)]

    @property
    def mode(self) -> Array:
        """Of what is searched."""
        return self._fit.psi[self.drawn]

    def evaluate(self, drawn: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Estimate the log of likelihood times prior, the other coordinates integrated out.

        Parameters
        ----------
        drawn : ndarray, shape (k, u)

        Returns
        -------
        ndarray, shape (k,)
            ``-inf`` outside the prior's bounds.
        ndarray, shape (k, d)
            Whole psi, form errors drawn; coefficients of a discrepancy are zero, see `completed`.
        """
        psi = np.tile(self._fit.psi, (len(drawn), 1))
        psi[:, self.drawn], psi[:, self._integrated] = drawn, 0.0
        found = np.full(len(psi), -np.inf)
        inside = np.flatnonzero(np.isfinite(self._forward.priors.log_prob(psi)))
        for i in range(0, inside.size, 512):
            some = inside[i : i + 512]
            found[some], psi[some] = self._evaluate(self._problem.clip(psi[some]), rng)
        return found, psi

    @np.errstate(all="ignore")
    def _evaluate(self, psi: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        problem, forward = self._problem, self._forward
        if not self._forms.size:
            return self._log_joint(psi, problem.raw(psi)), psi
        lab, plain = forward.plain(psi)
        departed = FieldPrediction([(forward, psi)], forward.data.view, plain)
        full = departed.at([psi])
        left = self._white(problem.beside(lab, full)[:, self._field] / self._field_sds)
        basis = self._form_basis(psi, departed, full)
        psi[:, self._forms], ln_q = self._drawn_forms(left, basis, rng)
        return self._log_joint(psi, problem.beside(lab, departed.at([psi]))) - ln_q, psi

    def _log_joint(self, psi: Array, raw: Array) -> Array:
        """Log likelihood plus log prior, what can be integrated out, by residuals (k, N)."""
        prior = self._forward.priors.log_prob(psi)
        if not self._integrated.size:
            total = prior + self._problem.ln_averaged(raw)
            return np.where(np.isfinite(total), total, -np.inf)
        left = raw / self._sds
        left[:, self._field] = self._white(left[:, self._field])
        total = prior - 0.5 * np.square(left).sum(axis=1)
        return np.where(np.isfinite(total), total + self._constant, -np.inf)

    def _form_basis(self, psi: Array, departed: FieldPrediction, full: dict[str, Array]) -> Array:
        """Minus the derivatives of white residuals by form errors, shape (k, m, n)."""
        forward = self._forward
        found = np.zeros((len(psi), self._forms.size, self._field.size))
        for i, basis in enumerate(forward.form(forward.data.view)):
            if not basis.shape[1]:
                continue
            without = departed.at([psi], i)
            end = 0
            for o in forward.data.outputs:
                rows, end = slice(end, end + o.rows.size), end + o.rows.size
                part = forward.form_slices[o.name][i]
                if part.stop == part.start:
                    continue
                # At all draws the form errors are those of the mode here.
                factor = np.maximum(1.0 + basis[o.rows] @ self._fit.psi[part], 0.2)
                change = (full[o.name] - without[o.name])[:, o.rows]
                change /= factor * self._field_sds[rows]
                change[~np.isfinite(change)] = 0.0
                at = slice(*np.searchsorted(self._forms, (part.start, part.stop)))
                np.multiply(change[:, None], basis[o.rows].T, out=found[:, at, rows])
        return self._white(found)

    def _drawn_forms(
        self, left: Array, basis: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Draw form errors given the rest, shape (k, m), and the log density they are drawn from.

        White residuals (k, n) are `left` at the form errors of the mode.
        """
        precision = basis @ basis.swapaxes(1, 2)
        moment = (basis @ np.nan_to_num(left)[..., None])[..., 0]
        moment += precision @ self._fit.psi[self._forms]
        precision += np.diag(self._problem.precision[self._forms] ** 2)
        root = np.linalg.cholesky(precision)
        normal = rng.standard_normal(moment.shape)
        # Longer tails than the normal's, for what is not quite linear.
        moment += 1.1 * (root @ normal[..., None])[..., 0]
        ln_q = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        ln_q -= 0.5 * np.square(normal).sum(axis=1)
        ln_q -= self._forms.size * (np.log(1.1) + 0.5 * np.log(2.0 * np.pi))
        return np.linalg.solve(precision, moment[..., None])[..., 0], ln_q

    def completed(self, psi: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw the coefficients that were integrated out, given the rest of psi, (k, d).

        Returns
        -------
        ndarray, shape (k, d)
        ndarray, shape (k,)
            Log of the factor by which averaging over the noise changes the likelihood of each.
        """
        psi = np.array(psi)
        if not self._integrated.size:
            return psi, np.zeros(len(psi))  # averaged already
        raw = self._problem.raw(self._problem.clip(psi))
        root = np.linalg.cholesky(self._basis @ self._basis.T + np.diag(self._prior_sd**-2.0))
        white = np.linalg.solve(root, self._basis @ (raw / self._sds)[:, self._field].T)
        drawn = np.linalg.solve(root.T, white + rng.standard_normal(white.shape)).T
        psi[:, self._integrated] = drawn
        raw[:, self._field] -= drawn @ self._basis * self._sds[self._field]
        at_fit = -0.5 * np.square(raw / self._sds).sum(axis=1) - np.log(self._sds).sum()
        at_fit -= 0.5 * self._sds.size * np.log(2.0 * np.pi)
        return psi, self._problem.ln_averaged(raw) - at_fit

    @cached_property
    def _field_sds(self) -> Array:
        """Of the noise of the field's rows."""
        return np.asarray(self._sds[self._field])

    @cached_property
    def _basis(self) -> Array:
        """Shapes of what is integrated out, over the sds of the field's rows, (m, n)."""
        by = self._problem.linear_jacobian(self._fit.psi[None])[0] / self._sds
        return np.asarray(-by[:, self._field])

    @cached_property
    def _root(self) -> Array:
        """Of the covariance of the field's rows over their sds, shape (n, n)."""
        scaled = self._basis * self._prior_sd[:, None]
        return np.asarray(np.linalg.cholesky(np.eye(scaled.shape[1]) + scaled.T @ scaled))

    @cached_property
    def _whitening(self) -> Array:
        return np.asarray(np.linalg.inv(self._root).T)

    def _white(self, left: Array) -> Array:
        """Residuals of the field's rows over their sds made independent, shape (..., n)."""
        return np.asarray(left @ self._whitening if self._integrated.size else left)

    @cached_property
    def _constant(self) -> float:
        ln_2_pi = float(np.log(2.0 * np.pi))
        total = -0.5 * self._sds.size * ln_2_pi - float(np.log(self._sds).sum())
        if self._integrated.size:
            total -= float(np.log(np.diag(self._root)).sum())
            # The prior has the density of coefficients of zero in it, which are integrated out.
            total += float(np.log(self._prior_sd).sum()) + 0.5 * self._prior_sd.size * ln_2_pi
        return total


def refine(fit: Fit, seed: int, plenty: int = PLENTY) -> Fit:
    """Return a fit with draws of its posterior and the evidence that they give."""
    h = fit.forward.hypothesis
    rng = generator(
        seed, "gap", "refine", h.name, h.smooth_over, h.onset_over or "", *h.smooth_outputs
    )
    density = Density(fit)
    try:
        proposal = StudentT(density.mode, np.linalg.cholesky(density.covariance), 6.0)
    except np.linalg.LinAlgError:
        return fit
    pool = _Pool(density)
    for size in (*(2000,) * 7, 4000):
        pool.add(proposal, rng, size)
        log_weight = pool.log_weight()
        total = float(logsumexp(log_weight))
        if not np.isfinite(total):
            return fit
        weight = np.exp(log_weight - total)
        effective = 1.0 / np.square(weight).sum()
        if effective >= plenty:
            break
        moved = tempered_moments(pool.draws, log_weight)
        if moved is None:
            return fit
        proposal = StudentT(*moved, 6.0)
    if effective < 120.0:
        return fit
    # Systematic resampling: equal weights at the least added noise.
    at = (rng.random() + np.arange(1500)) / 1500
    picked = np.minimum(np.searchsorted(np.cumsum(weight), at), weight.size - 1)
    # Draws of what was integrated out stay those at the noise of the fit: weighted with the factor
    # three of four would be lost.
    sample, ln_factor = density.completed(pool.psi[picked], rng)
    return replace(fit, sample=sample, log_evidence=total + _ln_mean(ln_factor))


def _ln_mean(ln: Array) -> float:
    """Log of the mean of exp(ln); by its first two cumulants where few draws carry that mean.

    Of what an unlisted gap of six noise sds changed by averaging over the noise, one draw of 1500
    carried all: seeds were apart by 4 nats, which two cumulants hold to 0.2.
    """
    weight = np.exp(ln - ln.max())
    if weight.sum() ** 2 >= 120.0 * np.square(weight).sum():
        return float(logsumexp(ln) - np.log(ln.size))
    return float(ln.mean() + 0.5 * ln.var())


class _Pool:
    """Draws of all rounds, weighted as from the mixture of all their proposals."""

    def __init__(self, density: Density) -> None:
        self._density = density
        self._proposals: list[StudentT] = []
        self.draws: Array = np.empty((0, density.drawn.size))
        self._psi: list[Array] = []
        self._log_joint: Array = np.empty(0)
        # Of the mixture at each draw, each proposal times the number of its draws.
        self._log_q: Array = np.empty(0)
        self._log_sizes: list[float] = []

    def add(self, proposal: StudentT, rng: np.random.Generator, size: int) -> None:
        """Draw a round."""
        drawn = proposal.sample(rng, size)
        self._proposals.append(proposal)
        self._log_sizes.append(np.log(size))
        before = np.logaddexp(self._log_q, self._log_sizes[-1] + proposal.log_prob(self.draws))
        ways = zip(self._log_sizes, self._proposals, strict=True)
        new = log_sum(np.stack([log_size + q.log_prob(drawn) for log_size, q in ways]))
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
