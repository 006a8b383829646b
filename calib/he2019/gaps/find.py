"""Diagnose the four gaps, and set what is found beside what the source printed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from scipy.special import logsumexp

from calib.batch.pool import Later, Pool
from calib.batch.threads import one_thread
from calib.data.quantities import OUTPUTS
from calib.gap.case import Case
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.files import answer, document
from calib.he2019.datasets.drawbar import SLIP_SHIFT
from calib.he2019.datasets.published import PUBLISHED
from calib.he2019.gaps.cases import PaperGap
from calib.inference.random import generator
from calib.inference.sampling.mode import find_modes
from calib.inference.sampling.proposal import Guess, adapt
from calib.models.base import Array
from calib.models.bekker import rut_depth as eq_21
from calib.report.study import Progress

_N_DRAWS = 20_000
_NEGLIGIBLE = 1e-9
# Fewer effective draws do not give an sd to 5 %.
_LEAST_ESS = 400.0


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

    def ask(case: Case) -> Callable[..., Later[Any]]:
        # Without new conditions rows are left out in turn, which takes five times as long.
        return pool.submit_long if case.new_conditions is None else pool.submit

    asked = [
        (gap, ask(gap.case)(_with_sd, gap.case, seed),
         {name: ask(case)(diagnose, case, seed) for name, case in gap.variants.items()})
        for gap in gaps
    ]  # fmt: skip
    planned = sum(1 + len(gap.variants) for gap in gaps)

    def finish(tell: Progress) -> tuple[FoundGap, ...]:
        results = []
        for gap, piece, pieces in asked:
            found, open_sd = piece.result()
            variants = {name: variant.result() for name, variant in pieces.items()}
            results.append(FoundGap(gap, found, variants, open_sd))
            done = sum(1 + len(r.variants) for r in results)
            tell("the paper's own gaps: diagnosing", done, planned)
        return tuple(results)

    return finish


@one_thread()
def _with_sd(case: Case, seed: int) -> tuple[Diagnosis, Array]:
    found = diagnose(case, seed)
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


_FITTED_SLIP = 0.0125  # the middle of the slips at which plain Bekker was calibrated
_Z_90 = 1.645


@dataclass(frozen=True)
class Check:
    """One comparison: all numbers in it, by names with their units."""

    name: str
    values: Mapping[str, float]


def checks(result: FoundGap) -> tuple[Check, ...]:
    """Return the comparisons of a gap, in reading order."""
    own = _OWN[result.gap.name](result)
    kept_out = _kept_out(result)
    return own if kept_out is None else (*own, kept_out)


def _kept_out(result: FoundGap) -> Check | None:
    e = unfitted_errors(result.found, result.gap)
    if e is None:
        return None
    unit = OUTPUTS[result.output].rpartition("_")[2]
    values = {
        "rows": float(e.n), "in_90_band": float(e.covered),
        f"rmse_before_{unit}": e.rmse_before, f"rmse_after_{unit}": e.rmse_after,
    }  # fmt: skip
    if result.output == "rut_depth":
        # A pull near zero has no relative error to speak of.
        published = PUBLISHED.rut_depth.quality["held_out_max_relative_error"].value
        values |= {
            "largest_relative_before": e.largest_before,
            "largest_relative_after": e.largest_after,
            "largest_relative_published": published,
        }
    return Check("kept_out_rows", values)


def probability_of(found: Diagnosis, effect: str) -> float:
    """Return the probability that an effect acts, alone or with another."""
    p = found.ranking.probability
    return float(sum(v for name, v in p.items() if effect in name.split("+")))


def _plain_bekker(result: FoundGap) -> tuple[Check, ...]:
    found = result.found
    o, truth = found.data.outputs[0], found.truth
    slip = found.data.view.conditions["slip_ratio"][o.rows]
    pressure = found.data.view.conditions["average_ground_pressure_kpa"][o.rows]
    deepest = np.isclose(slip, slip.max())
    ratio = truth.truth[o.name] / truth.simulator[o.name]
    deepening = ratio[:, o.rows][:, deepest].mean(axis=1)
    low, middle, high = (float(truth.quantile(deepening[:, None], q)[0]) for q in (0.05, 0.5, 0.95))
    k, n0, n1 = (PUBLISHED.rut_depth.values[name] for name in ("k", "n0", "n1"))
    at_20, towed = (
        eq_21(pressure[deepest], s, k, n0, n1) for s in (float(slip.max()), _FITTED_SLIP)
    )
    return (
        Check("alone_or_with_another", {"probability": probability_of(found, "slip_sinkage")}),
        Check(
            "deepening_at_20_percent_slip",
            {
                "median": middle, "lower_90": low, "upper_90": high,
                "eq_21_with_table_6": float((at_20 / towed).mean()),
            },
        ),
    )  # fmt: skip


def _nominal_slip(result: FoundGap) -> tuple[Check, ...]:
    swapped, back = (
        result.variants[name] for name in ("halves swapped", "slips given back")
    )  # fmt: skip
    return (
        Check("shift_at_zero_slip", _shift(result.found) | {"withheld_percent": 100 * SLIP_SHIFT}),
        Check("halves_swapped", _shift(swapped)),
        Check("slips_given_back", {"probability_none": float(back.ranking.probability["none"])}),
    )


def _shift(found: Diagnosis) -> dict[str, float]:
    """Return the shift that a wrong radius makes at zero recorded slip, in percentage points."""
    name = "slip_zero_shift"
    effect = next(e for e in document(found)["effects"] if e["name"] == name)
    mean, sd = (100.0 * effect["parameters"]["radius_error"][key] for key in ("mean", "sd"))
    return {
        "probability": float(found.ranking.probability[name]),
        "mean_percent": mean, "sd_percent": sd,
        "lower_90_percent": mean - _Z_90 * sd, "upper_90_percent": mean + _Z_90 * sd,
    }  # fmt: skip


def _held_out_pull(result: FoundGap) -> tuple[Check, ...]:
    found = result.found
    o = found.data.outputs[0]
    none = found.ranking.fits["none"][0]
    priors, part = o.priors, none.forward.theta_slices[o.name]
    bends = [i for i, p in enumerate(priors.free) if p.name.endswith("_bend")]
    moved = [
        (none.psi[part][i] - priors.free[i].loc) / priors.free[i].scale for i in bends
    ]  # fmt: skip
    theta = priors.to_natural(none.psi[None, part])
    conditions = o.problem.bound.model.select(found.data.view.conditions)
    refitted = o.problem.bound.predict(theta, conditions)[0][o.rows]
    return (
        Check(
            "miss_against_what_was_open",
            {
                "miss_rms_kn": _rms(_miss(found)), "simulator_sd_rms_kn": _rms(result.open_sd),
                "noise_sd_kn": none.noise[o.name].sigma,
            },
        ),
        Check(
            "no_effect_fitted_to_all",
            {
                "miss_rms_kn": _rms(found.data.case.field[OUTPUTS[o.name]][o.rows] - refitted),
                "largest_bend_prior_sd": float(np.max(np.abs(moved))),
            },
        ),
    )  # fmt: skip


def _post_peak(result: FoundGap) -> tuple[Check, ...]:
    p = result.found.ranking.probability
    found = [
        Check(
            "what_it_could_be",
            {
                "probability_some_gap": 1.0 - float(p["none"]),
                "probability_post_peak_softening": probability_of(
                    result.found, "post_peak_softening"
                ),
                "probability_unknown": float(p["unknown"]),
            },
        )
    ]
    for name, other in result.variants.items():
        best = other.ranking.order[0]
        found.append(
            Check(
                name.replace(" ", "_"),
                {
                    "rows": float(other.data.outputs[0].rows.size),
                    "probability_none": float(other.ranking.probability["none"]),
                    f"probability_{best}": float(other.ranking.probability[best]),
                },
            )
        )
    return (*found, Check("costs_in_table_4", _table_4_costs()))


def _table_4_costs() -> dict[str, float]:
    """Compare Table 4's cost at 18 psi with those at the other pressures, as variances.

    This needs no reconstructed number: residual variances of three fits by the same method, F
    distributed if the noise were normal and the same at all pressures, and the formula right.
    """
    tables, n = PUBLISHED.genetic, int(PUBLISHED.setup.slip_levels.value)
    free = {psi: n - len(t.estimates) for psi, t in tables.items()}
    others = [psi for psi in tables if psi != 18]
    own = tables[18].quality["cost"].value / free[18]
    rest = sum(tables[psi].quality["cost"].value for psi in others)
    rest_free = sum(free[psi] for psi in others)
    ratio = own / (rest / rest_free)
    return {
        "variance_ratio": ratio,
        "p_value": float(scipy.stats.f.sf(ratio, free[18], rest_free)),
        "sd_18_psi_kn": own**0.5,
        "sd_others_kn": (rest / rest_free) ** 0.5,
    }


def _miss(found: Diagnosis) -> Array:
    o = found.data.outputs[0]
    before = found.corrected.calibrated(found.data.view.conditions)[o.name][o.rows]
    return np.asarray(found.data.case.field[OUTPUTS[o.name]][o.rows] - before)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


_OWN: Mapping[str, Callable[[FoundGap], tuple[Check, ...]]] = {
    "plain_bekker": _plain_bekker,
    "nominal_slip": _nominal_slip,
    "held_out_pull": _held_out_pull,
    "post_peak_18_psi": _post_peak,
}


def summarise_gaps(results: Sequence[FoundGap]) -> dict[str, Any]:
    """Return plain dictionaries by the names of the gaps.

    Each holds ``verdict``, ``probability`` by hypothesis, ``parameters`` of the most probable one,
    ``shrink``, ``rows``, ``withheld``, ``checks`` by name and ``variants`` by name.
    """
    return {result.gap.name: _one(result) for result in results}


def _one(result: FoundGap) -> dict[str, Any]:
    found = result.found
    return {
        "models": dict(found.data.case.models),
        "rows": {"calibration": len(found.data.case.lab), "field": len(found.data.case.field)},
        "withheld": result.gap.withheld,
        **answer(document(found)),
        "open_sd_rms": float((result.open_sd**2).mean() ** 0.5),
        "checks": {check.name: dict(check.values) for check in checks(result)},
        "variants": {name: _answer(other) for name, other in result.variants.items()},
        "warnings": list(found.warnings),
    }


def _answer(found: Diagnosis) -> dict[str, Any]:
    p = found.ranking.probability
    return {"verdict": found.verdict, "probability": {n: float(p[n]) for n in found.ranking.order}}
