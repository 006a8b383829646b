"""How far a fit that ignores the causes of a gap would have biased the simulators' parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.gap.fit import Fit
from calib.gap.mixture import Mixture, Truth
from calib.inference.random import generator


@dataclass(frozen=True)
class Bias:
    """A parameter of a simulator, with the causes of the gap in force and without any.

    Parameters
    ----------
    median, sd : float
        Under the diagnosis, all hypotheses together; the sd is half the range from the 16 % to the
        84 % quantile, for tails may be heavy.
    ignoring : float
        Most probable value in a fit of both campaigns as one, in which nothing acts.
    shift_in_sds : float
        The latter less the median, over the sd.
    """

    output: str
    parameter: str
    unit: str
    median: float
    sd: float
    ignoring: float
    shift_in_sds: float


def laboratory_bias(mixed: Mixture, none: Fit) -> tuple[Bias, ...]:
    """Compare the simulators' parameters under a diagnosis with those of a fit without causes.

    Parameters
    ----------
    mixed : Mixture
    none : Fit
        Of the hypothesis that there is no gap, to both campaigns at once.

    Returns
    -------
    tuple of Bias
        Of every output's free parameters, in the order of its model.
    """
    draws, weights = [], []
    for i, (fit, probability) in enumerate(zip(mixed.fits, mixed.probability, strict=True)):
        size = max(100, int(1200 * probability))
        rng = generator(mixed.seed, "gap", "laboratory", fit.forward.hypothesis.name, i)
        psi = fit.draws(rng, size)
        draws.append({name: psi[:, part] for name, part in fit.forward.theta_slices.items()})
        weights.append(np.full(size, probability / size))
    weighted = Truth({}, {}, {}, {}, np.concatenate(weights))
    found = []
    for o in mixed.data.outputs:
        natural = o.priors.to_natural(np.concatenate([theta[o.name] for theta in draws]))
        low, median, high = (weighted.quantile(natural, q) for q in (0.16, 0.5, 0.84))
        sd = 0.5 * (high - low)
        ignoring = o.priors.to_natural(none.psi[None, none.forward.theta_slices[o.name]])[0]
        # At a bound there may be no spread, and nothing to compare with.
        shift = np.divide(ignoring - median, sd, out=np.zeros_like(sd), where=sd > 0.0)
        columns = np.stack([median, sd, ignoring, shift], axis=1).tolist()
        found += [
            Bias(o.name, prior.name, prior.unit, *row)
            for prior, row in zip(o.priors.entries, columns, strict=True)
            if not prior.fixed
        ]
    return tuple(found)
