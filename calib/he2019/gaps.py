"""Four gaps of the source paper: as cases for the diagnosis, diagnosed, and set beside its figures.

A diagnosis lets an effect act in the field only. So each case puts into the laboratory the rows in
which the effect is absent, or already allowed for, and into the field those in which it acts; and
no row stands in both, since it would bring its own error along. That rules out two cases that come
to mind first: plain Bekker calibrated on all slips at 18 and 42 psi, and the Magic Formula
calibrated on all slips at 18 psi, have the effect in both campaigns.

The data are reconstructed from published results. What a finding can therefore mean, and what it
cannot, is part of every case (`PaperGap.limits`).
"""

from __future__ import annotations

import hashlib
import textwrap
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import logsumexp

from calib.batch.environment import one_thread
from calib.batch.folders import REPLACE
from calib.batch.pool import HERE
from calib.data import Table, table_from_arrays, write_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.case import Case
from calib.gap.describe import gap_document
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.document import GapDocument
from calib.gap.files import answer, contract
from calib.he2019 import declared
from calib.he2019.embedded import load_he2019
from calib.he2019.published import LABEL, PUBLISHED
from calib.he2019.reconstruction import SLIP_SHIFT
from calib.inference.mode import find_modes
from calib.inference.proposal import Guess, adapt
from calib.inference.random import generator
from calib.models.base import Array
from calib.models.soil import rut_depth as eq_21
from calib.report.study import Progress

RECONSTRUCTED = "the data are reconstructed from published results; they are not measurements"

type Mask = NDArray[np.bool_]
type Made = tuple[Case, Table | None]  # and the rows kept out of both campaigns


@dataclass(frozen=True)
class PaperGap:
    """One gap, as a question to a diagnosis; `limits` says what a finding can mean.

    `withheld` is the effect that the field has and the laboratory has not, where the source names
    one. `unfitted` has the conditions of `case.new_conditions` with the outcomes that the diagnosis
    is not shown. `variants` ask the same question otherwise.
    """

    name: str
    title: str
    question: str
    lab_rows: str
    field_rows: str
    limits: str
    case: Case
    withheld: str | None = None
    unfitted: Table | None = None
    variants: Mapping[str, Case] = field(default_factory=dict)


@cache
def paper_gaps() -> tuple[PaperGap, ...]:
    """Return the four gaps, made from the embedded data."""
    rut, pull = load_he2019("rut_depth"), load_he2019("drawbar_pull")
    # The wheel hardly slips at the two smallest nominal slips, 0 and 2.5 %.
    towed, at_30 = rut["slip_ratio"] < 0.03, rut["inflation_pressure_psi"] == 30.0
    bekker = _case("plain_bekker", rut, ~towed & ~at_30, ~towed & at_30)
    at_18, at_30 = (pull["inflation_pressure_psi"] == psi for psi in (18.0, 30.0))
    level = np.unique(pull["slip_ratio"], return_inverse=True)[1]
    # By the order of the slips at each pressure; the field has the row at nominal zero.
    first = level % 2 == 0
    slip = _case("nominal_slip", pull, first & ~at_30, first & at_30, nominal=True)
    swapped = _case("nominal_slip_swapped", pull, ~first & ~at_30, ~first & at_30, nominal=True)
    back = _case("nominal_slip_given_back", pull, first & ~at_30, first & at_30)
    peak = int(level[at_18][np.argmax(pull["drawbar_pull_kn"][at_18])])
    past, later, latest = (
        _case(name, pull, at_18 & (level > peak + i))
        for i, name in enumerate(("post_peak_18_psi", "post_peak_later", "post_peak_latest"))
    )
    begins = "field begins {} later".format
    return (
        _gap(bekker),
        _gap(slip, {"halves swapped": swapped, "slips given back": back}),
        _gap(_case("held_out_pull", pull, at_30)),
        _gap(past, {begins("one slip level"): later, begins("two slip levels"): latest}),
    )


def _gap(made: Made, variants: Mapping[str, Made] | None = None) -> PaperGap:
    (case, unfitted), others = made, {name: v[0] for name, v in (variants or {}).items()}
    said = {key: " ".join(text.split()) for key, text in declared("gaps.toml")[case.name].items()}
    return PaperGap(case.name, case=case, unfitted=unfitted, variants=others, **said)


