"""Calibration with a discrepancy that is a Gaussian process: y = f(x, theta) + delta(x) + noise.

koh: Kennedy & O'Hagan (2001) in modules, as Liu, Bayarri & Berger (2009) advise: theta with its
uncertainty is the laboratory's; delta has a Gaussian kernel.
sgasp: the scaled process of Gu & Wang (2018) as the R package RobustCalibration 0.5.6 has it by
default: kernel Matern 5/2, lambda_z = (n |1/gamma| / eta)^(1/2), three starts of the likelihood.
ogp: the orthogonal process of Plumlee (2017), kernel Matern 5/2, with nothing of the derivatives of
f by theta over the field's rows. In these two theta is the field's own, its priors calib's.

Kernels are products over the recorded conditions that vary in the field; what they and the noise
have is found by maximum likelihood, laboratory and field sharing the noise. None of the three has
a test for a gap: marginal likelihoods of the field's readings (Laplace for theta, BIC for what
kernels have) are held against that of the calibrated simulator alone.

Doi 10.1111/1467-9868.00294, 10.1214/09-BA404, 10.1137/17M1159890, 10.1080/01621459.2016.1211016.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from rivals.common import SEED, Answer, Array, Conditions, Curve, Lab, Prepared

_STARTS = 3
# Bounds: ranges of scaled conditions; sizes and noise in noise sds of the laboratory.
_LN_RANGE, _LN_SIZE, _LN_NOISE = (-3.0, 4.0), (-5.0, 6.0), (-3.0, 3.0)


def correlation(kind: str, a: Array, b: Array, ranges: Array) -> Array:
    """Product kernel between inputs (n, p) and (m, p), shape (n, m)."""
    h = np.abs(a[:, None, :] - b[None, :, :]) / ranges
    if kind == "koh":
        return np.asarray(np.exp(-0.5 * np.square(h).sum(axis=2)))
    h *= np.sqrt(5.0)
    return np.asarray(np.prod((1.0 + h + h**2 / 3.0) * np.exp(-h), axis=2))


class Fit:
    """One output's field readings explained by theta, a discrepancy of a kind, if any, and noise.

    Hyperparameters are logarithms of ranges, size and noise; `z` has theta before them.
    """

    def __init__(self, p: Prepared, lab: Lab, kind: str = "") -> None:
        self.lab, self.kind, rows = lab, kind, lab.output.rows
        self.y, self.n = lab.output.field, rows.size
        self.conditions = {name: v[rows] for name, v in p.field.items()}
        self.x, self.own = p.scaled(self.conditions), kind in ("sgasp", "ogp")
        self.priors, self.g = lab.output.priors, np.zeros((self.n, 0))
        self.n_theta = lab.mode.size if self.own else 0
        ends = [(q.lower, q.upper) for q in self.priors.free] if self.own else []
        start, ln_sd = lab.mode[: self.n_theta], float(np.log(lab.sd))
        hyper, bounds = np.array([ln_sd]), [(_LN_NOISE[0] + ln_sd, _LN_NOISE[1] + ln_sd)]
        if self.own:  # first without a discrepancy
            self.kind = "none"
            start = self._ascend(np.append(start, hyper), [*ends, *bounds])[: self.n_theta]
            self.kind, self.g = kind, lab.jacobian(start, self.conditions) * lab.scales
        if kind:
            hyper = np.append(np.zeros(self.x.shape[1]), [ln_sd + 1.0, ln_sd])
            size = (_LN_SIZE[0] + ln_sd, _LN_SIZE[1] + ln_sd)
            bounds = [_LN_RANGE] * self.x.shape[1] + [size, *bounds]
        rng, found = np.random.default_rng(SEED), []
        for i in range(_STARTS if kind else 1):
            moved = hyper + (rng.uniform(-1.0, 1.0, hyper.size) if i else 0.0)
            found.append(self._ascend(np.append(start, moved), [*ends, *bounds]))
        z = min(found, key=lambda z: self._cost(z)[0])
        self.theta, self.hyper = self._split(z)

    def _split(self, z: Array) -> tuple[Array, Array]:
        return z[: self.n_theta] if self.own else self.lab.mode, z[self.n_theta :]

    def _ascend(self, z: Array, bounds: list[tuple[float, float]]) -> Array:
        z = np.clip(z, [b[0] for b in bounds], [b[1] for b in bounds])
        with np.errstate(all="ignore"):
            end = minimize(self._cost, z, jac=True, method="L-BFGS-B", bounds=bounds)
        return np.asarray(end.x)

    def kernel(self, hyper: Array, a: Array, b: Array) -> Array:
        """Covariance of the discrepancy between inputs, shape (n, m)."""
        if self.kind in ("", "none"):
            return np.zeros((len(a), len(b)))
        ranges, size, noise = np.exp(hyper[:-2]), np.exp(hyper[-2]), np.exp(hyper[-1])
        k = correlation(self.kind, a, b, ranges)
        if self.kind == "koh":
            return np.asarray(size**2 * k)
        x, n = self.x, self.n
        inner = k if a is b is x else correlation(self.kind, x, x, ranges)
        to = [inner if v is x else correlation(self.kind, v, x, ranges) for v in (a, b)]
        if self.kind == "sgasp":
            lambda_z = np.sqrt(n * np.sqrt((1.0 / ranges**2).sum()) * (size / noise) ** 2)
            middle = np.linalg.inv(inner + n / lambda_z * np.eye(n))
        else:
            middle = self.g @ np.linalg.pinv(self.g.T @ inner @ self.g, 1e-10, True) @ self.g.T
        return np.asarray(size**2 * (k - to[0] @ middle @ to[1].T))

    def covariance(self, hyper: Array) -> Array:
        """Of the readings; where theta is the laboratory's, with what it is uncertain by."""
        c = self.kernel(hyper, self.x, self.x) + np.exp(2.0 * hyper[-1]) * np.eye(self.n)
        if not self.own:
            c += self._by_theta_here
        return c + 1e-10 * np.trace(c) / self.n * np.eye(self.n)

    @cached_property
    def _by_theta_here(self) -> Array:
        return self._by_theta(self.conditions)

    def _by_theta(self, at: Conditions) -> Array:
        """Covariance of the calibrated simulator with that at the field rows."""
        mode, lab = self.lab.mode, self.lab
        return lab.jacobian(mode, at) @ lab.covariance @ lab.jacobian(mode, self.conditions).T

    def off(self, theta: Array) -> Array:
        """Readings less what the simulator says."""
        return np.asarray(self.y - self.lab.predict(theta[None], self.conditions)[0])

    def ln_likelihood(self, off: Array, hyper: Array) -> tuple[float, Array]:
        """Of the field's readings, the laboratory telling of the noise; off, weighted."""
        factor = cho_factor(self.covariance(hyper), lower=True)
        weighted, (squares, freedom) = cho_solve(factor, off), self.lab.residual
        ln = -0.5 * off @ weighted - np.log(np.diag(factor[0])).sum()
        return ln - freedom * hyper[-1] - 0.5 * squares * np.exp(-2.0 * hyper[-1]), weighted

    def _cost(self, z: Array) -> tuple[float, Array]:
        """Minus log posterior of theta and likelihood of hyperparameters, and its gradient."""
        (theta, hyper), gradient = self._split(z), np.zeros(z.size)
        off, step = self.off(theta), 1e-5
        try:
            value, weighted = self.ln_likelihood(off, hyper)
            ahead = [self.ln_likelihood(off, h)[0] for h in hyper + step * np.eye(hyper.size)]
        except (np.linalg.LinAlgError, ValueError):
            return 1e12, gradient
        gradient[self.n_theta :] = (np.array(ahead) - value) / step
        if self.own:
            move, prior = step * np.diag(self.lab.scales), self.priors.log_prob
            slope = (prior(theta + move) - prior(theta - move)) / (2.0 * np.diag(move))
            gradient[: self.n_theta] = self.lab.jacobian(theta, self.conditions).T @ weighted
            gradient[: self.n_theta] += np.where(np.isfinite(slope), slope, 0.0)
            value += prior(theta[None])[0]
        good = np.isfinite(value) and np.isfinite(gradient).all()
        return (-float(value), -gradient) if good else (1e12, 0.0 * z)

    @cached_property
    def theta_covariance(self) -> Array:
        """Of theta given the hyperparameters, linearised, shape (d, d)."""
        j = self.lab.jacobian(self.theta, self.conditions)
        inner = j.T @ np.linalg.solve(self.covariance(self.hyper), j)
        return np.linalg.pinv(inner + self.lab.precision, hermitian=True)

    @property
    def ln_evidence(self) -> float:
        """Log marginal likelihood of the readings, up to a constant that all kinds share."""
        ln, _ = self.ln_likelihood(self.off(self.theta), self.hyper)
        if self.own:
            ln += self.priors.log_prob(self.theta[None])[0]
            ln += 0.5 * np.linalg.slogdet(2.0 * np.pi * self.theta_covariance)[1]
        return float(ln - 0.5 * (self.hyper.size - 1) * np.log(self.n))

    def at(self, x: Array, conditions: Conditions) -> tuple[Array, Array]:
        """Predict f + delta and its sd, without the noise, shapes (n,)."""
        lab, cross = self.lab, self.kernel(self.hyper, x, self.x)
        own = np.array([self.kernel(self.hyper, v[None], v[None])[0, 0] for v in x])
        j_at = lab.jacobian(self.theta, conditions)
        if not self.own:
            cross = cross + self._by_theta(conditions)
            own = own + np.einsum("ij,jk,ik->i", j_at, lab.covariance, j_at)
        weights = np.linalg.solve(self.covariance(self.hyper), cross.T).T
        mean = lab.predict(self.theta[None], conditions)[0] + weights @ self.off(self.theta)
        variance = own - np.einsum("ij,ij->i", weights, cross)
        if self.own:
            left = j_at - weights @ lab.jacobian(self.theta, self.conditions)
            variance = variance + np.einsum("ij,jk,ik->i", left, self.theta_covariance, left)
        return mean, np.sqrt(np.maximum(variance, 0.0))


def diagnose(p: Prepared, kind: str) -> Answer:
    """Diagnose a case by one of the processes, each output by itself."""
    curves, ln_factors = {}, []
    for lab in p.labs:
        fit = Fit(p, lab, kind)
        ln_factors.append(fit.ln_evidence - Fit(p, lab).ln_evidence)
        field, sd = fit.at(fit.x, fit.conditions)
        calibrated = lab.predict(lab.mode[None], fit.conditions)[0]
        after = fit.at(p.scaled(p.target), p.target)
        curves[lab.name] = Curve(field - calibrated, sd, *after, float(np.exp(fit.hyper[-1])))
    # A gap in some output is as probable before the data as none in any.
    some = np.expm1(np.logaddexp(0.0, np.minimum(ln_factors, 300.0)).sum())
    none = 1.0 / (1.0 + float(some) / (2.0 ** len(ln_factors) - 1.0))
    said = {"ln_bayes_factors": ln_factors}
    return Answer({"none": none, "unknown": 1.0 - none}, curves, said)
