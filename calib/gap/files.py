"""What a diagnosis writes: diagnosis.json, fresh_prediction.csv (see the contract)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib.data import write_table
from calib.data.quantities import OUTPUTS
from calib.gap.corrected import save_corrected
from calib.gap.declared import words_of
from calib.gap.diagnose import Diagnosis
from calib.gap.fit import Fit
from calib.gap.inclusion import Included
from calib.gap.track_record import BENCH, track_record
from calib.gap.where import Region, row_gaps
from calib.models.base import Array

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
            **_included(found.inclusion.remainder),
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
