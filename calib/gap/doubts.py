"""Test what the most probable explanation leaves in the field: its scatter, unused columns."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy

from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, role_of
from calib.data.units_check import source_of
from calib.gap.campaigns import Campaigns, OutputData
from calib.gap.fit import Fit
from calib.gap.which import Ranking
from calib.models import get_model
from calib.models.base import Array
from calib.validation.assumptions import Check, Remark, failed, unexplained, unused

# A field that scatters less than so many times as much as the laboratory is as a field is.
_NOISIER = 2.0


def doubts(data: Campaigns, ranking: Ranking) -> tuple[Remark, ...]:
    """Say what no explanation has: in a field as it says, any is said with a chance of `LEVEL`."""
    best = ranking.best(ranking.order[0])
    return failed([
        check
        for o in data.outputs
        for check in (*_noisier(data, o, ranking.lab_mode[o.name], best),
                      *_patterns(data, o, ranking, best))
    ])  # fmt: skip


def _noisier(data: Campaigns, o: OutputData, mode: Array, best: Fit) -> Iterable[Check]:
    """Whether the field scatters more about the explanation than the laboratory about its own fit.

    An F test of the variances, each in units of how the noise grows. What the explanation takes
    up of the field's is not allowed for, so that it is too rarely significant.
    """
    noise, left = best.noise[o.name], o.problem.response.size - len(o.priors.free)
    if left < 1:
        return
    lab = o.problem.response - o.problem.bound.mean_response(
        o.priors.to_natural(mode[None]), o.problem.conditions
    )[0]  # fmt: skip
    field = best.field_residuals[o.name] * noise.sigma
    grown = data.lab_at[o.name].growth(noise.rho, noise.kappa)
    variance = float(np.square(lab / grown).sum()) / left
    if not variance > 0.0:
        return
    f = float(np.square(field).mean()) / variance
    p, times = float(scipy.stats.f.sf(f, field.size, left)), np.sqrt(f)
    there = float(np.sqrt(np.square(lab).sum() / left))
    sds = [_noise_text(o, sd) for sd in (times * there, there)]
    said = (
        f"the field's {o.name.replace('_', ' ')} scatters {plain_number(times, 2)} times as much "
        f"as the laboratory's (sd {sds[0]} against {sds[1]})"
    )
    yield Check(p if times >= _NOISIER else 1.0, Remark(
        f"{source_of(data.case.field)}: {said} about the most probable explanation "
        f"(p = {plain_number(p, 2)}), so something that differs from row to row acts there: "
        "record what changed between rows (operator, tyre, place) as a column, declare it under "
        "[covariates] in case.toml, and diagnose again", said,
    ))  # fmt: skip


def _patterns(data: Campaigns, o: OutputData, ranking: Ranking, best: Fit) -> Iterable[Check]:
    """Whether residuals differ with a column that no model or effect uses."""
    table = data.case.field.take(o.rows)
    fits = (fit for group in ranking.fits.values() for fit in group)
    roles = {c for fit in fits for e in fit.forward.hypothesis.effects for c in e.covariates}
    roles |= {role_of(c) for m in data.case.models.values() for c in get_model(m).conditions}
    own = {c for c in table.columns if role_of(c) in roles} | {*OUTPUTS.values()}
    columns = {h: v for h, v in unused(table, own).items() if h not in data.case.covariates}
    output = o.name.replace("_", " ")
    return unexplained(
        table, columns, best.field_residuals[o.name],
        title=f"the field's {output} differs with {{!r}}, which no model or effect uses",
        hint="declare it under [covariates] in case.toml, and diagnose again",
    )  # fmt: skip


def _noise_text(o: OutputData, sd: float) -> str:
    """Write a noise in the output's unit, or of a logarithm as a part of the output."""
    if o.problem.bound.model.response == "log":
        return f"{plain_number(100.0 * sd, 2)} %"
    return f"{plain_number(sd, 2)} {QUANTITIES[OUTPUTS[o.name]].unit_word}"