def _case(
    name: str, data: Table, there: Mask, kept_out: Mask | None = None, *, nominal: bool = False
) -> Made:
    """Make a case of embedded data whose field is the rows `there`, and its laboratory the rest.

    Rows kept out of both are returned apart, in the case by their conditions. `nominal` puts
    nominal slips in the place of slips outside the laboratory.
    """

    def rows(mask: Mask, file: str, *, nominal: bool) -> Table:
        return _table(
            {n: data["nominal_slip_ratio" if nominal and n == "slip_ratio" else n][mask]
             for n in data if n != "nominal_slip_ratio"}, file,
        )  # fmt: skip

    unfitted = new = None
    lab, output = ~there, [*data][-1]
    if kept_out is not None:
        lab &= ~kept_out
        unfitted = rows(kept_out, "fresh.csv", nominal=nominal)
        new = _table({n: v for n, v in unfitted.columns.items() if n != output}, "fresh.csv")
    models = (
        {"rut_depth": "bekker"}
        if output == OUTPUTS["rut_depth"]
        else {"drawbar_pull": "magic_formula_pressure"}
    )
    case = Case(
        name, rows(lab, "lab.csv", nominal=False), rows(there, "field.csv", nominal=nominal),
        models, new, (RECONSTRUCTED,),
    )  # fmt: skip
    return case, unfitted


def _table(columns: Mapping[str, Array], file: str) -> Table:
    """Make a table that carries the hash of the file `calib.data.write_table` makes of it."""
    cells = zip(*(map(repr, values.tolist()) for values in columns.values()), strict=True)
    text = "".join(f"{','.join(row)}\n" for row in [tuple(columns), *cells])
    table = table_from_arrays(columns, source=file, label=LABEL)
    return replace(table, sha256=hashlib.sha256(text.encode()).hexdigest())


def write_cases(gaps: Sequence[PaperGap], out: Path, *, overwrite: bool = False) -> list[Path]:
    """Write each gap as a case folder, and return the folders.

    With ``case.toml``, ``lab.csv``, ``field.csv`` and, where rows were kept out, ``fresh.csv`` with
    their conditions and ``fresh_measured.csv`` with their outcomes, which no diagnosis reads.
    CalibError if a folder exists and may not be replaced.
    """
    folders = [Path(out) / gap.name for gap in gaps]
    existing = [folder.name for folder in folders if folder.exists()]
    if existing and not overwrite:
        raise CalibError(
            f"{', '.join(existing)} exist there already",
            where=str(out),
            hint=REPLACE,
        )
    for gap, folder in zip(gaps, folders, strict=True):
        folder.mkdir(parents=True, exist_ok=True)
        write_table(folder / "lab.csv", gap.case.lab.columns)
        write_table(folder / "field.csv", gap.case.field.columns)
        if gap.case.new_conditions is not None and gap.unfitted is not None:
            write_table(folder / "fresh.csv", gap.case.new_conditions.columns)
            write_table(folder / "fresh_measured.csv", gap.unfitted.columns)
        (folder / "case.toml").write_text(_case_toml(gap), encoding="utf-8")
    return folders


def _case_toml(gap: PaperGap) -> str:
    remarks = (
        f"{gap.title}. {gap.question}",
        f"Calibration: {gap.lab_rows}.",
        f"Field: {gap.field_rows}.",
        f"{RECONSTRUCTED.capitalize()}. {gap.limits}",
    )
    lines = [f"# {line}" for text in remarks for line in textwrap.wrap(text, 96)]
    lines += ['calibration = "lab.csv"', 'field = "field.csv"']
    if gap.case.new_conditions is not None:
        lines.append('predict = "fresh.csv"')
    lines += ["", "[models]", *(f'{o} = "{m}"' for o, m in gap.case.models.items())]
    return "\n".join(lines) + "\n"


# The diagnoses, and what the source printed


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

    @cached_property
    def document(self) -> GapDocument:
        """All that the diagnosis found, in numbers."""
        return gap_document(self.found)

    @property
    def output(self) -> str:
        """The one output that the case models."""
        return self.found.data.names[0]


def diagnose_gaps(
    seed: int, gaps: Sequence[PaperGap], pool: Executor = HERE, progress: Progress | None = None
) -> tuple[FoundGap, ...]:
    """Diagnose gaps and their variants; the numbers do not depend on the pool."""
    tell = progress or (lambda what, done, planned: None)
    asked = [
        (gap, pool.submit(_with_sd, gap.case, seed),
         {name: pool.submit(diagnose, case, seed) for name, case in gap.variants.items()})
        for gap in gaps
    ]  # fmt: skip
    results: list[FoundGap] = []
    for gap, piece, pieces in asked:
        found, open_sd = piece.result()
        variants = {name: variant.result() for name, variant in pieces.items()}
        results.append(FoundGap(gap, found, variants, open_sd))
        done, planned = (sum(1 + len(g.variants) for g in some) for some in (results, gaps))
        tell("the paper's own gaps: diagnosing", done, planned)
    return tuple(results)


