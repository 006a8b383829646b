"""An effect that nobody could notice is no effect: hypotheses are about gaps that matter.

Every hypothesis but `none` is the claim that its effect is *relevant*: that in some output its
root-mean-square size over the field rows is at least `RELEVANT` noise sds (of several causes: that
each of them is at least `RELEVANT_IN_PAIR`).
Restricting its prior to relevant sizes multiplies its evidence by

    P(relevant | data, hypothesis) / P(relevant | hypothesis),

both estimated from draws. It keeps the probability of `none` from being shared out among effects
too small to see, and that of one effect among pairs whose other half is idle.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.noise import Noise, noise_conditions
from calib.inference.random import generator
from calib.models.base import Array

__all__ = ["RELEVANT", "RELEVANT_IN_PAIR", "gap_size", "relevance", "sizes"]

RELEVANT = 1.5
RELEVANT_IN_PAIR = 1.0


def relevance(fit: Fit, seed: int, draws: int) -> float:
    """Log of the factor by which restricting a hypothesis to relevant sizes changes its evidence.

    Parameters
    ----------
    fit : Fit
    seed : int
    draws : int
        Of the prior, and of the posterior where it has no sample.
    """
    hypothesis = fit.forward.hypothesis
    if hypothesis.name == "none":
        return 0.0
    rng = generator(seed, "gap", "relevance", hypothesis.name)
    # Of a sample each draw once: again it would say nothing new.
    posterior = fit.draws(rng, draws) if fit.sample is None else fit.sample
    # Prior draws of the effect about the simulator as it was fitted.
    prior = np.repeat(fit.psi[None], draws, axis=0)
    drawn = fit.forward.priors.sample(rng, draws)
    first_effect = max(s.stop for s in fit.forward.misfit_slices.values())
    prior[:, first_effect:] = drawn[:, first_effect:]
    size = partial(sizes, fit.forward, fit.noise)
    return _log_share(size(posterior)) - _log_share(size(prior))


def _log_share(size: Array) -> float:
    # Draws for which the model has no value say nothing either way.
    size = size[np.isfinite(size).all(axis=1)]
    threshold = RELEVANT if size.shape[1] == 1 else RELEVANT_IN_PAIR
    relevant = (size >= threshold).all(axis=1)
    return float(np.log((relevant.sum() + 0.2) / (size.shape[0] + 0.4)))


def sizes(forward: Forward, noise: Mapping[str, Noise], psi: Array) -> Array:
    """Size of each cause in noise sds, rms over an output's field rows, shape (k, n_causes).

    Of several outputs, that in which it is largest: what it does to the pull is no smaller because
    ruts, which it leaves alone, were measured as well. A parameter shift or a free discrepancy
    counts as one cause; one of several has the size of what goes when it alone is taken away.
    A discrepancy of several outputs is as large as in the output where it is smallest: what changes
    one output only is not one of several.
    """
    data, causes = forward.data, forward.causes
    alone = len(causes) == 1
    with np.errstate(all="ignore"):
        full, plain = forward.field_and_plain(psi, data.view)
        without = [
            plain if alone else forward.without(psi, data.view, c, plain=plain) for c in causes
        ]
    columns = []
    for other in without:
        each = _rms(forward, noise, {name: full[name] - other[name] for name in full})
        if alone and len(forward.hypothesis.smooth_outputs) > 1:
            columns.append(np.min([each[n] for n in forward.hypothesis.smooth_outputs], axis=0))
        else:
            columns.append(np.max(list(each.values()), axis=0))
    return np.stack(columns, axis=1)


def gap_size(fit: Fit) -> float:
    """Size of all that a fit adds to its simulators, in noise sds (rms, where it is largest)."""
    full, plain = fit.forward.field_and_plain(fit.psi[None], fit.forward.data.view)
    each = _rms(fit.forward, fit.noise, {name: full[name] - plain[name] for name in full})
    return float(np.nanmax([size[0] for size in each.values()]))


def _rms(
    forward: Forward, noise: Mapping[str, Noise], change: Mapping[str, Array]
) -> dict[str, Array]:
    """Rms of changes (k, n) of each output over its field rows, in noise sds, shape (k,)."""
    data, at = forward.data, noise_conditions(forward.data.view)
    return {
        o.name: np.sqrt(
            np.square(change[o.name][:, o.rows] / noise[o.name].sd(at.rows(o.rows))).mean(axis=1)
        )
        for o in data.outputs
    }
