"""The report's sections on the paper: where its own models miss, and the audit of its tables."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup

from calib.gap.files import write_diagnosis
from calib.he2019 import declared
from calib.he2019.audit import (
    Audit,
    Finding,
    Quantity,
    Seeds,
    Verdict,
    audit_csv,
    audit_json,
    begin_audit,
)
from calib.he2019.gaps import (
    Check,
    FoundGap,
    PaperGap,
    begin_gaps,
    checks,
    paper_gaps,
    probability_of,
    summarise_gaps,
)
from calib.he2019.published import DOI
from calib.models import get_model
from calib.report.figures.plate import Plate
from calib.report.gap_words import gap_verdict, short_name
from calib.report.labels import odds_text, percent, percent_range, unbroken
from calib.report.markup import unit_html
from calib.report.numbers import NOTHING, format_number
from calib.report.page.diagnosis import TONE_MARKS, render_page
from calib.report.page.template import data_uri, picture, png_size, sentences, template
from calib.report.sections import Section, Target
from calib.report.study import Progress, Study

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
    from calib.he2019.figures import audit_plates
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
    page = template("audit_page.html.j2", "calib.he2019").render(
        title=_TITLE, section=Markup(write_audit(audit, folder)), seed=audit.seed, doi=DOI,
        command=shlex.join(command),
    )  # fmt: skip
    (folder / "index.html").write_text(page, encoding="utf-8")


def audit_section(audit: Audit, plates: Sequence[Plate], images: Mapping[str, bytes]) -> str:
    """Render verdicts, evidence and figures; images are PNG files by the name of their plate."""
    groups = [
        {
            "id": verdict.name.lower(), "verdict": verdict.value, "mark": AUDIT_MARKS[verdict],
            "meaning": verdict.meaning, "n": n,
            "rows": [_row(f) for f in audit.findings if f.verdict is verdict],
        }
        for verdict, n in audit.counts.items()
    ]  # fmt: skip
    figures = [
        picture(p, images.get(p.name, b""), _text(p.caption)) | {"name": p.name.replace("_", "-")}
        for p in plates
    ]
    return template("audit.html.j2", "calib.he2019").render(
        groups=groups, figures=figures, total=len(audit.findings),
        free=sum(not f.reconstructed for f in audit.findings),
    )  # fmt: skip


def _text(text: str) -> str:
    """Write minus signs and powers as a reader expects them."""
    signed = re.sub(r"(?<![\w.])-(?=[\d.,)])", _MINUS, text)
    return unbroken(re.sub(r"(kN|psi|R|g/cm)\^([23])", lambda m: m[1] + "²³"[m[2] == "3"], signed))


def _row(finding: Finding) -> dict[str, Any]:
    return {
        "key": finding.key, "where": finding.where, "claim": _text(finding.claim),
        "test": _text(_upper(finding.test)), "evidence": _text(finding.evidence),
        "stays_open": _text(finding.stays_open) or NOTHING, "basis": finding.basis.value,
        "caveat": finding.basis.caveat, "reconstructed": finding.reconstructed,
        "found": [_quantity(q) for q in finding.found],
    }  # fmt: skip


def _quantity(q: Quantity) -> dict[str, Any]:
    unit = "" if q.unit == "1" else Markup(" {}").format(unit_html(q.unit))

    def shown(text: str) -> Any:
        return Markup("{}{}").format(text, unit)

    interval = NOTHING
    if not math.isnan(q.lower):
        low, high = (format_number(v, _DIGITS) for v in (q.lower, q.upper))
        interval = f"{low} to {high}" if low != high else low
        if math.isnan(q.value):
            interval = shown(interval)
    return {
        "name": _text(q.name), "interval": interval, "kind": q.interval or NOTHING,
        "value": NOTHING if math.isnan(q.value) else shown(format_number(q.value, _DIGITS)),
        "published": _text(q.published) or NOTHING,
    }  # fmt: skip


_CHECKS = declared("checks.toml")
# Numbers that not every check of a kind has.
_ABSENT = dict.fromkeys(("rmse_before_mm", "rmse_after_mm", "largest_relative_after"), 0.0)
_said = sentences(odds=odds_text)


def check_text(check: Check) -> tuple[str, str]:
    """Return the heading of a check and what it found."""
    words = _CHECKS.get(check.name)
    if words is not None:
        return words["heading"], _said(words["text"], **{**_ABSENT, **check.values})
    # The same question asked otherwise: the probabilities.
    named = ((k.removeprefix("probability_"), p) for k, p in check.values.items() if k != "rows")
    listed = ", ".join(f"{short_name(name)} {odds_text(p)}" for name, p in named)
    heading = check.name.replace("_", " ").capitalize()
    return heading, f"{check.values['rows']:.0f} field rows: {listed}"


def _write_gap(
    result: FoundGap, folder: Path, versions: Mapping[str, str], pdf: bool
) -> dict[str, Any]:
    # Late: where the figures are drawn, which as a rule is another process.
    from calib.he2019.figures import gap_plate
    from calib.report.figures.gap import gap_plates
    from calib.report.figures.style import pdf_bytes, png

    plate = gap_plate(result)
    image = png(plate)
    (folder / "figures" / f"gap_{plate.name}.png").write_bytes(image)
    if pdf and plate.figure is not None:
        file = folder / "figures" / f"gap_{plate.name}.pdf"
        file.write_bytes(pdf_bytes(plate.figure))
    inner = folder / "gaps" / result.gap.name
    inner.mkdir(parents=True)
    document = replace(result.document, versions=dict(versions))
    write_diagnosis(result.found, inner, document)
    drawn = gap_plates(document)
    images = {p.name: png(p) for p in drawn if p.figure is not None}
    (inner / "index.html").write_text(render_page(document, drawn, images), encoding="utf-8")
    return _block(result, plate, image)


def _block(result: FoundGap, plate: Plate, image: bytes) -> dict[str, Any]:
    gap, found = result.gap, result.found
    verdict, ranking, case = gap_verdict(result.document), found.ranking, found.data.case
    best = ranking.order[0]
    s = found.shrink.get(result.output)
    return {
        "name": gap.name, "title": gap.title, "question": gap.question, "limits": gap.limits,
        "rows": [
            ("Model", get_model(case.models[result.output]).title),
            ("Calibration", f"{_upper(gap.lab_rows)}: {len(case.lab)} rows"),
            ("Field", f"{_upper(gap.field_rows)}: {len(case.field)} rows"),
        ],
        "tone": verdict.tone.value, "mark": TONE_MARKS[verdict.tone], "state": verdict.state,
        "headline": verdict.headline,
        "facts": [fact for fact in verdict.facts if fact[0] not in ("Next", "Then")],
        "withheld": _withheld(result),
        "best": f"{short_name(best)} ({odds_text(ranking.probability[best])})",
        "shrink": f"{percent(s.fraction)} ({percent_range(s.interval)})" if s
        else "no gap that could shrink",
        "checks": [check_text(check) for check in checks(result)],
        "page": f"gaps/{gap.name}/index.html", "caption": plate.caption, "uri": data_uri(image),
        "size": png_size(image),
    }  # fmt: skip


def _upper(text: str) -> str:
    return text[0].upper() + text[1:]


def _withheld(result: FoundGap) -> str:
    """Say whether the effect that was withheld is the one that was found."""
    effect = result.gap.withheld
    if effect is None:
        return ""
    ranking = result.found.ranking
    words = short_name(effect)
    if ranking.order[0] == effect and result.found.verdict == "effect":
        return f"The effect that was withheld, {words}, is the one that is named."
    p = odds_text(probability_of(result.found, effect))
    return (
        f"The effect that was withheld, {words}, is not the one that is named: its probability, "
        f"alone or with another, is {p}."
    )


# The sections, as the report asks for them


@dataclass(frozen=True)
class GapsSection(Section[tuple[FoundGap, ...]]):
    """The paper's own gaps, to be diagnosed."""

    gaps: Sequence[PaperGap] = field(default_factory=paper_gaps)
    name, anchor, badge = "paper_gaps", "paper-gaps", "reconstructed data"
    heading = "Where the paper's own models miss"

    def work_out(self, study: Study, pool: Executor, tell: Progress) -> tuple[FoundGap, ...]:
        """Diagnose the gaps."""
        return begin_gaps(study.seed, self.gaps, pool)(tell)

    def summary(self, part: tuple[FoundGap, ...]) -> dict[str, Any]:
        """Return the numbers by the gaps' names."""
        return summarise_gaps(part)

    def record(self, part: tuple[FoundGap, ...]) -> dict[str, Any]:
        """Return the seeds by the gaps' names."""
        return {r.gap.name: {"seed": r.found.seed} for r in part}

    def view(self, part: tuple[FoundGap, ...], to: Target) -> str:
        """Write figures and pages of the gaps, and render the section.

        The folder gets ``figures/gap_NAME.png``, as PDF too if asked, and ``gaps/NAME/``, each what
        `calib diagnose` writes, its figures inside the page only.
        """
        pieces = [to.pool.submit(_write_gap, r, to.folder, to.versions, to.pdf) for r in part]
        blocks = []
        for i, piece in enumerate(pieces):
            to.tell("the paper's own gaps: drawing", i, len(pieces))
            blocks.append(piece.result())
        to.tell("the paper's own gaps: drawing", len(pieces), len(pieces))
        return template("gaps.html.j2", "calib.he2019").render(gaps=blocks)


@dataclass(frozen=True)
class AuditSection(Section[Audit]):
    """The audit of the published tables, each search repeated over so many seeds."""

    seeds: Seeds = field(default_factory=Seeds)
    name, anchor, heading = "audit", "audit", "Audit of the published tables"

    def work_out(self, study: Study, pool: Executor, tell: Progress) -> Audit:
        """Audit the tables, with the study's calibration of rut depth if it has one."""
        rut = study.successes.get("rut_depth")
        begun = begin_audit(study.seed, self.seeds, pool)
        return begun(None if rut is None else rut.calibration, tell)

    def record(self, part: Audit) -> dict[str, Any]:
        """Return its seed, and how often searches were repeated."""
        return {"seed": part.seed, "seeds": asdict(part.seeds)}

    def view(self, part: Audit, to: Target) -> str:
        """Write numbers and figures, and render the section."""
        return to.pool.submit(write_audit, part, to.folder).result()
