"""What simulation-based calibration leaves: `sbc.json` with all ranks, figures and a page."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from calib.batch.folders import write_whole
from calib.models import MODELS
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    GREY,
    MARKERS,
    SKY,
    VERMILION,
    legend_below,
    note,
    panels,
    png_bytes,
    style,
)
from calib.report.labels import MINUS, aligned, short, symbol
from calib.report.numbers import finite
from calib.report.page.template import data_uri, template
from calib.validation.constants import LEVEL
from calib.validation.sbc import ModelScore, Quantity, SbcScore, ecdf_band

SCHEMA = "calib/sbc/1"
_TITLES: Mapping[str, str] = {
    "log_likelihood": "log likelihood",
    "prediction": "held-out mean",
    "measurement": "held-out reading",
}


def ranks_figure(model: ModelScore, adjusted: Mapping[tuple[str, str], float]) -> Figure:
    """Draw for each quantity the ECDF of its transforms less the uniform one, with its band.

    Parameters
    ----------
    adjusted : mapping
        Adjusted p values of the run, by model and quantity.
    """
    n = len(model.quantities)
    cols = 6 if n > 12 else min(5, n)
    rows = -(-n // cols)
    with style():
        figure, axes = panels(
            rows, cols, height=22.0, left=17.0, right=4.0, top=6.0, bottom=18.0, gap_x=4.0,
            gap_y=10.0, sharex=True, sharey=True,
        )  # fmt: skip
        handles: dict[str, Any] = {}
        for ax, quantity in zip(axes.flat, model.quantities, strict=False):
            handles = _panel(ax, quantity, alarm=adjusted[model.model, quantity.name] < LEVEL)
        for ax in axes.flat[n:]:
            ax.set_visible(False)
        for row in axes:
            row[0].set_ylabel(f"ECDF {MINUS} PIT")
        height = figure.get_size_inches()[1] * 25.4
        what = "probability integral transform (PIT) of the truth"
        figure.supxlabel(what, fontsize=8, y=8.0 / height)
        legend_below(figure, handles, 3)
    return figure


def _panel(ax: Axes, quantity: Quantity, *, alarm: bool) -> dict[str, Any]:
    band = ecdf_band(quantity.pit, 0.95)
    label = "95 % simultaneous band if calibrated"
    colour = VERMILION if alarm else BLUE
    handles: dict[str, Any] = {
        label: ax.fill_between(
            band.x, band.lower - band.x, band.upper - band.x, step="post", color=SKY, alpha=0.3,
            lw=0.0,
        ),
    }  # fmt: skip
    (handles["observed"],) = ax.step(band.x, band.ecdf - band.x, where="post", color=colour, lw=1.0)
    ax.axhline(0.0, color=GREY, lw=0.5)
    ax.set_title(_TITLES.get(quantity.name) or symbol(quantity.name), fontsize=7.0)
    half = 1.7 * float(max((band.upper - band.x).max(), abs(band.ecdf - band.x).max() / 1.4))
    ax.set_ylim(min(-half, ax.get_ylim()[0]), max(half, ax.get_ylim()[1]))
    words = f"p = {short(quantity.p)}" + (" !" if alarm else "")
    note(ax, words, color=VERMILION if alarm else BLACK)
    ax.set_xlim(0.0, 1.0)
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    ax.xaxis.set_tick_params(labelbottom=True)
    return handles


def coverage_figure(score: SbcScore) -> Figure:
    """Draw how often predictive bands covered simulated held-out measurements, by model."""
    with style():
        figure, axes = panels(1, 1, height=62.0, width=120.0, left=14.0, bottom=20.0, top=4.0)
        ax = axes[0, 0]
        levels = [c.level for c in score.models[0].coverage]
        handles = {}
        for i, model in enumerate(score.models):
            shift = 0.13 * (i - 0.5 * (len(score.models) - 1))
            at = [j + shift for j in range(len(levels))]
            value = [100.0 * c.proportion for c in model.coverage]
            low = [100.0 * (c.proportion - c.interval[0]) for c in model.coverage]
            high = [100.0 * (c.interval[1] - c.proportion) for c in model.coverage]
            handles[model.model] = ax.errorbar(
                at, value, yerr=[low, high], fmt=MARKERS[i], color=CYCLE[i], ms=3.5,
                lw=1.0, mfc="white" if i % 2 else CYCLE[i],
            )  # fmt: skip
        for j, level in enumerate(levels):
            (line,) = ax.plot([j - 0.45, j + 0.45], [100.0 * level] * 2, color=BLACK, ls=DASHES[1],
                              lw=0.8)  # fmt: skip
            handles["claimed"] = line
        ax.set_xticks(range(len(levels)), [f"{100 * level:g} % band" for level in levels])
        ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:.0f}"))
        ax.set_ylabel("Covered (% of held-out measurements)")
        legend_below(figure, handles, 3)
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


_HEAD = (
    "Model", "Campaigns", "Not converged", "Extended", "Least p of a quantity, adjusted",
    "50 % band covers", "90 %", "95 %",
)  # fmt: skip


def _row(m: ModelScore) -> list[str]:
    covered = [
        f"{100 * c.proportion:.1f} ± {100 * c.se:.1f} %" if c.replicates else "none"
        for c in m.coverage
    ]
    failed = f" ({len(m.failed)} failed)" if m.failed else ""
    return [
        m.model, f"{m.replicates}{failed}", str(m.unconverged), str(m.extended),
        short(min(min(1.0, q.p * len(m.quantities)) for q in m.quantities)), *covered,
    ]  # fmt: skip


def text_table(score: SbcScore) -> str:
    """Lay a run out as text."""
    return "\n".join([*aligned([_HEAD, *(_row(m) for m in score.models)]), verdict(score)])


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
        "design": m.design,
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
