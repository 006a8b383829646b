"""The files of a diagnosis: written, checked against each other, compared with a track record."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import betaincinv

from calib.data import write_table
from calib.data.files import inside
from calib.data.quantities import OUTPUTS
from calib.errors import FAULTS, CalibError
from calib.gap.case import words_of
from calib.gap.corrected import load_corrected, save_corrected
from calib.gap.diagnose import Diagnosis
from calib.gap.fit import Fit
from calib.gap.mixture import Included, Region, row_gaps
from calib.models.base import Array

# What the cases are, which is not what a user has.
BENCH = (
    "simulated campaigns of calib's own bench, whose mechanics share no formula with the "
    "diagnosis; no measured ones"
)


@dataclass(frozen=True)
class TrackRecord:
    """Blind cases whose first explanation was stated between two ends, and how many were right."""

    low: float
    high: float
    cases: int
    right: int

    @property
    def share(self) -> float:
        """Part of them that was right."""
        return self.right / self.cases

    @property
    def interval(self) -> tuple[float, float]:
        """Jeffreys 95 % interval of that part, closed at the ends where all or none were right."""
        a, b = self.right + 0.5, self.cases - self.right + 0.5
        low = float(betaincinv(a, b, 0.025)) if self.right else 0.0
        high = float(betaincinv(a, b, 0.975)) if self.right < self.cases else 1.0
        return low, high


def track_record(probability: float) -> TrackRecord:
    """Return the record of the bin that the probability of a first explanation lies in."""
    return next(r for r in reversed(_records()) if probability >= r.low)


@cache
def _records() -> tuple[TrackRecord, ...]:
    """The bins in order, all seeds together."""
    text = files("calib.gap").joinpath("track_record.toml").read_text(encoding="utf-8")
    pooled: dict[tuple[float, float], list[int]] = {}
    for record in tomllib.loads(text)["record"]:
        for low, high, cases, right in record["bins"]:
            sums = pooled.setdefault((low, high), [0, 0])
            sums[0] += cases
            sums[1] += right
    return tuple(TrackRecord(*ends, *sums) for ends, sums in sorted(pooled.items()))


SCHEMA = "calib/diagnosis/1"


def document(found: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis as the contract's JSON document."""
    ranking = found.ranking
    # Where the data are from the label says.
    case = found.data.case
    warnings = [w for w in found.warnings if w not in case.notes]
    # The same wherever the case lies.
    for table in filter(None, (case.lab, case.field, case.new_conditions)):
        warnings = [w.replace(table.source, Path(table.source).name) for w in warnings]
    return {
        "schema": SCHEMA,
        **({"data_label": found.data.case.label} if found.data.case.label else {}),
        "verdict": found.verdict,
        **({"warnings": warnings} if warnings else {}),
        "effects": [
            {
                "name": name,
                "probability": ranking.probability[name],
                "parameters": _parameters(ranking.best(name)),
            }
            for name in ranking.order
        ],
        "track_record": _track_record(ranking.probability[ranking.order[0]]),
        "inclusion": {name: _included(c) for name, c in found.inclusion.causes.items()},
        "remainder": {
            **_included(found.inclusion.residual_discrepancy),
            "where": [
                {"output": r.output, "conditions": _ends(found, r)} for r in found.inclusion.where
            ],
        },
        "not_testable": [{"name": n, "reason": r} for n, r in ranking.not_testable.items()],
        "where": _rows(found),
        "regions": [
            {
                "output": r.output,
                "conditions": _ends(found, r),
                "gap": r.gap,
                "probability": r.probability,
            }
            for r in found.regions
        ],
        "shrink": {
            name: {
                "rmse_before": s.rmse_before,
                "rmse_after": s.rmse_after,
                "fraction": s.fraction,
                "interval": list(s.interval),
                "noise_floor": s.noise_floor,
            }
            for name, s in found.shrink.items()
        },
        "next_measurement": [
            {
                "separates": list(m.separates),
                "conditions": {
                    name: words_of(found.data.case.covariates, name, value, value) or value
                    for name, value in m.conditions.items()
                },
                "gain_nats": m.gain_nats,
            }
            for m in found.next_measurements
        ],
    }


def _track_record(probability: float) -> dict[str, Any]:
    """Return how often first explanations that were as probable were right."""
    r = track_record(probability)
    return {
        "stated": [r.low, r.high],
        "cases": r.cases,
        "right": r.right,
        "share": r.share,
        "interval": list(r.interval),
        "of": BENCH,
    }


