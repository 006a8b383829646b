"""The audit of the published tables: every printed figure that can be tested, and its verdict."""

from __future__ import annotations

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from typing import Any

from calib.batch.environment import one_thread
from calib.batch.pool import HERE
from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, finding
from calib.he2019.audit.searches import (
    CurvatureStudy,
    GeneticStudy,
    Seeds,
    convergence_findings,
    curvature_signs,
    study_convergence,
    study_curvature_signs,
)
from calib.he2019.audit.table5 import (
    RoundingStudy,
    cost_as_printed,
    cost_bounds,
    joint_cost,
    pressure_unit,
    rounding_findings,
    signs_of_quadratic,
    study_rounding,
)
from calib.he2019.audit.table6 import (
    InverseStudy,
    QualityStudy,
    inverse_by_likelihood,
    inverse_by_print,
    prediction_at_30,
    rut_quality_findings,
    signs_of_rut,
    study_inverse,
    study_quality,
)
from calib.he2019.audit.tables_1_to_4 import (
    density_findings,
    geometric_findings,
    sign_of_curvature,
)
from calib.he2019.published import DOI, PUBLISHED, Published
from calib.inference.calibration import Calibration
from calib.report.numbers import finite
from calib.report.study import Progress

__all__ = [
    "Audit", "Basis", "Finding", "Quantity", "Seeds", "Verdict", "audit_csv", "audit_document",
    "audit_json", "run_audit",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Audit:
    """An audit of the published figures; findings by verdict, the gravest first."""

    findings: tuple[Finding, ...]
    published: Published
    seed: int
    seeds: Seeds
    rounding: RoundingStudy
    curvature: CurvatureStudy
    quality: QualityStudy
    inverse: InverseStudy
    genetic: GeneticStudy

    @property
    def counts(self) -> dict[Verdict, int]:
        """How many findings have each verdict; verdicts in the order of `Verdict`."""
        found = Counter(f.verdict for f in self.findings)
        return {verdict: found[verdict] for verdict in Verdict if found[verdict]}

    def __getitem__(self, key: str) -> Finding:
        return next(f for f in self.findings if f.key == key)


@one_thread()
def run_audit(
    seed: int = 2019, *, published: Published = PUBLISHED, seeds: Seeds | None = None,
    rut_calibration: Calibration | None = None, progress: Progress | None = None,
    pool: Executor = HERE,
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
    pool : Executor, optional
        Where searches run; the numbers do not depend on it.

    Examples
    --------
    >>> import calib
    >>> audit = calib.run_audit()  # doctest: +SKIP
    """
    tell = progress or (lambda what, done, planned: None)
    seeds = seeds or Seeds()
    signs_asked = pool.submit(study_curvature_signs, published, seed)
    bounds_asked = pool.submit(cost_bounds, published)
    rounding_asked = pool.submit(study_rounding, published)
    genetic = study_convergence(published, seed, seeds, pool, tell)
    inverse = study_inverse(
        published, seed, calibration=rut_calibration,
        progress=lambda done, planned: tell("rut depth: sampling", done, planned),
    )  # fmt: skip
    tell("testing printed figures", 0, 1)
    curvature, rounding = signs_asked.result(), rounding_asked.result()
    quality = study_quality(published)
    tables = (*published.geometric.values(), *published.genetic.values())
    findings = [
        *density_findings(published),
        *geometric_findings(published, genetic.read_off),
        *map(sign_of_curvature, tables),
        *(signs_of_quadratic(published, what) for what in ("D", "BCD")),
        signs_of_rut(published),
        *curvature_signs(published, curvature),
        pressure_unit(published),
        joint_cost(published, genetic.joint.optimum, bounds_asked.result()),
        cost_as_printed(published),
        *rounding_findings(published, rounding),
        *convergence_findings(genetic),
        *rut_quality_findings(published, quality),
        inverse_by_print(published),
        inverse_by_likelihood(published, inverse),
        prediction_at_30(published, inverse),
        finding("test_description", Verdict.UNTESTABLE, setup=published.setup),
    ]
    tell("testing printed figures", 1, 1)
    ranked = tuple(sorted(findings, key=lambda f: list(Verdict).index(f.verdict)))
    return Audit(ranked, published, seed, seeds, rounding, curvature, quality, inverse, genetic)


def audit_document(audit: Audit) -> dict[str, Any]:
    """Return an audit as plain data; intervals that do not exist are None."""
    return {
        "schema": "calib/audit/1",
        "source": f"doi:{DOI}",
        "seed": audit.seed,
        "verdicts": {verdict.value: verdict.meaning for verdict in Verdict},
        "counts": {verdict.value: n for verdict, n in audit.counts.items()},
        "findings": [
            asdict(f) | {
                "found": [finite(asdict(q)) for q in f.found],
                "depends_on_reconstruction": f.reconstructed, "caveat": f.basis.meaning,
            }
            for f in audit.findings
        ],
    }  # fmt: skip


def audit_json(audit: Audit) -> str:
    """Return `audit_document` as JSON."""
    return json.dumps(audit_document(audit), indent=1, allow_nan=False) + "\n"


def audit_csv(content: Mapping[str, Any]) -> str:
    """Return the findings of an `audit_document` as CSV, one row for each.

    KeyError, TypeError or ValueError if it is something else.
    """
    columns = (
        "key", "verdict", "where", "claim", "test", "found", "evidence", "stays_open", "basis",
        "depends_on_reconstruction",
    )  # fmt: skip
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for entry in content["findings"]:
        found: list[dict[str, Any]] = [
            {key: math.nan if v is None else v for key, v in q.items()} for q in entry["found"]
        ]
        writer.writerow({
            **{name: entry[name] for name in columns},
            "found": "; ".join(str(Quantity(**q)) for q in found),
            "depends_on_reconstruction": "yes" if entry["depends_on_reconstruction"] else "no",
        })  # fmt: skip
    return out.getvalue()
