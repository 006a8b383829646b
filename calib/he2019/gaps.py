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
from collections.abc import Callable, Mapping, Sequence
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

_RUT = ("inflation_pressure_psi", "average_ground_pressure_kpa", "slip_ratio", "rut_depth_mm")
_PULL = ("inflation_pressure_psi", "slip_ratio", "drawbar_pull_kn")
_PULL_MODEL = {"drawbar_pull": "magic_formula_pressure"}
# The wheel hardly slips up to this one: the two smallest nominal slips.
_TOWED = 0.03
_WORDS = declared("gaps.toml")


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
    return (_plain_bekker(), _nominal_slip(), _held_out_pull(), _post_peak())


def _gap(
    case: Case, unfitted: Table | None = None, variants: Mapping[str, Case] | None = None
) -> PaperGap:
    words = _WORDS[case.name]
    said = {key: " ".join(text.split()) for key, text in words.items()}
    return PaperGap(case.name, case=case, unfitted=unfitted, variants=variants or {}, **said)


def _plain_bekker() -> PaperGap:
    data = load_he2019("rut_depth")
    towed, at_30 = data["slip_ratio"] < _TOWED, data["inflation_pressure_psi"] == 30.0
    unfitted = _rows(data, ~towed & at_30, _RUT, "fresh.csv")
    case = _case(
        "plain_bekker", {"rut_depth": "bekker"}, _rows(data, towed, _RUT, "lab.csv"),
        _rows(data, ~towed & ~at_30, _RUT, "field.csv"), unfitted,
    )  # fmt: skip
    return _gap(case, unfitted)


def _nominal_slip() -> PaperGap:
    data = load_he2019("drawbar_pull")
    # By the order of the slips at each pressure; the field has the row at nominal zero.
    first = _slip_level(data) % 2 == 0
    at_30 = data["inflation_pressure_psi"] == 30.0

    def case(name: str, field_rows: NDArray[np.bool_], *, nominal: bool) -> Case:
        return _case(
            name, _PULL_MODEL, _rows(data, ~field_rows, _PULL, "lab.csv"),
            _rows(data, field_rows & ~at_30, _PULL, "field.csv", nominal=nominal),
            _rows(data, field_rows & at_30, _PULL, "fresh.csv", nominal=nominal),
        )  # fmt: skip

    variants = {
        "halves swapped": case("nominal_slip_swapped", ~first, nominal=True),
        "slips given back": case("nominal_slip_given_back", first, nominal=False),
    }
    unfitted = _rows(data, first & at_30, _PULL, "fresh.csv", nominal=True)
    return _gap(case("nominal_slip", first, nominal=True), unfitted, variants)


def _held_out_pull() -> PaperGap:
    data = load_he2019("drawbar_pull")
    return _gap(_split("held_out_pull", data, data["inflation_pressure_psi"] == 30.0))


def _post_peak() -> PaperGap:
    data = load_he2019("drawbar_pull")
    at_18 = data["inflation_pressure_psi"] == 18.0
    level = _slip_level(data)
    peak = int(level[at_18][np.argmax(data["drawbar_pull_kn"][at_18])])
    found, later, latest = (
        _split(name, data, at_18 & (level > peak + i))
        for i, name in enumerate(("post_peak_18_psi", "post_peak_later", "post_peak_latest"))
    )
    begins = "field begins {} later".format
    variants = {begins("one slip level"): later, begins("two slip levels"): latest}
    return _gap(found, variants=variants)


def _split(name: str, data: Table, field_rows: NDArray[np.bool_]) -> Case:
    """Make a case of the pull model whose field is some rows, and its laboratory the others."""
    return _case(
        name, _PULL_MODEL, _rows(data, ~field_rows, _PULL, "lab.csv"),
        _rows(data, field_rows, _PULL, "field.csv"),
    )  # fmt: skip


def _slip_level(data: Table) -> NDArray[np.int64]:
    """Return the place of each row's slip among the slips tested, from 0."""
    return np.unique(data["slip_ratio"], return_inverse=True)[1].astype(np.int64)


def _rows(
    data: Table, mask: NDArray[np.bool_], names: Sequence[str], file: str, *, nominal: bool = False
) -> Table:
    """Return some rows of the embedded data as a table, nominal slips in the place of slips."""
    columns = {
        name: data["nominal_slip_ratio" if nominal and name == "slip_ratio" else name][mask]
        for name in names
    }
    return _table(columns, file)


