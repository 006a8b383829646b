"""Sample two parameters as sum and ratio where the data determine only their sum."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.inference.priors import Prior, Priors
from calib.inference.problem import Problem
from calib.models.base import Array


@dataclass(frozen=True)
class Joined(Priors):
    """The same priors in other coordinates: of two logarithms a and b, ln(e^a + c e^b) and b - a.

    The posterior is then nearly normal where that of a and b is a bent ridge. The Jacobian
    is one, so densities are unchanged.

    Parameters
    ----------
    first, second : int
        Places of a and b among the free parameters.
    ln_times : float
        ln c.
    """

    first: int = 0
    second: int = 1
    ln_times: float = 0.0

    def joined(self, t: Array) -> Array:
        """Return coordinates (..., d) of those by parameter."""
        u = np.array(t)
        b = t[..., self.second] + self.ln_times
        u[..., self.first] = np.logaddexp(t[..., self.first], b)
        u[..., self.second] = b - t[..., self.first]
        return u

    def by_parameter(self, u: Array) -> Array:
        """Invert `joined`."""
        t = np.array(u)
        t[..., self.first] -= np.logaddexp(0.0, u[..., self.second])
        t[..., self.second] += t[..., self.first] - self.ln_times
        return t

    def log_prob(self, t: Array) -> Array:
        """As of `Priors`."""
        return super().log_prob(self.by_parameter(t))

    def ppf(self, u: Array) -> Array:
        """As of `Priors`."""
        return self.joined(super().ppf(u))

    def to_natural(self, t: Array) -> Array:
        """As of `Priors`."""
        return super().to_natural(self.by_parameter(np.atleast_2d(t)))

    def to_internal(self, natural: Array, margin: float = 1e-9) -> Array:
        """As of `Priors`."""
        return self.joined(super().to_internal(natural, margin))


def joined(problem: Problem) -> Problem:
    """Return the problem in coordinates to sample in, if its model has some of its own.

    They need log-normal priors without bounds; with others the problem is returned as it is.
    """
    pair, priors = problem.bound.model.joined, problem.priors
    if pair is None:
        return problem
    *names, condition = pair
    both = [priors.names.index(name) for name in names if name in priors.names]
    if len(both) < 2 or not all(_unbounded_lognormal(priors.free[j]) for j in both):
        return problem
    ln_times = float(np.log(problem.conditions[condition].mean()))
    coordinates = Joined(
        priors.entries, priors.text, priors.source, priors.noise, both[0], both[1], ln_times
    )
    return replace(problem, priors=coordinates)


def _unbounded_lognormal(p: Prior) -> bool:
    return p.log and p.gamma is None and np.isfinite(p.scale) and p.lower == -p.upper == -np.inf
