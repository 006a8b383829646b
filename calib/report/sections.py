"""What a report shows: the study, and sections beside its outputs, hung on by their packages.

A section is asked for with what it is to work out, begun where the outputs are, and writes itself:
files into the report's folder, numbers into ``summary.json``, what it takes to work it out again
into ``manifest.json``, and a piece of the page. That of emulated simulators is here, that of
compared models in `calib.report.compared`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from calib.batch.pool import HERE, Later, Pool
from calib.data.files import plain_number
from calib.data.registry import Registry
from calib.report.numbers import format_number

# Every command loads what plug-ins declare here, and few work a report out.
if TYPE_CHECKING:
    from calib.inference.sampling.sampler import SamplerSettings
    from calib.report.drawing import Drawn
    from calib.report.study import Progress, Study
    from calib.report.study_tasks import Task

type Document = Mapping[str, Any]

# So many failed runs are shown; the manifest has all.
_SHOWN = 20
# Of the intervals that an emulator is checked by.
_NOMINAL = 0.9


@dataclass(frozen=True)
class Written:
    """A section of the page; the badge beside its heading says what its data are called."""

    anchor: str
    heading: str
    badge: str
    html: str


class Found(Protocol):
    """What a section found, ready to be written."""

    @property
    def name(self) -> str:
        """Key of the section in summary and manifest."""

    def summary(self) -> dict[str, Any] | None:
        """Return what `summary.json` gets; None for nothing."""

    def record(self) -> dict[str, Any]:
        """Return what `manifest.json` gets, from which `SectionKind.again` makes the section."""

    def begin(
        self, folder: Path, *, versions: Mapping[str, str], pdf: bool, pool: Pool
    ) -> Callable[[Progress], Written]:
        """Ask for the files in a report's folder; return what waits for the piece of the page."""


class Section(Protocol):
    """What is to be worked out."""

    def begin(self, seed: int, pool: Pool) -> Callable[[Study, Progress], Found]:
        """Ask for the work; return what waits for it, given what the outputs gave."""


def _nothing(folder: Path, files: Mapping[str, str]) -> dict[str, str]:
    return {}


@dataclass(frozen=True)
class SectionKind:
    """How a reviewer works a section out again.

    Parameters
    ----------
    name : str
        Key in the manifest.
    again : callable
        ``record -> Section``; raises ValueError if the record is none.
    derived : callable
        ``(folder, files) -> {file: text}``: files that follow from others of the report.
    """

    name: str
    again: Callable[[Any], Section]
    derived: Callable[[Path, Mapping[str, str]], dict[str, str]] = _nothing

    def register(self) -> None:
        """Have reports with such a section checked."""
        SECTIONS.add(self)


@dataclass(frozen=True)
class EmulatorSection:
    """What became of the emulations, as their `Emulation.document`, by model."""

    documents: Mapping[str, Document]

    def begin(self, seed: int, pool: Pool) -> Callable[[Study, Progress], FoundEmulators]:
        """Return what hands them on: they were made before the study."""
        return lambda study, tell: FoundEmulators(self.documents)


@dataclass(frozen=True)
class FoundEmulators:
    """The emulations, ready to be written: how many runs, how good, which failed."""

    documents: Mapping[str, Document]
    name: str = "emulators"

    def summary(self) -> None:
        """Add nothing to the summary: a check does not run the simulator again."""

    def record(self) -> dict[str, Any]:
        """Return all there is to know for the manifest."""
        return {model: dict(document) for model, document in self.documents.items()}

    def begin(
        self, folder: Path, *, versions: Mapping[str, str], pdf: bool, pool: Pool
    ) -> Callable[[Progress], Written]:
        """Return what writes the piece of the page."""
        return lambda tell: Written(
            "emulators", "Emulators of slow simulators", "", _emulators_html(self.documents)
        )


def _emulators_html(documents: Mapping[str, Document]) -> str:
    from calib.report.page.template import template

    failed = [
        {
            "model": model,
            "n": len(d["failed"]),
            "rows": [
                (", ".join(plain_number(v, 4) for v in f["parameters"]), f["kind"], f["reason"],
                 f["printed"].strip()[-200:])
                for f in d["failed"][:_SHOWN]
            ],
        }
        for model, d in documents.items() if d["failed"]
    ]  # fmt: skip
    rows = [_emulator_row(model, d) for model, d in documents.items()]
    return template("emulators.html.j2").render(rows=rows, failed=failed)


