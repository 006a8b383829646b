"""Parts of a report beside its outputs: a source's own, hung on by its package.

A section is asked for with what it is to work out, begun where the outputs are, and writes itself:
files into the report's folder, numbers into ``summary.json``, what it takes to work it out again
into ``manifest.json``, and a piece of the page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from calib.batch.pool import Pool
from calib.data.registry import Registry
from calib.report.study import Progress, Study


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


def _emulators_again(record: Any) -> Section:
    # It needs this module.
    from calib.report.emulators import EmulatorSection

    if not isinstance(record, Mapping) or not all(isinstance(d, Mapping) for d in record.values()):
        raise ValueError("no record of emulators")
    return EmulatorSection(record)


SECTIONS: Registry[SectionKind] = Registry(
    "section", lambda kind: kind.name, SectionKind("emulators", _emulators_again)
)