def _table(columns: Mapping[str, NDArray[np.float64]], file: str) -> Table:
    """Make a table that carries the hash of the file `calib.data.write_table` makes of it."""
    cells = zip(*(map(repr, values.tolist()) for values in columns.values()), strict=True)
    text = "".join(f"{','.join(row)}\n" for row in [tuple(columns), *cells])
    table = table_from_arrays(columns, source=file, label=LABEL)
    return replace(table, sha256=hashlib.sha256(text.encode()).hexdigest())


def _case(
    name: str, models: Mapping[str, str], lab: Table, field: Table, unfitted: Table | None = None
) -> Case:
    new = None
    if unfitted is not None:
        conditions = {n: v for n, v in unfitted.columns.items() if n not in OUTPUTS.values()}
        new = _table(conditions, "fresh.csv")
    return Case(name, lab, field, models, new, (RECONSTRUCTED,))


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
            f"{', '.join(existing)} exist there already", where=str(out),
            hint="choose another --out, or pass --overwrite",
        )  # fmt: skip
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

    @cached_property
    def document(self) -> GapDocument:
        """All that the diagnosis found, in numbers."""
        return gap_document(self.found)

    @property
    def output(self) -> str:
        """The one output that the case models."""
        return self.found.data.names[0]


@dataclass(frozen=True)
class Unfitted:
    """Errors of predictions at n rows in neither campaign: rms, and the largest relative one.

    Before by the calibrated simulator, after by the corrected model, within whose 90 % predictive
    band `covered` of them lie.
    """

    n: int
    covered: int
    rmse_before: float
    rmse_after: float
    largest_before: float
    largest_after: float


def begin_gaps(
    seed: int, gaps: Sequence[PaperGap], pool: Executor
) -> Callable[[Progress], tuple[FoundGap, ...]]:
    """Ask for the diagnoses of gaps and of their variants; return what waits for them."""
    asked = [
        (gap, pool.submit(_with_sd, gap.case, seed),
         {name: pool.submit(diagnose, case, seed) for name, case in gap.variants.items()})
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
    covered = int(((measured >= p.lower) & (measured <= p.upper)).sum())
    largest = (float(np.abs(error / measured).max()) for error in (before, after))
    return Unfitted(measured.size, covered, _rms(before), _rms(after), *largest)


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
    e = unfitted_errors(result.found, result.gap)
    if e is None:
        return own
    unit = OUTPUTS[result.output].rpartition("_")[2]
    values = {
        "rows": float(e.n), "in_90_band": float(e.covered),
        f"rmse_before_{unit}": e.rmse_before, f"rmse_after_{unit}": e.rmse_after,
    }  # fmt: skip
    if result.output == "rut_depth":  # a pull near zero has no relative error to speak of
        published = PUBLISHED.rut_depth.quality["held_out_max_relative_error"].value
        values |= {
            "largest_relative_before": e.largest_before,
            "largest_relative_after": e.largest_after, "largest_relative_published": published,
        }  # fmt: skip
    return *own, Check("kept_out_rows", values)


def probability_of(found: Diagnosis, effect: str) -> float:
    """Return the probability that an effect acts, alone or with another."""
    p = found.ranking.probability
    return float(sum(v for name, v in p.items() if effect in name.split("+")))


def _bekker_checks(result: FoundGap) -> tuple[Check, ...]:
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
        Check("deepening_at_20_percent_slip",
              {"median": middle, "lower_90": low, "upper_90": high,
               "eq_21_with_table_6": float((at_20 / towed).mean())}),
    )  # fmt: skip


def _slip_checks(result: FoundGap) -> tuple[Check, ...]:
    swapped, back = (result.variants[name] for name in ("halves swapped", "slips given back"))
    return (
        Check("shift_at_zero_slip", _shift(result.found) | {"withheld_percent": 100 * SLIP_SHIFT}),
        Check("halves_swapped", _shift(swapped)),
        Check("slips_given_back", {"probability_none": float(back.ranking.probability["none"])}),
    )


