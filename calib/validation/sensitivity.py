"""How much of each parameter's posterior is the prior's: power scaling, and contraction.

Power scaling raises the joint prior, or the likelihood, to a power near one and asks how far each
marginal posterior moves (the cumulative Jensen-Shannon distance per doubling of the power). The
prior is scaled in the internal coordinates, where it is normal: a power alpha divides its
variances by alpha. Contraction compares posterior and prior variance.

References
----------
.. [1] Kallioinen, Paananen, Buerkner & Vehtari (2024), doi:10.1007/s11222-023-10366-5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from calib.batch.threads import one_thread
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import power_scaled_weights, power_sensitivity
from calib.inference.random import generator
from calib.models.base import Array

# Below, a posterior's sd is more than nine tenths of its prior's.
CONTRACTION_MIN = 0.19
# The threshold of Kallioinen et al.: above, a marginal reacts to the power.
SENSITIVITY_MIN = 0.05
_ALPHAS = (0.99, 1.01)
_N_PRIOR = 20_000
# Rows times vectors evaluated at once.
_CELLS = 1_000_000


@dataclass(frozen=True)
class Sensitivity:
    """What a parameter owes to the prior and to the data, per doubling of the power of either.

    `contraction` is ``1 - var_post/var_prior``: of the internal coordinate of a sampled parameter,
    of the normal scores under the prior (whatever the parameter's scale) of a derived one. Negative
    where the posterior is wider.
    """

    name: str
    prior: float
    likelihood: float
    contraction: float

    @property
    def prior_dominated(self) -> bool:
        """Strong prior, weak likelihood: the marginal reacts to the one, not to the other."""
        return self.prior >= SENSITIVITY_MIN > self.likelihood

    @property
    def identified(self) -> bool:
        """Whether the data say anything of their own about it: both criteria must hold."""
        return self.contraction >= CONTRACTION_MIN and not self.prior_dominated

    @property
    def reading(self) -> str:
        """What the figures say, in words."""
        if not self.identified:
            return "not identified"
        return "data and prior" if self.prior >= SENSITIVITY_MIN else "data"


@one_thread()
def prior_sensitivity(calibration: Calibration) -> dict[str, Sensitivity]:
    """Work out the sensitivity of every parameter that varies, sampled or published.

    Notes
    -----
    The distance depends on the scale of a quantity, so it is taken where a long tail does not
    rule it: on the logarithm of parameters sampled there, and of derived ones that are positive.
    """
    problem, draws = calibration.problem, calibration.draws
    chains = calibration.natural.shape[:2]
    log_prior = problem.priors.log_prob(draws.flat)
    parts = {"prior": log_prior, "likelihood": draws.log_prob.reshape(-1) - log_prior}
    low, high = _ALPHAS
    weights = {
        name: (power_scaled_weights(p, low), power_scaled_weights(p, high))
        for name, p in ((name, part.reshape(chains)) for name, part in parts.items())
    }
    contraction = _contractions(calibration)
    found = {}
    for name, natural in calibration.parameters.items():
        drawn = _scaled(calibration, name, natural)
        reaction = {k: power_sensitivity(drawn, w, _ALPHAS) for k, w in weights.items()}
        found[name] = Sensitivity(
            name, reaction["prior"], reaction["likelihood"], contraction[name]
        )
    return found


def _scaled(calibration: Calibration, name: str, drawn: Array) -> Array:
    free = {p.name: p for p in calibration.problem.priors.free}
    log = free[name].log if name in free else bool((drawn > 0.0).all())
    return np.log(drawn) if log else drawn


def _contractions(calibration: Calibration) -> dict[str, float]:
    prior = _prior_draws(calibration)
    return {
        name: 1.0 - calibration.summary[name].sd_ratio ** 2
        if name in calibration.problem.names
        else _score_contraction(prior[name], drawn.reshape(-1))
        for name, drawn in calibration.parameters.items()
    }


def _prior_draws(calibration: Calibration) -> Mapping[str, Array]:
    """Published parameters of prior draws at which the model has a value at every row."""
    problem = calibration.problem
    rng = generator(calibration.seed, calibration.label, "sensitivity")
    natural = problem.theta(problem.priors.sample(rng, _N_PRIOR))
    at_once = max(1, _CELLS // len(problem.table))
    defined = [
        np.isfinite(
            problem.bound.mean_response(
                problem.of_model(natural[i : i + at_once]), problem.conditions
            )
        )
        for i in range(0, _N_PRIOR, at_once)
    ]
    natural = natural[np.concatenate([part.all(axis=1) for part in defined])]
    with np.errstate(all="ignore"):
        return problem.bound.report(problem.of_model(natural))


def _score_contraction(prior: Array, posterior: Array) -> float:
    ordered = np.sort(prior[~np.isnan(prior)])
    below = np.searchsorted(ordered, posterior) + 0.5
    return 1.0 - float(np.var(ndtri(below / (ordered.size + 1.0))))
