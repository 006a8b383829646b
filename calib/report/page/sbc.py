"""The page of a run, and the table for the terminal: worded and rounded here."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from calib.models import get_model
from calib.report.labels import short
from calib.report.page.template import template
from calib.validation.sbc.designs import design_of
from calib.validation.sbc.score import LEVEL, ModelScore, SbcScore


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
        fine=not score.alarms,
        seed=score.seed,
        simulations=score.simulations,
        models=[_section(m, score, images) for m in score.models],
        rows=[_row(m) for m in score.models],
        head=_HEAD,
        coverage=images["coverage"],
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


def _section(m: ModelScore, score: SbcScore, images: Mapping[str, str]) -> dict[str, Any]:
    worst = min(m.quantities, key=lambda q: q.p)
    return {
        "name": m.model,
        "title": get_model(m.model).title,
        "design": design_of(m.model).text,
        "image": images[m.model],
        "replicates": m.replicates,
        "unconverged": m.unconverged,
        "extended": m.extended,
        "redrawn": m.attempts - m.replicates,
        "no_band": m.no_band,
        "failed": dict(m.failed),
        "quantities": len(m.quantities),
        "worst": worst.name,
        "worst_p": short(worst.p),
        "worst_all": short(min(q.p_all for q in m.quantities)),
        "alarms": [name for model, name in score.alarms if model == m.model],
    }


def text_table(score: SbcScore) -> str:
    """Lay a run out as text."""
    rows = [list(_HEAD), *(_row(m) for m in score.models)]
    widths = [max(len(row[j]) for row in rows) for j in range(len(_HEAD))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows]
    return "\n".join([*(line.rstrip() for line in lines), verdict(score)])