def _shift(found: Diagnosis) -> dict[str, float]:
    """Return the shift that a wrong radius makes at zero recorded slip, in percentage points."""
    name = "slip_zero_shift"
    effect = next(e for e in contract(gap_document(found))["effects"] if e["name"] == name)
    mean, sd = (100.0 * effect["parameters"]["radius_error"][key] for key in ("mean", "sd"))
    return {
        "probability": float(found.ranking.probability[name]),
        "mean_percent": mean, "sd_percent": sd,
        "lower_90_percent": mean - _Z_90 * sd, "upper_90_percent": mean + _Z_90 * sd,
    }  # fmt: skip


def _pull_checks(result: FoundGap) -> tuple[Check, ...]:
    found = result.found
    o = found.data.outputs[0]
    none = found.ranking.fits["none"][0]
    priors, part = o.priors, none.forward.theta_slices[o.name]
    bends = [i for i, p in enumerate(priors.free) if p.name.endswith("_bend")]
    moved = [(none.psi[part][i] - priors.free[i].loc) / priors.free[i].scale for i in bends]
    theta = priors.to_natural(none.psi[None, part])
    conditions = o.problem.bound.model.select(found.data.view.conditions)
    refitted = o.problem.bound.predict(theta, conditions)[0][o.rows]
    left = found.data.case.field[OUTPUTS[o.name]][o.rows] - refitted
    return (
        Check("miss_against_what_was_open",
              {"miss_rms_kn": _rms(_miss(found)), "simulator_sd_rms_kn": _rms(result.open_sd),
               "noise_sd_kn": none.noise[o.name].sigma}),
        Check("no_effect_fitted_to_all",
              {"miss_rms_kn": _rms(left),
               "largest_bend_prior_sd": float(np.max(np.abs(moved)))}),
    )  # fmt: skip


def _peak_checks(result: FoundGap) -> tuple[Check, ...]:
    p = result.found.ranking.probability
    softening = probability_of(result.found, "post_peak_softening")
    what = {
        "probability_some_gap": 1.0 - float(p["none"]),
        "probability_post_peak_softening": softening, "probability_unknown": float(p["unknown"]),
    }  # fmt: skip
    found = [Check("what_it_could_be", what)]
    for name, other in result.variants.items():
        best, p = other.ranking.order[0], other.ranking.probability
        values = {"rows": float(other.data.outputs[0].rows.size)}
        values |= {f"probability_{h}": float(p[h]) for h in ("none", best)}
        found.append(Check(name.replace(" ", "_"), values))
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
        "variance_ratio": ratio, "p_value": float(scipy.stats.f.sf(ratio, free[18], rest_free)),
        "sd_18_psi_kn": own**0.5, "sd_others_kn": (rest / rest_free) ** 0.5,
    }  # fmt: skip


def _miss(found: Diagnosis) -> Array:
    o = found.data.outputs[0]
    before = found.corrected.calibrated(found.data.view.conditions)[o.name][o.rows]
    return np.asarray(found.data.case.field[OUTPUTS[o.name]][o.rows] - before)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


_OWN: Mapping[str, Callable[[FoundGap], tuple[Check, ...]]] = {
    "plain_bekker": _bekker_checks, "nominal_slip": _slip_checks,
    "held_out_pull": _pull_checks, "post_peak_18_psi": _peak_checks,
}  # fmt: skip


def summarise_gaps(results: Sequence[FoundGap]) -> dict[str, Any]:
    """Return verdict, probabilities, rows, checks and variants as plain dictionaries by gap."""
    return {result.gap.name: _one(result) for result in results}


def _one(result: FoundGap) -> dict[str, Any]:
    found = result.found
    return {
        "models": dict(found.data.case.models),
        "rows": {"calibration": len(found.data.case.lab), "field": len(found.data.case.field)},
        "withheld": result.gap.withheld,
        **answer(contract(result.document)),
        "open_sd_rms": float((result.open_sd**2).mean() ** 0.5),
        "checks": {check.name: dict(check.values) for check in checks(result)},
        "variants": {name: _answer(other) for name, other in result.variants.items()},
        "warnings": list(found.warnings),
    }


def _answer(found: Diagnosis) -> dict[str, Any]:
    p = found.ranking.probability
    return {"verdict": found.verdict, "probability": {n: float(p[n]) for n in found.ranking.order}}