def _emulator_row(model: str, d: Document) -> list[str]:
    held: Document = d["held_out"] or {}
    seen, inside, shares = "none left", "", "none"
    if held:
        pit = np.histogram(held["pit"], bins=4, range=(0.0, 1.0))[0]
        seen = f"{format_number(held['rmse_in_noise_sds'])} on {held['runs']}"
        inside = coverage_words(held["covered_90"], len(held["pit"]))
        shares = ", ".join(f"{100 * part:.0f} %" for part in pit / max(int(pit.sum()), 1))
    return [
        model, str(d["runs"]), str(d["nodes"]), seen, inside, shares,
        format_number(d["between_nodes_error_in_noise_sds"]),
        format_number(d["simulator_noise_sd"]) if d["simulator_noise_sd"] else "none",
        "good enough" if d["passed"] else "; ".join(d["reasons"]),
    ]  # fmt: skip


def coverage_words(share: float, n: int) -> str:
    """Say which share of n values that it had not seen an emulator's 90 % intervals hold.

    The values are the coefficients of each run, errors of which the emulator takes as independent.
    """
    from calib.validation.scores import jeffreys

    low, high = jeffreys(round(n * share), n)
    found = f"{100 * share:.0f} % (95 % interval {100 * low:.0f} to {100 * high:.0f} %): "
    if high < _NOMINAL:
        return f"{found}too narrow"
    return found + ("wider than need be" if low > _NOMINAL else "as they should be")


def emulation_words(d: Document) -> str:
    """Say for a verdict that an emulator stood in for a simulator, and how well it does."""
    said = f"an emulator, made from {d['runs']} runs, stood in for it"
    held = d["held_out"]
    if held is None:
        return f"{said}; no run was left to check it on"
    off = format_number(held["rmse_in_noise_sds"], 2)
    inside = coverage_words(held["covered_90"], len(held["pit"]))
    return (
        f"{said}; off by {off} noise sds (rms) on {held['runs']} runs not seen; of their values "
        f"its 90 % intervals hold {inside}"
    )


def _emulators_again(record: Any) -> Section:
    if not isinstance(record, Mapping) or not all(isinstance(d, Mapping) for d in record.values()):
        raise ValueError("no record of emulators")
    return EmulatorSection(record)


def _comparison_again(record: Any) -> Section:
    from calib.report.compared import stated_again

    return stated_again(record)


SECTIONS: Registry[SectionKind] = Registry(
    "section", lambda kind: kind.name, SectionKind("emulators", _emulators_again),
    SectionKind("comparison", _comparison_again),
)  # fmt: skip


@dataclass(frozen=True)
class Contents:
    """What `calib.report.writer.write_report` writes: the study, and what its sections found.

    Figures of the study's outputs are being drawn if they were asked for, else None.
    """

    study: Study
    found: tuple[Found, ...]
    drawn: Mapping[str, Later[Drawn]] | None = None


def work_out(
    tasks: Sequence[Task],
    seed: int,
    *,
    settings: SamplerSettings | None = None,
    sections: Sequence[Section] = (),
    progress: Progress | None = None,
    workers: int = 1,
    pool: Pool = HERE,
    draw: bool = False,
    pdf: bool = False,
) -> Contents:
    """Work everything out that a report shows.

    Parameters
    ----------
    sections : sequence of Section
        What the report has beside its outputs.
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    workers : int
        Processes for leaving rows out, where outputs are worked out here.
    pool : Pool, optional
        Where outputs and sections are worked out, in any order. The numbers depend neither on it
        nor on `workers`.
    draw, pdf : bool
        Whether to ask for figures as soon as there are outputs, and for PDF besides.
    """
    from calib.report.drawing import begin_figures
    from calib.report.study import begin_study

    tell = progress or (lambda what, done, planned: None)
    study = begin_study(
        tasks, seed, pool, settings=settings, progress=progress,
        workers=workers if pool.here else 1,
    )  # fmt: skip
    begun = [section.begin(seed, pool) for section in reversed(sections)]
    pool.help()
    studied = study(tell)
    # Drawn while the last of the sections' pieces, fewer than processes, are worked out.
    drawn = begin_figures(studied, pool, pdf=pdf) if draw else None
    # What a section has to do here is done while the pieces of those before it are worked out.
    found = [finish(studied, tell) for finish in begun]
    return Contents(studied, tuple(reversed(found)), drawn)
