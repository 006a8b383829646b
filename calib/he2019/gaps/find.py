"""Diagnose the four gaps, and set what is found beside what the source printed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calib.batch.pool import Pool
from calib.batch.threads import one_thread
from calib.data.quantities import OUTPUTS
from calib.gap.case import Case
from calib.gap.diagnose import Diagnosis, diagnose_once, with_unseen_rows
from calib.he2019.gaps.cases import PaperGap
from calib.inference.random import generator
from calib.inference.sampling.adapt import Guess, adapt
from calib.inference.sampling.mode import find_modes
from calib.models.base import Array

_N_DRAWS = 20_000
_NEGLIGIBLE = 1e-9
# Fewer effective draws do not give an sd to 5 %.
_LEAST_ESS = 400.0

type Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class FoundGap:
    """A gap and what the diagnosis makes of it, and of the same question asked otherwise.

    `open_sd` (n_field,) is what the laboratory left open: the sd of the calibrated simulator at the
    field rows, in the output's unit.
    """

    gap: PaperGap
    found: Diagnosis
    variants: Mapping[str, Diagnosis]
    open_sd: Array

    @property
    def output(self) -> str:
        """The one output that the case models."""
        return self.found.data.names[0]


@dataclass(frozen=True)
class Unfitted:
    """Errors of predictions at n rows that stood in neither campaign.

    Of them `covered` lie within the corrected model's 90 % predictive band. Measured minus
    predicted and the largest relative error, of the measured value: by the calibrated simulator
    before, by the corrected model after.
    """

    n: int
    covered: int
    rmse_before: float
    rmse_after: float
    largest_before: float
    largest_after: float


def begin_gaps(
    seed: int, gaps: Sequence[PaperGap], pool: Pool
) -> Callable[[Progress], tuple[FoundGap, ...]]:
    """Ask for the diagnoses of gaps and of their variants; return what waits for them."""
    asked = [
        (gap, pool.submit(_with_sd, gap.case, seed),
         {name: pool.submit(diagnose_once, case, seed) for name, case in gap.variants.items()})
        for gap in gaps
    ]  # fmt: skip
    planned = sum(1 + len(gap.variants) for gap in gaps)

    def finish(tell: Progress) -> tuple[FoundGap, ...]:
        results = []
        for gap, piece, pieces in asked:
            once, open_sd = piece.result()
            found = with_unseen_rows(once, pool=pool)
            variants = {
                name: with_unseen_rows(variant.result(), pool=pool)
                for name, variant in pieces.items()
            }
            results.append(FoundGap(gap, found, variants, open_sd))
            done = sum(1 + len(r.variants) for r in results)
            tell("the paper's own gaps: diagnosing", done, planned)
        return tuple(results)

    return finish


@one_thread()
def _with_sd(case: Case, seed: int) -> tuple[Diagnosis, Array]:
    found = diagnose_once(case, seed)
    return found, simulator_sd(found)


def simulator_sd(found: Diagnosis) -> Array:
    """Return how uncertain the simulator is at the field rows as the laboratory calibrated it.

    The sd of the noise-free prediction of a case with one output, (n_field,) in its unit, under the
    posterior of the laboratory rows alone, by importance sampling from a mixture of Student-t
    fitted to it; NaN where too few draws carry the weight.
    """
    o = found.data.outputs[0]
    rng = generator(found.seed, "paper gaps", "simulator", o.name)
    log_prob, priors = o.problem.log_prob, o.problem.priors
    modes = find_modes(log_prob, priors, rng)
    guesses = [Guess(m.t, np.linalg.cholesky(m.covariance)) for m in modes]
    proposal, _ = adapt(log_prob, guesses, rng)
    drawn, log_q = proposal.draw(rng, _N_DRAWS)
    log_weight = log_prob(drawn) - log_q
    weight = np.exp(log_weight - logsumexp(log_weight))
    # What hardly weighs may lie so far out that the model's value overflows.
    inside = weight > _NEGLIGIBLE / _N_DRAWS
    conditions = o.problem.bound.model.select(found.data.view.conditions)
    theta = o.problem.theta(drawn[inside])[:, :-1]
    predicted = o.problem.bound.predict(theta, conditions)[:, o.rows]
    w = weight[inside]
    if 1.0 / np.square(w).sum() < _LEAST_ESS:
        return np.full(o.rows.size, np.nan)
    return np.asarray(np.sqrt(w @ np.square(predicted - w @ predicted)))


def unfitted_errors(found: Diagnosis, gap: PaperGap) -> Unfitted | None:
    """Compare predictions with the outcomes that were kept out; None where none were."""
    if gap.unfitted is None:
        return None
    output = found.data.names[0]
    measured, p = gap.unfitted[OUTPUTS[output]], found.new_predictions[output]
    before, after = measured - p.before, measured - p.after
    return Unfitted(
        measured.size,
        int(((measured >= p.lower) & (measured <= p.upper)).sum()),
        float(np.sqrt(np.mean(before**2))),
        float(np.sqrt(np.mean(after**2))),
        float(np.abs(before / measured).max()),
        float(np.abs(after / measured).max()),
    )
