"""The whole audit: every family of findings in reading order, with what its figures need."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from calib.batch.pool import HERE
from calib.batch.threads import one_thread
from calib.he2019.audit.convergence import (
    GeneticStudy,
    Seeds,
    begin_convergence,
    convergence_findings,
)
from calib.he2019.audit.curvature_signs import (
    CurvatureStudy,
    curvature_signs,
    study_curvature_signs,
)
from calib.he2019.audit.density import density_findings
from calib.he2019.audit.finding import Finding, Verdict
from calib.he2019.audit.geometric import geometric_findings
from calib.he2019.audit.inverse_findings import inverse_findings
from calib.he2019.audit.inverse_regression import InverseStudy, study_inverse
from calib.he2019.audit.pressure_unit import pressure_unit
from calib.he2019.audit.rounding import RoundingStudy, rounding_findings, study_rounding
from calib.he2019.audit.rut_quality import QualityStudy, rut_quality_findings, study_quality
from calib.he2019.audit.signs import signs
from calib.he2019.audit.table5_cost import cost_findings
from calib.he2019.audit.untested import untested
from calib.he2019.datasets.published import PUBLISHED, Published
from calib.inference.calibration import Calibration

__all__ = ["Audit", "run_audit"]

type Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Audit:
    """An audit of the published figures.

    Parameters
    ----------
    findings : tuple of Finding
        By verdict, the gravest first; within a verdict in the order of the source.
    published : Published
        What was audited.
    seed : int
    rounding : RoundingStudy
    curvature : CurvatureStudy
    quality : QualityStudy
    inverse : InverseStudy
    genetic : GeneticStudy
    seeds : Seeds
        How often each search was repeated.
    """

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


@one_thread()
def run_audit(
    seed: int = 2019,
    *,
    published: Published = PUBLISHED,
    seeds: Seeds | None = None,
    rut_calibration: Calibration | None = None,
    progress: Progress | None = None,
    genetic: Callable[[Progress], GeneticStudy] | None = None,
) -> Audit:
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
    genetic : callable, optional
        Waits for the genetic searches, which have been asked for
        (`calib.he2019.audit.convergence.begin_convergence`); they are done here by default.

    Returns
    -------
    Audit
    """
    tell = progress or (lambda what, done, planned: None)
    repeated = seeds or Seeds()
    asked = genetic or begin_convergence(published, seed, repeated, HERE)
    inverse = study_inverse(
        published, seed, calibration=rut_calibration,
        progress=lambda done, planned: tell("rut depth: sampling", done, planned),
    )  # fmt: skip
    tell("testing printed figures", 0, 2)
    curvature = study_curvature_signs(published, seed)
    tell("testing printed figures", 1, 2)
    rounding, quality = study_rounding(published), study_quality(published)
    searched = asked(tell)
    findings = [
        *density_findings(published),
        *geometric_findings(published, searched.read_off),
        *signs(published),
        *curvature_signs(published, curvature),
        pressure_unit(published),
        *cost_findings(published, searched.joint.optimum),
        *rounding_findings(published, rounding),
        *convergence_findings(published, searched),
        *rut_quality_findings(published, quality),
        *inverse_findings(published, inverse),
        untested(published),
    ]
    tell("testing printed figures", 2, 2)
    order = list(Verdict)
    ranked = sorted(findings, key=lambda f: order.index(f.verdict))
    return Audit(
        tuple(ranked), published, seed, rounding, curvature, quality, inverse, searched, repeated
    )
