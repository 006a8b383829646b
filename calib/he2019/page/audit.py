"""The audit as a section of the report, and as a page of its own."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from calib.he2019.audit import Audit, Finding, Quantity, Verdict
from calib.he2019.audit.run import audit_csv, audit_json
from calib.he2019.datasets.published import DOI
from calib.report.figures.plate import Plate
from calib.report.labels import unbroken
from calib.report.numbers import NOTHING, format_number
from calib.report.page.template import picture, template, unit_html

_TITLE = "Audit of the published tables: He, Sandu & Osorio (2019)"
_MINUS = "\N{MINUS SIGN}"
_DIGITS = 4

# A shape beside every word.
AUDIT_MARKS: Mapping[Verdict, str] = {
    Verdict.CONTRADICTED: "\N{HEAVY BALLOT X}",
    Verdict.CORRECTED: "\N{BLACK UP-POINTING TRIANGLE}",
    Verdict.CONFIRMED: "\N{HEAVY CHECK MARK}",
    Verdict.CONSISTENT: "\N{WHITE CIRCLE}",
    Verdict.UNTESTABLE: "?",
}


def write_audit(audit: Audit, folder: Path) -> str:
    """Write an audit's numbers and figures into an existing folder, and return its section as HTML.

    The folder gets ``audit.json``, ``audit.csv`` and ``figures/audit_*.png``.
    """
    # Late: where the figures are drawn, which as a rule is another process.
    from calib.he2019.figures.audit import audit_plates
    from calib.report.figures.style import png

    (folder / "audit.json").write_text(audit_json(audit), encoding="utf-8")
    (folder / "audit.csv").write_text(audit_csv(audit.findings), encoding="utf-8")
    plates = audit_plates(audit)
    images = {p.name: png(p) for p in plates if p.figure is not None}
    (folder / "figures").mkdir(exist_ok=True)
    for name, image in images.items():
        (folder / "figures" / f"{name}.png").write_bytes(image)
    return audit_section(audit, plates, images)


def write_audit_page(audit: Audit, folder: Path, command: Sequence[str]) -> None:
    """Write what `write_audit` does, and ``index.html``, into an existing folder."""
    page = template("audit_page.html.j2", "calib.he2019.page").render(
        title=_TITLE,
        section=Markup(write_audit(audit, folder)),
        seed=audit.seed,
        doi=DOI,
        command=shlex.join(command),
    )
    (folder / "index.html").write_text(page, encoding="utf-8")


def audit_section(audit: Audit, plates: Sequence[Plate], images: Mapping[str, bytes]) -> str:
    """Render the section: verdicts first, then the evidence of each, then the figures.

    Images are PNG files by the name of their plate.
    """
    groups = [
        {
            "id": verdict.name.lower(),
            "verdict": verdict.value,
            "mark": AUDIT_MARKS[verdict],
            "rows": [_row(f) for f in audit.findings if f.verdict is verdict],
        }
        for verdict in audit.counts
    ]
    counts = [
        {"verdict": v.value, "meaning": v.meaning, "mark": AUDIT_MARKS[v], "n": n}
        for v, n in audit.counts.items()
    ]
    return template("audit.html.j2", "calib.he2019.page").render(
        counts=counts,
        groups=groups,
        free=sum(not f.reconstructed for f in audit.findings),
        total=len(audit.findings),
        figures=[
            picture(p, images.get(p.name, b""), _text(p.caption))
            | {"name": p.name.replace("_", "-")}
            for p in plates
        ],
    )


def _text(text: str) -> str:
    """Write minus signs and powers as a reader expects them."""
    signed = re.sub(r"(?<![\w.])-(?=[\d.,)])", _MINUS, text)
    return unbroken(
        signed.replace("kN^2", "kN²")
        .replace("psi^2", "psi²")
        .replace("R^2", "R²")
        .replace("g/cm^3", "g/cm³")
    )


def _row(finding: Finding) -> dict[str, Any]:
    return {
        "key": finding.key,
        "where": finding.where,
        "claim": _text(finding.claim),
        "test": _text(finding.test[0].upper() + finding.test[1:]),
        "evidence": _text(finding.evidence),
        "stays_open": _text(finding.stays_open) or NOTHING,
        "basis": finding.basis.value,
        "caveat": finding.basis.caveat,
        "reconstructed": finding.reconstructed,
        "found": [_quantity(q) for q in finding.found],
    }


def _quantity(q: Quantity) -> dict[str, Any]:
    unit = "" if q.unit == "1" else Markup(" {}").format(unit_html(q.unit))

    def shown(value: float) -> Any:
        return Markup("{}{}").format(format_number(value, _DIGITS), unit)

    interval = NOTHING
    if not math.isnan(q.lower):
        low, high = (format_number(v, _DIGITS) for v in (q.lower, q.upper))
        interval = f"{low} to {high}" if low != high else low
        if math.isnan(q.value):
            interval = Markup("{}{}").format(interval, unit)
    return {
        "name": _text(q.name),
        "value": NOTHING if math.isnan(q.value) else shown(q.value),
        "interval": interval,
        "kind": q.interval or NOTHING,
        "published": _text(q.published) or NOTHING,
    }
