"""The audit of the published tables: every printed figure that can be tested, and its verdict."""

from __future__ import annotations

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, fields
from typing import Any

from calib.batch.environment import one_thread
from calib.batch.pool import HERE
from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, finding
from calib.he2019.audit.pull import (
    RoundingStudy,
    bounds,
    cost_findings,
    geometric_findings,
    pressure_unit,
    rounding_findings,
    signs_of_pull,
    study_rounding,
)
from calib.he2019.audit.regressions import (
    InverseStudy,
    QualityStudy,
    density_findings,
    inverse_findings,
    rut_quality_findings,
    signs_of_rut,
    study_inverse,
    study_quality,
)
from calib.he2019.audit.searches import (
    CurvatureStudy,
    GeneticStudy,
    Seeds,
    begin_convergence,
    convergence_findings,
    curvature_signs,
    study_curvature_signs,
)
from calib.he2019.published import DOI, PUBLISHED, Published
from calib.inference.calibration import Calibration
from calib.report.numbers import finite
from calib.report.study import Progress

__all__ = [
    "Audit", "Basis", "Finding", "Quantity", "Seeds", "Verdict", "audit_csv", "audit_json",
    "begin_audit", "read_findings", "run_audit",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Audit:
    """An audit of the published figures; findings by verdict, the gravest first."""

    findings: tuple[Finding, ...]
    published: Published
    seed: int
    rounding: RoundingStudy
    curvature: CurvatureStudy
    quality: QualityStudy
    inverse: InverseStudy
    genetic: GeneticStudy
    seeds: Seeds

    @property
    def counts(self) -> dict[Verdict, int]:
        """How many findings have each verdict; verdicts in the order of `Verdict`."""
        found = Counter(f.verdict for f in self.findings)
        return {verdict: found[verdict] for verdict in Verdict if found[verdict]}

    def __getitem__(self, key: str) -> Finding:
        return next(f for f in self.findings if f.key == key)


def run_audit(
    seed: int = 2019, *, published: Published = PUBLISHED, seeds: Seeds | None = None,
    rut_calibration: Calibration | None = None, progress: Progress | None = None,
) -> Audit:  # fmt: skip
    """Audit the published figures.

    Parameters
    ----------
    seed : int
        Same seed, same numbers.
    published : Published
        The figures to audit.
    seeds : Seeds, optional
        How often the genetic algorithm is repeated.
    rut_calibration : Calibration, optional
        Of modified_bekker on the reconstructed 18 and 42 psi rows; made here if it is not at hand.
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    """
    finish = begin_audit(seed, seeds or Seeds(), HERE, published=published)
    return finish(rut_calibration, progress or (lambda what, done, planned: None))


def begin_audit(
    seed: int, seeds: Seeds, pool: Executor, *, published: Published = PUBLISHED
) -> Callable[[Calibration | None, Progress], Audit]:
    """Ask for what takes long, the parameters as for `run_audit`; return what waits for it."""
    searches = begin_convergence(published, seed, seeds, pool)
    signs_asked = pool.submit(study_curvature_signs, published, seed)
    bounds_asked = pool.submit(bounds, published)
    rounding_asked = pool.submit(study_rounding, published)

    @one_thread()
    def finish(rut_calibration: Calibration | None, tell: Progress) -> Audit:
        inverse = study_inverse(
            published, seed, calibration=rut_calibration,
            progress=lambda done, planned: tell("rut depth: sampling", done, planned),
        )  # fmt: skip
        searched, quality = searches(tell), study_quality(published)
        tell("testing printed figures", 0, 2)
        curvature, at_most = signs_asked.result(), bounds_asked.result()
        tell("testing printed figures", 1, 2)
        rounding = rounding_asked.result()
        findings = [
            *density_findings(published),
            *geometric_findings(published, searched.read_off),
            *signs_of_pull(published),
            signs_of_rut(published),
            *curvature_signs(published, curvature),
            pressure_unit(published),
            *cost_findings(published, searched.joint.optimum, at_most),
            *rounding_findings(published, rounding),
            *convergence_findings(searched),
            *rut_quality_findings(published, quality),
            *inverse_findings(published, inverse),
            finding("test_description", Verdict.UNTESTABLE, setup=published.setup),
        ]
        tell("testing printed figures", 2, 2)
        order = list(Verdict)
        ranked = tuple(sorted(findings, key=lambda f: order.index(f.verdict)))
        studies = rounding, curvature, quality, inverse, searched
        return Audit(ranked, published, seed, *studies, seeds)

    return finish


SCHEMA = "calib/audit/1"
_COLUMNS = (
    "key", "verdict", "where", "claim", "test", "found", "evidence", "stays_open", "basis",
    "depends_on_reconstruction",
)  # fmt: skip


def audit_json(audit: Audit) -> str:
    """Return an audit as JSON; intervals that do not exist are null."""
    content = {
        "schema": SCHEMA,
        "source": f"doi:{DOI}",
        "seed": audit.seed,
        "verdicts": {verdict.value: verdict.meaning for verdict in Verdict},
        "counts": {verdict.value: n for verdict, n in audit.counts.items()},
        "findings": [
            asdict(f) | {
                "found": [finite(asdict(q)) for q in f.found],
                "depends_on_reconstruction": f.reconstructed, "caveat": f.basis.caveat,
            }
            for f in audit.findings
        ],
    }  # fmt: skip
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def read_findings(content: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings in what `audit_json` writes; else a KeyError, TypeError or ValueError."""
    return tuple(_read(entry) for entry in content["findings"])


def _read(entry: Mapping[str, Any]) -> Finding:
    known = {f.name: entry[f.name] for f in fields(Finding)}
    known["figures"] = tuple(known["figures"])
    found: list[dict[str, Any]] = [
        {key: math.nan if value is None else value for key, value in q.items()}
        for q in known["found"]
    ]
    known["found"] = tuple(Quantity(**q) for q in found)
    known["verdict"], known["basis"] = Verdict(known["verdict"]), Basis(known["basis"])
    return Finding(**known)


def audit_csv(findings: Iterable[Finding]) -> str:
    """Return findings as CSV, one row for each."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for f in findings:
        writer.writerow([
            f.key, f.verdict.value, f.where, f.claim, f.test, "; ".join(map(str, f.found)),
            f.evidence, f.stays_open, f.basis.value, "yes" if f.reconstructed else "no",
        ])  # fmt: skip
    return out.getvalue()
