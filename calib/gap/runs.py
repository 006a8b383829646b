"""Whether an output follows the order of the runs."""

from __future__ import annotations

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.fit import Fit
from calib.models.base import Array

# What a line or a step has to gain (nats) for a drift or a jump of a reading to be worth a fit:
# with less, their priors and the freedom of their sizes leave them below a few per cent beside
# noise alone.
_WORTH = 4.0


def change_over_runs(residual: Array, order: Array) -> float:
    """Most by which a straight line or one step over the runs raises the log likelihood.

    The noise is what is left in either case.

    Parameters
    ----------
    residual, order : ndarray, shape (n,)
    """
    z = residual[np.argsort(order, kind="stable")]
    n, u = z.size, np.arange(z.size) - 0.5 * (z.size - 1)
    z = z - z.mean()
    before = np.arange(1, n)
    of_step = np.square(np.cumsum(z)[:-1]) * n / (before * (n - before))
    of_line = np.square(u @ z) / np.square(u).sum()
    total = float(np.square(z).sum())
    if total <= 1e-20 * float(np.square(residual).sum()):
        return 0.0
    part = max(float(of_step.max()), float(of_line)) / total
    return -0.5 * n * float(np.log(max(1.0 - part, 1e-12)))


def follows_runs(data: Campaigns, none: Fit) -> set[str]:
    """Roles of the outputs whose residuals without a gap change over the runs.

    Parameters
    ----------
    none : Fit
        Of noise alone.
    """
    if data.view.column("order") is None:
        return set()
    order = data.view.of("order")
    return {
        o.role
        for o in data.outputs
        if change_over_runs(none.field_residuals[o.name], order[o.rows]) > _WORTH
    }
