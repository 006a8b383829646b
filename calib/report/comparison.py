"""What a comparison leaves: `comparison.json`, the figure, a page, and a run folder per model."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.io import load_calibration, save_calibration
from calib.report.figures.comparison import comparison_figure
from calib.report.figures.export import png_bytes
from calib.report.page.comparison import render
from calib.validation.comparison import Candidate, Comparison
from calib.validation.prediction import N_DRAWS
from calib.validation.validate import PARETO_K_MAX

__all__ = ["FILE", "SCHEMA", "document", "load_stack", "write_comparison"]

SCHEMA = "calib/comparison/1"
FILE = "comparison.json"


def document(comparison: Comparison, hold_out: str = "") -> dict[str, Any]:
    """Return every number of a comparison as plain dictionaries."""
    return {
        "schema": SCHEMA,
        "seed": comparison.seed,
        "rows": len(comparison.candidates[0].loo.table),
        "held_out": hold_out,
        "converged": comparison.sound,
        "verdict": comparison.sentence,
        "models": {c.model: _model(comparison, c) for c in comparison.candidates},
    }


def _model(comparison: Comparison, c: Candidate) -> dict[str, Any]:
    difference, loo = comparison.differences[c.model], c.loo
    found: dict[str, Any] = {
        "weight": comparison.weights[c.model],
        "elpd": loo.elpd,
        "elpd_se": loo.elpd_se,
        "below_best": difference.elpd,
        "below_best_se": difference.se,
        "told_apart": difference.clear,
        "converged": c.calibration.converged,
        "pareto_k_max": None if loo.pareto_k is None else _finite(float(loo.pareto_k.max())),
        "pareto_k_limit": PARETO_K_MAX,
        "refitted_rows": len(loo.refitted),
        "refits_not_converged": len(loo.unconverged),
        "rmse": loo.scores.rmse,
        "crps": _finite(loo.scores.crps),
        "coverage_90": loo.scores.coverage[0.9].proportion,
        "log_evidence": _finite(c.calibration.draws.log_evidence),
    }
    if c.held is not None:
        found["held_out"] = {
            "rows": c.held.scores.n,
            "elpd": _finite(c.held_elpd),
            "rmse": c.held.scores.rmse,
            "crps": _finite(c.held.scores.crps),
            "coverage_90": c.held.scores.coverage[0.9].proportion,
        }
    return found


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def write_comparison(
    comparison: Comparison, folder: Path, command: Sequence[str], hold_out: str = ""
) -> dict[str, Any]:
    """Write a comparison into an empty folder and return what `comparison.json` holds.

    Parameters
    ----------
    comparison : Comparison
    folder : Path
    command : sequence of str
        The command line, for the page.
    hold_out : str
        What was held out, in words; empty for nothing.
    """
    found = document(comparison, hold_out)
    image = png_bytes(comparison_figure(comparison))
    (folder / "figures").mkdir()
    (folder / "figures" / "bands.png").write_bytes(image)
    (folder / FILE).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    uri = f"data:image/png;base64,{base64.b64encode(image).decode()}"
    (folder / "index.html").write_text(render(found, uri, command), encoding="utf-8")
    for c in comparison.candidates:
        run = folder / "runs" / c.model
        run.mkdir(parents=True)
        save_calibration(c.calibration, run)
    return found


def load_stack(folder: Path) -> tuple[dict[str, Any], list[tuple[float, Calibration]]]:
    """Read a folder of `calib compare`: what it found, and the models that have a weight.

    Raises
    ------
    CalibError
        If it is damaged.
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
