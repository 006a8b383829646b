"""What a run leaves: `sbc.json` with every rank's transform, figures and a page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calib.batch.folders import write_whole
from calib.report.figures.export import png_bytes
from calib.report.figures.sbc import coverage_figure, ranks_figure
from calib.report.numbers import finite
from calib.report.page.pictures import data_uri
from calib.report.page.sbc import render
from calib.validation.sbc.designs import design_of
from calib.validation.sbc.score import ModelScore, SbcScore

SCHEMA = "calib/sbc/1"


def document(score: SbcScore, settings: dict[str, Any]) -> dict[str, Any]:
    """Return every number of a run as plain dictionaries."""
    adjusted = score.adjusted
    return {
        "schema": SCHEMA,
        "seed": score.seed,
        "simulations": score.simulations,
        "settings": settings,
        "alarms": [f"{model}: {name}" for model, name in score.alarms],
        "models": {m.model: _model(m, adjusted) for m in score.models},
    }


def _model(m: ModelScore, adjusted: dict[tuple[str, str], float]) -> dict[str, Any]:
    return {
        "design": design_of(m.model).text,
        "replicates": m.replicates,
        "failed": dict(m.failed),
        "not_converged": m.unconverged,
        "extended": m.extended,
        "prior_draws": m.attempts,
        "held_out_without_band": m.no_band,
        "coverage": {
            f"{100 * c.level:g}": {
                "proportion": finite(c.proportion),
                "standard_error": finite(c.se),
                "interval": finite(c.interval),
                "measurements": c.rows,
                "campaigns": c.replicates,
                "p": c.p,
                "p_adjusted": adjusted[m.model, f"{100 * c.level:g} % band"],
            }
            for c in m.coverage
        },
        "quantities": {
            q.name: {
                "p": q.p,
                "p_adjusted": adjusted[m.model, q.name],
                "p_with_not_converged": q.p_all,
                "pit": [round(float(v), 5) for v in q.pit],
            }
            for q in m.quantities
        },
    }


def write_sbc(score: SbcScore, out: Path, settings: dict[str, Any], command: Sequence[str]) -> Path:
    """Write numbers, figures and page into the folder of a run, and return the page's path.

    Files of an earlier end of the run are replaced. Settings are the sampler's, the command line is
    for the page.
    """
    text = json.dumps(document(score, settings), allow_nan=False) + "\n"
    images = {m.model: png_bytes(ranks_figure(m, score.adjusted)) for m in score.models}
    images["coverage"] = png_bytes(coverage_figure(score))
    page = render(score, {name: data_uri(image) for name, image in images.items()}, command)
    (out / "figures").mkdir(exist_ok=True)
    for name, image in images.items():
        (out / "figures" / f"{name}.png").write_bytes(image)
    write_whole(out / "sbc.json", text)
    write_whole(out / "index.html", page)
    return out / "index.html"
