"""What a report says of itself, checked; and which kind of folder it is that is to be checked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.record import (
    Entry,
    File,
    Hash,
    KnownModel,
    Name,
    Record,
    RunRecord,
    read_record,
)
from calib.report.comparison import ComparisonRecord
from calib.report.sections import SECTIONS
from calib.report.study_tasks import HoldOut

MANIFEST, SUMMARY, AUDIT = "manifest.json", "summary.json", "audit.json"


class _Kept(Entry):
    file: File
    sha256: Hash


class _Data(_Kept):
    source: str
    source_sha256: Hash
    # Where it is not that of the file that is kept: messages and units of the page are by it.
    header: tuple[str, ...] = ()
    ignored: tuple[str, ...]


class _PriorFile(_Kept):
    source: Name
    shipped: bool


class TaskRecord(Entry):
    """One output of a report: model, rows held out, data and priors."""

    model: KnownModel
    held_out: HoldOut | None
    label: str
    data: _Data
    priors: _PriorFile


class Manifest(Record):
    """`manifest.json` of a report folder."""

    FILE, kind, WRITTEN_BY = MANIFEST, "report", "calib report"
    schema_: Literal["calib/manifest/2"] = Field(alias="schema")
    title: str
    command: tuple[str, ...]
    tasks: Annotated[dict[str, TaskRecord], Field(min_length=1)]
    pdf: bool = False
    files: dict[File, Hash]
    left_out: dict[File, Hash]

    @property
    def sections(self) -> dict[str, Any]:
        """What it says of the sections that are known here."""
        return {name: self.document[name] for name in SECTIONS if name in self.document}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if unknown := self.tasks.keys() - OUTPUTS.keys():
            raise ValueError(f"tasks: there is no output {', '.join(unknown)}")
        for name, record in self.sections.items():
            try:
                SECTIONS[name].again(record)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return self


def read_folder(folder: Path) -> Record:
    """Read what a folder says of itself; a CalibError if it is none that can be checked."""
    kinds: tuple[type[Record], ...] = (Manifest, RunRecord, ComparisonRecord)
    why = f"no {', '.join(kind.FILE for kind in kinds)} in it"
    for kind in kinds:
        if (folder / kind.FILE).is_file():
            try:
                return read_record(kind, folder)
            except CalibError:
                # A folder of `calib sbc` has a run.json as well, which is no record of a run.
                why = "it is one of `calib sbc`"
                if not (folder / "sbc.json").is_file():
                    raise
    raise CalibError(
        f"this is no folder that can be checked ({why})", where=str(folder),
        allowed="a folder written by `calib report`, `calib fit` or `calib compare`",
        mend="give such a folder; of a diagnosis `calib diagnose FOLDER/case` makes the same again",
    )  # fmt: skip