@one_thread()
def _with_sd(case: Case, seed: int) -> tuple[Diagnosis, Array]:
    found = diagnose(case, seed)
    return found, simulator_sd(found)


def simulator_sd(found: Diagnosis) -> Array:
    """Return the sd (n_field,) of the calibrated simulator at the field rows, in the output's unit.

    Of the noise-free prediction under the posterior of the laboratory rows alone, by importance
    sampling from a mixture of Student-t fitted to it; NaN where too few draws carry the weight.
    """
    o = found.data.outputs[0]
    rng = generator(found.seed, "paper gaps", "simulator", o.name)
    log_prob, priors = o.problem.log_prob, o.problem.priors
    modes = find_modes(log_prob, priors, rng)
    guesses = [Guess(m.t, np.linalg.cholesky(m.covariance)) for m in modes]
    proposal, _ = adapt(log_prob, guesses, rng)
    drawn = proposal.draw(rng, n := 20_000)
    log_weight = log_prob(drawn) - proposal.log_prob(drawn)
    weight = np.exp(log_weight - logsumexp(log_weight))
    # What hardly weighs may lie so far out that the model's value overflows.
    inside = weight > 1e-9 / n
    conditions = o.problem.bound.model.select(found.data.view.conditions)
    theta = o.problem.theta(drawn[inside])[:, :-1]
    predicted = o.problem.bound.predict(theta, conditions)[:, o.rows]
    w = weight[inside]
    # Fewer effective draws do not give an sd to 5 %.
    if 1.0 / np.square(w).sum() < 400.0:
        return np.full(o.rows.size, np.nan)
    return np.asarray(np.sqrt(w @ np.square(predicted - w @ predicted)))


type Checks = dict[str, dict[str, float]]


def checks(result: FoundGap) -> Checks:
    """Return the comparisons of a gap in reading order: numbers by names with their units."""
    of_gap = {
        "plain_bekker": _bekker_checks, "nominal_slip": _slip_checks,
        "held_out_pull": _pull_checks, "post_peak_18_psi": _peak_checks,
    }  # fmt: skip
    own = of_gap[result.gap.name](result)
    unfitted, output = result.gap.unfitted, result.output
    if unfitted is None:
        return own
    # Predictions at rows in neither campaign, by the calibrated simulator and the corrected model.
    measured, p = unfitted[OUTPUTS[output]], result.found.new_predictions[output]
    before, after = measured - p.before, measured - p.after
    unit = OUTPUTS[output].rpartition("_")[2]
    values = {
        "rows": float(measured.size),
        "in_90_band": float(((measured >= p.lower) & (measured <= p.upper)).sum()),
        f"rmse_before_{unit}": _rms(before),
        f"rmse_after_{unit}": _rms(after),
    }
    if output == "rut_depth":  # a pull near zero has no relative error to speak of
        published = PUBLISHED.rut_depth.quality["held_out_max_relative_error"].value
        values |= {
            "largest_relative_before": float(np.abs(before / measured).max()),
            "largest_relative_after": float(np.abs(after / measured).max()),
            "largest_relative_published": published,
        }
    return own | {"kept_out_rows": values}


def probability_of(found: Diagnosis, effect: str) -> float:
    """Return the probability that an effect acts, alone or with another."""
    p = found.ranking.probability
    return float(sum(v for name, v in p.items() if effect in name.split("+")))


def _bekker_checks(result: FoundGap) -> Checks:
    found = result.found
    o, truth = found.data.outputs[0], found.truth
    slip = found.data.view.conditions["slip_ratio"][o.rows]
    pressure = found.data.view.conditions["average_ground_pressure_kpa"][o.rows]
    deepest = np.isclose(slip, slip.max())
    ratio = truth.truth[o.name] / truth.simulator[o.name]
    deepening = ratio[:, o.rows][:, deepest].mean(axis=1)
    low, middle, high = (float(truth.quantile(deepening[:, None], q)[0]) for q in (0.05, 0.5, 0.95))
    k, n0, n1 = (PUBLISHED.rut_depth.values[name] for name in ("k", "n0", "n1"))
    # Plain Bekker was calibrated at slips about 1.25 %.
    at_20, towed = (eq_21(pressure[deepest], s, k, n0, n1) for s in (float(slip.max()), 0.0125))
    return {
        "alone_or_with_another": {"probability": probability_of(found, "slip_sinkage")},
        "deepening_at_20_percent_slip": {
            "median": middle, "lower_90": low, "upper_90": high,
            "eq_21_with_table_6": float((at_20 / towed).mean()),
        },
    }  # fmt: skip


