"""What a comparison leaves: `comparison.json`, the figure, a page, and a run folder per model.

With the rows that were held out and a hash of every file, so that it can be computed again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calib.batch.environment import Environment
from calib.data import write_table
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.io import load_calibration, save_calibration
from calib.report.figures.comparison import comparison_figure
from calib.report.figures.export import png_bytes
from calib.report.manifest import file_hashes
from calib.report.numbers import finite
from calib.report.page.comparison import render
from calib.report.page.pictures import data_uri
from calib.validation.comparison import Candidate, Comparison, difference
from calib.validation.prediction import N_DRAWS
from calib.validation.validate import PARETO_K_MAX

SCHEMA = "calib/comparison/2"
FILE, PAGE, FIGURE, HELD_OUT = (
    "comparison.json", "index.html", "figures/bands.png", "held_out.csv"
)  # fmt: skip


def document(comparison: Comparison, hold_out: str = "", best: str | None = None) -> dict[str, Any]:
    """Return every number of a comparison as plain dictionaries.

    What was held out is said in words. Differences are from the model `best`, where another
    comparison had it for the best.
    """
    first = next(c for c in comparison.candidates if best in (None, c.model))
    return {
        "schema": SCHEMA,
        "seed": comparison.seed,
        "rows": len(comparison.candidates[0].loo.table),
        "held_out": hold_out,
        "converged": comparison.sound,
        "verdict": comparison.sentence,
        "models": {c.model: _model(comparison, c, first) for c in comparison.candidates},
    }


def _model(comparison: Comparison, c: Candidate, best: Candidate) -> dict[str, Any]:
    below, loo = difference(best.rows - c.rows), c.loo
    found: dict[str, Any] = {
        "weight": comparison.weights[c.model],
        "elpd": loo.elpd,
        "elpd_se": loo.elpd_se,
        "below_best": below.elpd,
        "below_best_se": below.se,
        "told_apart": below.clear,
        "elpd_rows": c.rows.tolist(),
        "converged": c.calibration.converged,
        "pareto_k_max": None if loo.pareto_k is None else finite(float(loo.pareto_k.max())),
        "pareto_k_limit": PARETO_K_MAX,
        "refitted_rows": len(loo.refitted),
        "refits_not_converged": len(loo.unconverged),
        "rmse": loo.scores.rmse,
        "crps": finite(loo.scores.crps),
        "coverage_90": loo.scores.coverage[0.9].proportion,
        "log_evidence": finite(c.calibration.draws.log_evidence),
    }
    if c.held is not None:
        found["held_out"] = {
            "rows": c.held.scores.n,
            "elpd": finite(c.held_elpd),
            "rmse": c.held.scores.rmse,
            "crps": finite(c.held.scores.crps),
            "coverage_90": c.held.scores.coverage[0.9].proportion,
        }
    return found


def page(found: Mapping[str, Any], image: bytes) -> str:
    """Return the page of a comparison, from the content of `comparison.json` and the figure."""
    return render(found, data_uri(image), found["command"])


def write_comparison(
    comparison: Comparison,
    folder: Path,
    command: Sequence[str],
    hold_out: str = "",
    *,
    environment: Environment | None = None,
) -> dict[str, Any]:
    """Write a comparison into an empty folder and return what `comparison.json` holds.

    What was held out is said in words; the command line is for the page.
    """
    here = environment or Environment.here()
    first = comparison.candidates[0]
    found = {
        **document(comparison, hold_out),
        "command": list(command),
        "settings": json.loads(json.dumps(asdict(first.calibration.settings))),
        **here.document(),
    }
    image = png_bytes(comparison_figure(comparison))
    (folder / "figures").mkdir()
    (folder / FIGURE).write_bytes(image)
    (folder / PAGE).write_text(page(found, image), encoding="utf-8")
    if first.held is not None:
        write_table(folder / HELD_OUT, first.held.table.columns)
    for c in comparison.candidates:
        run = folder / "runs" / c.model
        run.mkdir(parents=True)
        save_calibration(c.calibration, run, environment=here)
    found["files"] = file_hashes(folder)
    (folder / FILE).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    return found


def load_stack(folder: Path) -> tuple[dict[str, Any], list[tuple[float, Calibration]]]:
    """Read a folder of `calib compare`: what it found, and the models that have a weight.

    A CalibError says that it is damaged.
    """
    path = folder / FILE
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        weights = {name: float(m["weight"]) for name, m in found["models"].items()}
        if found["schema"] != SCHEMA:
            raise ValueError
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise CalibError(
            "the file cannot be read", where=str(path),
            allowed="the file as `calib compare` wrote it", mend="run `calib compare` again",
        ) from None  # fmt: skip
    used = {name: w for name, w in weights.items() if round(w * N_DRAWS) > 0}
    return found, [(w, load_calibration(folder / "runs" / name)) for name, w in used.items()]
