"""The report's sections on the paper: where its own models miss, and the audit of its tables."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from calib.gap.files import write_diagnosis
from calib.he2019 import declared
from calib.he2019.audit import (
    Audit,
    Quantity,
    Seeds,
    Verdict,
    audit_csv,
    audit_document,
    audit_json,
    run_audit,
)
from calib.he2019.gaps import (
    FoundGap,
    PaperGap,
    checks,
    diagnose_gaps,
    paper_gaps,
    probability_of,
    summarise_gaps,
)
from calib.he2019.published import DOI
from calib.models import get_model
from calib.report.gap_words import gap_verdict, short_name
from calib.report.labels import MINUS, odds_text, percent, percent_range, unbroken
from calib.report.markup import unit_html
from calib.report.numbers import NOTHING, format_number
from calib.report.page.diagnosis import TONE_MARKS, render_page
from calib.report.page.template import picture, sentences, template
from calib.report.sections import Section, Target
from calib.report.study import Progress, Study

if TYPE_CHECKING:
    from calib.report.figures.style import Plate

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
    (folder / "audit.csv").write_text(audit_csv(audit_document(audit)), encoding="utf-8")
    plates = audit_plates(audit)
    images = {p.name: png(p) for p in plates if p.figure is not None}
    (folder / "figures").mkdir(exist_ok=True)
    for name, image in images.items():
        (folder / "figures" / f"{name}.png").write_bytes(image)
    return audit_section(audit, plates, images)


def write_audit_page(audit: Audit, folder: Path, command: Sequence[str]) -> None:
    """Write what `write_audit` does, and ``index.html``, into an existing folder."""
    page = template("audit_page.html.j2", "calib.he2019").render(
        title="Audit of the published tables: He, Sandu & Osorio (2019)", seed=audit.seed,
        section=Markup(write_audit(audit, folder)), doi=DOI, command=shlex.join(command),
    )  # fmt: skip
    (folder / "index.html").write_text(page, encoding="utf-8")


def audit_section(audit: Audit, plates: Sequence[Plate], images: Mapping[str, bytes]) -> str:
    """Render verdicts, evidence and figures; images are PNG files by the name of their plate."""
    figures = [
        picture(p, images.get(p.name, b""), _text(p.caption)) | {"name": p.name.replace("_", "-")}
        for p in plates
    ]
    return template("audit.html.j2", "calib.he2019").render(
        audit=audit, marks=AUDIT_MARKS, text=_text, quantity=_quantity, figures=figures,
        nothing=NOTHING,
    )  # fmt: skip


def _text(text: str) -> str:
    """Write minus signs and powers as a reader expects them."""
    signed = re.sub(r"(?<![\w.])-(?=[\d.,)])", MINUS, text)
    return unbroken(re.sub(r"(kN|psi|R|g/cm)\^([23])", lambda m: m[1] + "²³"[m[2] == "3"], signed))


def _quantity(q: Quantity) -> dict[str, Any]:
    unit = "" if q.unit == "1" else Markup(" {}").format(unit_html(q.unit))
    value, low, high = (format_number(v, 4) for v in (q.value, q.lower, q.upper))
    interval = NOTHING if math.isnan(q.lower) else f"{low} to {high}" if low != high else low
    # The unit stands beside the value, or beside the interval where there is nothing else.
    if math.isnan(q.value):
        value = NOTHING
        interval = Markup("{}{}").format(interval, unit) if interval != NOTHING else interval
    else:
        value = Markup("{}{}").format(value, unit)
    return {
        "name": _text(q.name), "value": value, "interval": interval, "kind": q.interval or NOTHING,
        "published": _text(q.published) or NOTHING,
    }  # fmt: skip


_CHECKS, _said = declared("checks.toml"), sentences(odds=odds_text)


def check_text(name: str, values: Mapping[str, float]) -> tuple[str, str]:
    """Return the heading of a check and what it found."""
    words = _CHECKS.get(name)
    if words is not None:
        # Numbers that not every check of a kind has.
        absent = dict.fromkeys(("rmse_before_mm", "rmse_after_mm", "largest_relative_after"), 0.0)
        return words["heading"], _said(words["text"], **{**absent, **values})
    # The same question asked otherwise: the probabilities.
    named = ((k.removeprefix("probability_"), p) for k, p in values.items() if k != "rows")
    listed = ", ".join(f"{short_name(name)} {odds_text(p)}" for name, p in named)
    return name.replace("_", " ").capitalize(), f"{values['rows']:.0f} field rows: {listed}"


def _write_gap(
    result: FoundGap, folder: Path, versions: Mapping[str, str], pdf: bool
) -> Mapping[str, Any]:
    """Write figure and page of a gap, and return what the template shows of it."""
    # Late: where the figures are drawn, which as a rule is another process.
    from calib.he2019.figures import gap_plate
    from calib.report.figures.gap import gap_plates
    from calib.report.figures.style import marked, pdf_bytes, png

    (plate,) = marked([gap_plate(result)], result.document.label)
    image = png(plate)
    file = folder / "figures" / f"gap_{plate.name}.png"
    file.write_bytes(image)
    if pdf and plate.figure is not None:
        file.with_suffix(".pdf").write_bytes(pdf_bytes(plate.figure))
    inner = folder / "gaps" / result.gap.name
    inner.mkdir(parents=True)
    document = replace(result.document, versions=dict(versions))
    write_diagnosis(result.found, inner, document)
    drawn = gap_plates(document)
    images = {p.name: png(p) for p in drawn if p.figure is not None}
    (inner / "index.html").write_text(render_page(document, drawn, images), encoding="utf-8")
    return gap_block(result, plate, image)


def gap_block(result: FoundGap, plate: Plate, image: bytes) -> Mapping[str, Any]:
    """Return what ``gaps.html.j2`` shows of a gap."""
    gap, found = result.gap, result.found
    verdict, ranking, case = gap_verdict(result.document), found.ranking, found.data.case
    best, shrink = ranking.order[0], found.shrink.get(result.output)
    return {
        "gap": gap, "model": get_model(case.models[result.output]).title,
        "rows": (len(case.lab), len(case.field)),
        "verdict": verdict, "mark": TONE_MARKS[verdict.tone],
        "facts": [fact for fact in verdict.facts if fact[0] not in ("Next", "Then")],
        "withheld": gap.withheld and short_name(gap.withheld),
        "named": best == gap.withheld and found.verdict == "effect",
        "withheld_probability": gap.withheld and probability_of(found, gap.withheld),
        "best": short_name(best), "probability": ranking.probability[best],
        "shrink": shrink and f"{percent(shrink.fraction)} ({percent_range(shrink.interval)})",
        "checks": [check_text(*check) for check in checks(result).items()],
        "picture": picture(plate, image, plate.caption),
    }  # fmt: skip


# The sections, as the report asks for them


@dataclass(frozen=True)
class GapsSection(Section[tuple[FoundGap, ...]]):
    """The paper's own gaps, to be diagnosed."""

    gaps: Sequence[PaperGap] = field(default_factory=paper_gaps)
    name, anchor, badge = "paper_gaps", "paper-gaps", "reconstructed data"
    heading = "Tests of gaps in the paper's models"

    @classmethod
    def again(cls, record: Any) -> GapsSection:
        """Return the section of a manifest's record; raise ValueError if it is none."""
        known = {gap.name: gap for gap in paper_gaps()}
        if not isinstance(record, dict):
            raise ValueError("not a table of gaps by name")
        if strange := sorted(set(record) - set(known)):
            raise ValueError(f"{strange[0]!r} is not one of {', '.join(known)}")
        return cls(tuple(gap for name, gap in known.items() if name in record))

    def work_out(self, study: Study, pool: Executor, tell: Progress) -> tuple[FoundGap, ...]:
        """Diagnose the gaps."""
        return diagnose_gaps(study.seed, self.gaps, pool, tell)

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

    @classmethod
    def again(cls, record: Any) -> AuditSection:
        """Return the section of a manifest's record; raise ValueError if it is none."""
        seeds, names = record.get("seeds") if isinstance(record, dict) else None, asdict(Seeds())
        if not isinstance(seeds, dict) or set(seeds) != set(names):
            raise ValueError(f"seeds: not {', '.join(sorted(names))}")
        wrong = [name for name, n in seeds.items() if not (isinstance(n, int) and 1 <= n <= 1000)]
        if wrong:
            raise ValueError(f"seeds: {', '.join(wrong)}: not a whole number from 1 to 1000")
        return cls(Seeds(**seeds))

    @staticmethod
    def derived(folder: Path, files: Mapping[str, str]) -> dict[str, str]:
        """Return the table of findings, which follows from the audit's document."""
        if "audit.json" not in files or not (folder / "audit.json").is_file():
            return {}
        return {"audit.csv": audit_csv(json.loads((folder / "audit.json").read_bytes()))}

    def work_out(self, study: Study, pool: Executor, tell: Progress) -> Audit:
        """Audit the tables, with the study's calibration of rut depth if it has one."""
        rut = study.successes.get("rut_depth")
        return run_audit(
            study.seed, seeds=self.seeds, rut_calibration=None if rut is None else rut.calibration,
            progress=tell, pool=pool,
        )  # fmt: skip

    def record(self, part: Audit) -> dict[str, Any]:
        """Return its seed, and how often searches were repeated."""
        return {"seed": part.seed, "seeds": asdict(part.seeds)}

    def view(self, part: Audit, to: Target) -> str:
        """Write numbers and figures, and render the section."""
        return to.pool.submit(write_audit, part, to.folder).result()