def _slip_checks(result: FoundGap) -> Checks:
    swapped, back = (result.variants[name] for name in ("halves swapped", "slips given back"))
    return {
        "shift_at_zero_slip": _shift(result.found) | {"withheld_percent": 100 * SLIP_SHIFT},
        "halves_swapped": _shift(swapped),
        "slips_given_back": {"probability_none": float(back.ranking.probability["none"])},
    }


def _shift(found: Diagnosis) -> dict[str, float]:
    """Return the shift that a wrong radius makes at zero recorded slip, in percentage points."""
    name = "slip_zero_shift"
    effect = next(e for e in contract(gap_document(found))["effects"] if e["name"] == name)
    mean, sd = (100.0 * effect["parameters"]["radius_error"][key] for key in ("mean", "sd"))
    return {
        "probability": float(found.ranking.probability[name]),
        "mean_percent": mean, "sd_percent": sd,
        "lower_90_percent": mean - 1.645 * sd, "upper_90_percent": mean + 1.645 * sd,
    }  # fmt: skip


def _pull_checks(result: FoundGap) -> Checks:
    found = result.found
    o = found.data.outputs[0]
    none = found.ranking.fits["none"][0]
    priors, part = o.priors, none.forward.theta_slices[o.name]
    bends = [i for i, p in enumerate(priors.free) if p.name.endswith("_bend")]
    moved = [(none.psi[part][i] - priors.free[i].loc) / priors.free[i].scale for i in bends]
    theta = priors.to_natural(none.psi[None, part])
    conditions = o.problem.bound.model.select(found.data.view.conditions)
    refitted = o.problem.bound.predict(theta, conditions)[0][o.rows]
    before = found.corrected.calibrated(found.data.view.conditions)[o.name][o.rows]
    measured = found.data.case.field[OUTPUTS[o.name]][o.rows]
    return {
        "miss_against_what_was_open": {
            "miss_rms_kn": _rms(measured - before),
            "simulator_sd_rms_kn": _rms(result.open_sd),
            "noise_sd_kn": none.noise[o.name].sigma,
        },
        "no_effect_fitted_to_all": {
            "miss_rms_kn": _rms(measured - refitted),
            "largest_bend_prior_sd": float(np.max(np.abs(moved))),
        },
    }


def _peak_checks(result: FoundGap) -> Checks:
    p = result.found.ranking.probability
    found = {
        "what_it_could_be": {
            "probability_some_gap": 1.0 - float(p["none"]),
            "probability_post_peak_softening": probability_of(result.found, "post_peak_softening"),
            "probability_unknown": float(p["unknown"]),
        }
    }
    for name, other in result.variants.items():
        best, p = other.ranking.order[0], other.ranking.probability
        found[name.replace(" ", "_")] = {
            "rows": float(other.data.outputs[0].rows.size),
            **{f"probability_{h}": float(p[h]) for h in ("none", best)},
        }
    return found | {"costs_in_table_4": _table_4_costs()}


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
        "variance_ratio": ratio, "p_value": float(scipy.stats.f.sf(ratio, free[18], rest_free)),
        "sd_18_psi_kn": own**0.5, "sd_others_kn": (rest / rest_free) ** 0.5,
    }  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def summarise_gaps(results: Sequence[FoundGap]) -> dict[str, Any]:
    """Return verdict, probabilities, rows, checks and variants as plain dictionaries by gap."""
    return {
        result.gap.name: {
            "models": dict(result.found.data.case.models),
            "rows": {
                "calibration": len(result.found.data.case.lab),
                "field": len(result.found.data.case.field),
            },
            "withheld": result.gap.withheld,
            **answer(contract(result.document)),
            "open_sd_rms": float((result.open_sd**2).mean() ** 0.5),
            "checks": checks(result),
            "variants": {
                name: {"verdict": v.verdict, "probability": {n: p[n] for n in v.ranking.order}}
                for name, v in result.variants.items()
                for p in [v.ranking.probability]
            },
            "warnings": list(result.found.warnings),
        }
        for result in results
    }
