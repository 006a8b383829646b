"""The report's sections on the paper: where its own models miss, and the audit of its tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from calib.batch.pool import Pool
from calib.he2019.audit.convergence import Seeds
from calib.he2019.audit.run import Audit, begin_audit
from calib.he2019.gaps.cases import PaperGap, paper_gaps
from calib.he2019.gaps.find import FoundGap, begin_gaps, summarise_gaps
from calib.he2019.page import begin_gaps_section, write_audit
from calib.report.sections import Written
from calib.report.study import Progress, Study


@dataclass(frozen=True)
class GapsSection:
    """The paper's own gaps, to be diagnosed."""

    gaps: Sequence[PaperGap] = field(default_factory=paper_gaps)

    def begin(self, seed: int, pool: Pool) -> Callable[[Study, Progress], FoundGaps]:
        """Ask for the diagnoses."""
        finish = begin_gaps(seed, self.gaps, pool)
        return lambda study, tell: FoundGaps(finish(tell))


@dataclass(frozen=True)
class FoundGaps:
    """The paper's own gaps, diagnosed."""

    results: tuple[FoundGap, ...]
    name: str = "paper_gaps"

    def summary(self) -> dict[str, Any]:
        """Return the numbers by the gaps' names."""
        return summarise_gaps(self.results)

    def record(self) -> dict[str, Any]:
        """Return the seeds by the gaps' names."""
        return {r.gap.name: {"seed": r.found.seed} for r in self.results}

    def begin(
        self, folder: Path, *, versions: Mapping[str, str], pdf: bool, pool: Pool
    ) -> Callable[[Progress], Written]:
        """Ask for figures and pages."""
        finish = begin_gaps_section(self.results, folder, versions=versions, pdf=pdf, pool=pool)
        return lambda tell: Written(
            "paper-gaps", "Where the paper's own models miss", "reconstructed data", finish(tell)
        )


@dataclass(frozen=True)
class AuditSection:
    """The audit of the published tables, each search repeated over so many seeds."""

    seeds: Seeds = field(default_factory=Seeds)

    def begin(self, seed: int, pool: Pool) -> Callable[[Study, Progress], FoundAudit]:
        """Ask for what takes long."""
        begun = begin_audit(seed, self.seeds, pool)

        def finish(study: Study, tell: Progress) -> FoundAudit:
            rut = study.successes.get("rut_depth")
            return FoundAudit(begun(None if rut is None else rut.calibration, tell))

        return finish


@dataclass(frozen=True)
class FoundAudit:
    """The audit, to be written."""

    audit: Audit
    name: str = "audit"

    def summary(self) -> None:
        """Return nothing: its numbers are in files of their own."""

    def record(self) -> dict[str, Any]:
        """Return its seed, and how often searches were repeated."""
        return {"seed": self.audit.seed, "seeds": asdict(self.audit.seeds)}

    def begin(
        self, folder: Path, *, versions: Mapping[str, str], pdf: bool, pool: Pool
    ) -> Callable[[Progress], Written]:
        """Ask for the files and the piece of the page."""
        piece = pool.submit(write_audit, self.audit, folder)
        return lambda tell: Written("audit", "Audit of the published tables", "", piece.result())
