"""What simulation-based calibration leaves: `sbc.json` with all ranks, figures and a page."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from calib.batch.folders import write_whole
from calib.models import MODELS
from calib.report.figures import style
from calib.report.figures.style import png_bytes
from calib.report.labels import MINUS, aligned, short, symbol
from calib.report.numbers import finite
from calib.report.page.template import data_uri, template
from calib.validation.constants import LEVEL
from calib.validation.sbc import ModelScore, Quantity, SbcScore, ecdf_band

_TITLES: Mapping[str, str] = {
    "log_likelihood": "log likelihood",
    "prediction": "held-out mean",
    "measurement": "held-out reading",
}


def ranks_figure(model: ModelScore, adjusted: Mapping[tuple[str, str], float]) -> Figure:
    """Draw for each quantity the ECDF of its transforms less the uniform one, with its band.

    The p values of the run are adjusted, by model and quantity.
    """
    n = len(model.quantities)
    cols = 6 if n > 12 else min(5, n)
    margins = {"left": 17.0, "right": 4.0, "bottom": 18.0, "gap_y": 10.0}
    with style.style():
        figure, axes = style.panels(
            -(-n // cols), cols, height=22.0, sharex=True, sharey=True, **margins
        )
        handles: dict[str, Any] = {}
        for ax, quantity in zip(axes.flat, model.quantities, strict=False):
            handles = _panel(ax, quantity, alarm=adjusted[model.model, quantity.name] < LEVEL)
        style.hide_rest(axes, n)
        for row in axes:
            row[0].set_ylabel(f"ECDF {MINUS} PIT")
        what = "probability integral transform (PIT) of the truth"
        figure.supxlabel(what, fontsize=8, y=8.0 / (figure.get_figheight() * 25.4))
        style.legend_below(figure, handles, 3)
    return figure


def _panel(ax: Axes, quantity: Quantity, *, alarm: bool) -> dict[str, Any]:
    band = ecdf_band(quantity.pit, 0.95)
    low, high, found = (v - band.x for v in (band.lower, band.upper, band.ecdf))
    sky: Any = {"color": style.SKY, "alpha": 0.3, "lw": 0.0}
    expected = ax.fill_between(band.x, low, high, step="post", **sky)
    colour = style.VERMILION if alarm else style.BLUE
    (line,) = ax.step(band.x, found, where="post", color=colour, lw=1.0)
    ax.axhline(0.0, color=style.GREY, lw=0.5)
    ax.set_title(_TITLES.get(quantity.name) or symbol(quantity.name), fontsize=7.0)
    half = 1.7 * float(max(high.max(), abs(found).max() / 1.4))
    ax.set_ylim(min(-half, ax.get_ylim()[0]), max(half, ax.get_ylim()[1]))
    text = f"p = {short(quantity.p)}" + (" !" if alarm else "")
    style.note(ax, text, color=style.VERMILION if alarm else style.BLACK)
    ax.set_xlim(0.0, 1.0)
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    ax.xaxis.set_tick_params(labelbottom=True)
    return {"95 % simultaneous band if calibrated": expected, "observed": line}


def coverage_figure(score: SbcScore) -> Figure:
    """Draw how often predictive bands covered simulated held-out measurements, by model."""
    levels = np.array([c.level for c in score.models[0].coverage])
    with style.style():
        figure, axes = style.panels(1, 1, height=62.0, width=120.0, bottom=20.0, top=4.0)
        ax = axes[0, 0]
        handles: dict[str, Any] = {}
        for i, model in enumerate(score.models):
            marker, colour = style.MARKERS[i % 6], style.CYCLE[i % 6]
            at = np.arange(levels.size) + 0.13 * (i - 0.5 * (len(score.models) - 1))
            value = 100.0 * np.array([c.proportion for c in model.coverage])
            ends = 100.0 * np.array([c.interval for c in model.coverage]).T
            bars = [value - ends[0], ends[1] - value]
            look: Any = {"color": colour, "mfc": "white" if i % 2 else colour, "ms": 3.5, "lw": 1.0}
            handles[model.model] = ax.errorbar(at, value, bars, fmt=marker, **look)
        claimed: Any = {"color": style.BLACK, "ls": style.DASHES[1], "lw": 0.8}
        for j, level in enumerate(levels):
            (line,) = ax.plot([j - 0.45, j + 0.45], [100.0 * level] * 2, **claimed)
            handles["claimed"] = line
        ax.set_xticks(range(levels.size), [f"{100 * level:g} % band" for level in levels])
        ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:.0f}"))
        ax.set_ylabel("Covered (% of held-out measurements)")
        style.legend_below(figure, handles, 3)
    return figure


def verdict(score: SbcScore) -> str:
    """Say in one sentence what a run found."""
    n = len(score.adjusted)
    alarms = [f"{name} of {model} (p = {short(p)})" for (model, name), p in score.alarms.items()]
    if alarms:
        return (
            f"MISCALIBRATED: {'; '.join(alarms)}, adjusted for all {n} quantities and bands of "
            "this run."
        )
    least = min(score.adjusted.values())
    return (
        f"No miscalibration found: of {n} quantities and bands the least adjusted p value is "
        f"{short(least)} (an alarm is below {LEVEL:g})."
    )


def render(score: SbcScore, images: Mapping[str, str], command: Sequence[str]) -> str:
    """Render the page of a run; data URIs of its figures by model, and ``coverage``."""
    return template("sbc.html.j2").render(
        verdict=verdict(score),
        score=score,
        known=MODELS,
        worst={m.model: min(m.quantities, key=lambda q: q.p) for m in score.models},
        rows=[_row(m) for m in score.models],
        head=_HEAD,
        images=images,
        command=shlex.join(command),
    )


_HEAD = ["Model", "Campaigns", "Not converged", "Extended", "Least p of a quantity, adjusted"]
_HEAD += ["50 % band covers", "90 %", "95 %"]


def _row(m: ModelScore) -> list[str]:
    covered = [
        f"{100 * c.proportion:.1f} ± {100 * c.se:.1f} %" if c.replicates else "none"
        for c in m.coverage
    ]
    failed = f" ({len(m.failed)} failed)" if m.failed else ""
    least = min(1.0, min(q.p for q in m.quantities) * len(m.quantities))
    ended = f"{m.replicates}{failed}", str(m.unconverged), str(m.extended)
    return [m.model, *ended, short(least), *covered]


def text_table(score: SbcScore) -> str:
    """Lay a run out as text."""
    return "\n".join([*aligned([_HEAD, *(_row(m) for m in score.models)]), verdict(score)])


def document(score: SbcScore, settings: dict[str, Any]) -> dict[str, Any]:
    """Return every number of a run as plain dictionaries."""
    adjusted = score.adjusted
    return {
        "schema": "calib/sbc/1",
        "seed": score.seed,
        "simulations": score.simulations,
        "settings": settings,
        "alarms": [f"{model}: {name}" for model, name in score.alarms],
        "models": {m.model: finite(_model(m, adjusted)) for m in score.models},
    }


def _model(m: ModelScore, adjusted: dict[tuple[str, str], float]) -> dict[str, Any]:
    return {
        "design": m.design,
        "replicates": m.replicates,
        "failed": dict(m.failed),
        "not_converged": m.unconverged,
        "extended": m.extended,
        "prior_draws": m.attempts,
        "held_out_without_band": m.no_band,
        "coverage": {
            f"{100 * c.level:g}": {
                "proportion": c.proportion,
                "standard_error": c.se,
                "interval": c.interval,
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