def _rows(found: Diagnosis) -> list[dict[str, Any]]:
    """Return an entry for every field row and output; rows that were not judged by say why."""
    unused = {name: np.array([*rows], np.int64) for name, rows in found.unused.items()}
    others = row_gaps(found.data, found.truth, unused) if unused else ()
    said = {
        (g.output, int(row)): {"gap": float(gap), "gap_sd": float(sd), "probability": float(p)}
        for g in (*found.gaps, *others)
        for row, gap, sd, p in zip(g.rows, g.gap, g.sd, g.probability, strict=True)
    }
    place = {name: i for i, name in enumerate(found.data.names)}
    rows = []
    for output, row in sorted(said, key=lambda at: (place[at[0]], at[1])):
        why = found.unused.get(output, {}).get(row)
        rows.append(
            {"output": output, "row": row, **said[output, row]}
            | ({} if why is None else {"used": False, "reason": why})
        )
    return rows


def answer(told: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is repeated elsewhere of a diagnosis' document; its first effect is the best."""
    best = told["effects"][0]
    return {
        "verdict": told["verdict"],
        "probability": {e["name"]: e["probability"] for e in told["effects"]},
        "best": best["name"],
        "parameters": best["parameters"],
        "shrink": told["shrink"],
    }


def _ends(found: Diagnosis, region: Region) -> dict[str, list[float] | list[str]]:
    """Return the ends of a region, or the value of a category that it is."""
    covariates = found.data.case.covariates
    return {
        name: [words_of(covariates, name, *ends)] if covariates.get(name) else list(ends)
        for name, ends in region.conditions.items()
    }


def _included(cause: Included) -> dict[str, Any]:
    return {
        "probability": cause.probability,
        "share": cause.share,
        "share_interval": list(cause.share_interval),
    }


def _parameters(fit: Fit) -> dict[str, dict[str, float]]:
    """Effect parameters with their sds, natural scale, prefixed with the effect in a pair."""
    sd = np.sqrt(np.diag(fit.covariance))
    effects = fit.forward.hypothesis.effects
    found = {}
    for effect, priors, part in zip(
        effects, fit.forward.hypothesis.effect_priors, fit.forward.phi_slices, strict=True
    ):
        natural = priors.to_natural(fit.psi[None, part])[0]
        spread = dict(zip(priors.names, sd[part], strict=True))
        for prior, value in zip(priors.entries, natural, strict=True):
            # A parameter that the prior file holds fixed has no spread.
            s = spread.get(prior.name, 0.0)
            name = prior.name if len(effects) == 1 else f"{effect.name}.{prior.name}"
            # A log-normal parameter's sd is that of its logarithm times its value.
            found[name] = {"mean": float(value), "sd": float(s * value if prior.log else s)}
    return found


def write_diagnosis(found: Diagnosis, folder: Path) -> None:
    """Write the files of a diagnosis into an existing folder."""
    (folder / "diagnosis.json").write_text(json.dumps(document(found), indent=1) + "\n")
    save_corrected(found.corrected, folder)
    new = found.data.case.new_conditions
    if new is None:
        return
    columns: dict[str, Array | list[str]] = {
        name: [row[j] for row in new.text] for j, name in enumerate(new.header)
    }
    if not new.text:
        columns = dict(new.columns)
    if found.data.case.label:
        columns["data_label"] = [found.data.case.label] * len(new)
    for name, prediction in found.new_predictions.items():
        column = OUTPUTS[name]
        columns[f"{column}_before"] = prediction.before
        columns[f"{column}_after"] = prediction.after
        columns[f"{column}_after_lower"] = prediction.lower
        columns[f"{column}_after_upper"] = prediction.upper
    write_table(folder / "fresh_prediction.csv", columns)


def misquoted(said: Any, folder: Path) -> str:
    """Say which entries of an `answer` are not those of a diagnosis folder; nothing if all are."""
    try:
        stated = answer(_diagnosis(folder))
    except FAULTS:
        return "the diagnosis is not a whole one"
    apart = [key for key, value in stated.items() if inside(said).get(key) != value]
    return f"not the same: {', '.join(apart)}" if apart else ""


def mispredicted(folder: Path) -> str:
    """Say what is wrong with a corrected model that does not predict the gaps of its diagnosis.

    It is drawn from, and a normal may be drawn otherwise by another processor: the means of
    hundreds of draws agree within a third of their sd.
    """
    try:
        corrected = load_corrected(folder)
        where = _diagnosis(folder)["where"]
        stated = {(e["output"], e["row"]): (e["gap"], e["gap_sd"]) for e in where}
        for g in row_gaps(corrected.data, corrected.mixture.at(corrected.data.view)):
            pairs = np.array([stated[g.output, int(row)] for row in g.rows], dtype=np.float64)
            apart = np.abs(np.stack([g.gap, g.sd], axis=1) - pairs)
            if (apart > 0.3 * pairs[:, 1:] + 1e-6).any():
                return "it does not predict the gaps that diagnosis.json states"
    except (CalibError, *FAULTS) as error:
        return f"it cannot be held against its diagnosis ({type(error).__name__}: {error})"
    return ""


def _diagnosis(folder: Path) -> Any:
    return json.loads((folder / "diagnosis.json").read_bytes())
