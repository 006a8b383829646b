"""A report: a study of outputs, and sections beside them that packages register.

A section works its part out, says what `summary.json` and `manifest.json` keep of that part, and
writes its view of it: files in the report's folder and a piece of the page. The section on emulated
simulators is here, that on compared models in `calib.report.comparison`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calib.batch.pool import HERE
from calib.data.files import plain_number
from calib.data.registry import Registry
from calib.report.numbers import format_number

# Every command loads what plug-ins declare here, and few work a report out.
if TYPE_CHECKING:
    from calib.inference.sampler import SamplerSettings
    from calib.report.study import Progress, Study, Task

type Document = Mapping[str, Any]


@dataclass(frozen=True)
class Target:
    """Where and how a section writes its files."""

    folder: Path  # of the report; it has `figures`
    versions: Mapping[str, str]  # of the packages, for pages in the folder
    pdf: bool = False  # whether figures also come as PDF
    pool: Executor = HERE  # where figures are drawn
    tell: Progress = lambda what, done, planned: None


class Section[Part](ABC):
    """A section of a report; `Part` is what it finds."""

    name: ClassVar[str]  # key in manifest.json and summary.json
    anchor: ClassVar[str]  # on the page
    heading: ClassVar[str]
    badge: ClassVar[str] = ""  # what its data are called

    @abstractmethod
    def work_out(self, study: Study, pool: Executor, tell: Progress) -> Part:
        """Return what is found, given the study; random numbers follow from its seed."""

    @abstractmethod
    def record(self, part: Part) -> dict[str, Any]:
        """Return what `manifest.json` keeps, from which `SectionKind.again` makes the section."""

    def summary(self, part: Part) -> dict[str, Any] | None:
        """Return what `summary.json` keeps; None for nothing."""
        return None

    @abstractmethod
    def view(self, part: Part, to: Target) -> str:
        """Write the files of the section and return its piece of the page."""


@dataclass(frozen=True)
class SectionKind:
    """How a reviewer works a section out again."""

    name: str  # key in the manifest
    again: Callable[[Any], Section[Any]]  # from its record; a ValueError if that is none
    # From the folder and all of its files, the text of files that follow from others.
    derived: Callable[[Path, Mapping[str, str]], dict[str, str]] = lambda folder, files: {}

    def register(self) -> None:
        """Have reports with such a section checked."""
        SECTIONS.add(self)


@dataclass(frozen=True)
class EmulatorSection(Section[Mapping[str, Document]]):
    """How the emulations went, as their `Emulation.document`, by model.

    They were made before the study. A check does not run the simulator again.
    """

    documents: Mapping[str, Document]
    name, anchor, heading = "emulators", "emulators", "Emulators of slow simulators"

    def work_out(self, study: Study, pool: Executor, tell: Progress) -> Mapping[str, Document]:
        """Return the documents."""
        return self.documents

    def record(self, part: Mapping[str, Document]) -> dict[str, Any]:
        """Return the documents."""
        return {model: dict(document) for model, document in part.items()}

    def view(self, part: Mapping[str, Document], to: Target) -> str:
        """Render the table of emulators, and of the first runs that failed."""
        from calib.report.page.template import template

        quarters = {}
        for model, d in part.items():
            if d["held_out"]:
                n = np.histogram(d["held_out"]["pit"], bins=4, range=(0.0, 1.0))[0]
                quarters[model] = n / max(1, n.sum())
        shown = {"coverage_words": coverage_words, "plain_number": plain_number, "shown": 20}
        return template("emulators.html.j2").render(documents=part, quarters=quarters, **shown)

    @classmethod
    def again(cls, record: Any) -> EmulatorSection:
        """Return the section of a manifest's record; raise ValueError if it is none."""
        if not isinstance(record, Mapping) or not all(
            isinstance(d, Mapping) for d in record.values()
        ):
            raise ValueError("no record of emulators")
        return cls(record)


def coverage_words(share: float, n: int) -> str:
    """Say which share of n values that it had not seen an emulator's 90 % intervals hold.

    The values are the coefficients of each run; the emulator takes their errors as independent.
    """
    from calib.validation.scores import jeffreys

    low, high = jeffreys(round(n * share), n)
    found = f"{100 * share:.0f} % (95 % interval {100 * low:.0f} to {100 * high:.0f} %): "
    if high < 0.9:
        return f"{found}too narrow"
    return found + ("wider than necessary" if low > 0.9 else "as they should be")


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


def _comparison_again(record: Any) -> Section[Any]:
    from calib.report.comparison import StatedComparison

    return StatedComparison.again(record)


SECTIONS: Registry[SectionKind] = Registry(
    "section",
    lambda kind: kind.name,
    SectionKind("emulators", EmulatorSection.again),
    SectionKind("comparison", _comparison_again),
)


@dataclass(frozen=True)
class Report:
    """All that `calib.report.writer.write_report` writes: the study, and the sections' parts."""

    study: Study
    parts: tuple[tuple[Section[Any], Any], ...] = ()


def work_out(
    tasks: Sequence[Task],
    seed: int,
    *,
    settings: SamplerSettings | None = None,
    sections: Sequence[Section[Any]] = (),
    progress: Progress | None = None,
    workers: int = 1,
    pool: Executor = HERE,
) -> Report:
    """Work out all that a report shows: outputs and sections, in their order on the page.

    Progress is called with a step's name, the steps done and planned. The numbers depend neither on
    the pool nor on `workers`, which leave rows out where outputs are worked out in this process.
    """
    from calib.report.study import silent, work_out_study

    tell = progress or silent
    study = work_out_study(tasks, seed, pool, settings=settings, tell=tell, workers=workers)
    return Report(study, tuple((s, s.work_out(study, pool, tell)) for s in sections))
