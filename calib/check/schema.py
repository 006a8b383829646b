"""What a folder says of itself, checked: a report, a run, or a comparison."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    StringConstraints,
    ValidationError,
    model_validator,
)

from calib.batch.environment import Environment
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import MODELS
from calib.report.sections import SECTIONS
from calib.report.study_tasks import HoldOut

MANIFEST, SUMMARY, AUDIT = "manifest.json", "summary.json", "audit.json"
COMPARISON, RUN = "comparison.json", "run.json"
POSTERIOR, PRIORS, DATA = "posterior.nc", "priors.toml", "data.csv"


def _inside(path: str) -> str:
    """A path that leaves the folder is no path of one of its files."""
    pure = PurePosixPath(path)
    if pure.is_absolute() or ".." in pure.parts or "\\" in path or not pure.parts:
        raise ValueError("not a path inside the folder")
    return path


def _name(text: str) -> str:
    if text != PurePosixPath(text).name or "\\" in text:
        raise ValueError("not the name of a file")
    return text


def _known_model(name: str) -> str:
    if name not in MODELS:
        raise CalibError(
            f"model: {name} is not one of {', '.join(MODELS)}", allowed="a model known here",
            mend="pass the file of your own that declares it (--models FILE or --simulator FILE); "
            "if there is none, restore the folder's",
        )  # fmt: skip
    return name


type _Hash = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
type _File = Annotated[str, AfterValidator(_inside)]
type _Name = Annotated[str, AfterValidator(_name)]
type _Model = Annotated[str, AfterValidator(_known_model)]


class _Record(BaseModel):
    # What later versions add is compared as numbers are, and not needed to compute again.
    model_config = ConfigDict(frozen=True, extra="ignore")


class _Kept(_Record):
    file: _File
    sha256: _Hash


class _Data(_Kept):
    source: str
    source_sha256: _Hash
    # Where it is not that of the file that is kept: messages and units of the page are by it.
    header: tuple[str, ...] = ()
    ignored: tuple[str, ...]


class _PriorFile(_Kept):
    source: _Name
    shipped: bool


class TaskRecord(_Record):
    """One output of a report: model, rows held out, data and priors."""

    model: _Model
    held_out: HoldOut | None
    label: str
    data: _Data
    priors: _PriorFile


class _Made(_Record):
    FILE: ClassVar[str]
    kind: ClassVar[Literal["report", "run", "comparison"]]
    versions: dict[str, str]
    machine: dict[str, str]
    code: str
    seed: Annotated[int, Field(ge=0)]
    settings: SamplerSettings
    document: dict[str, JsonValue]
    """The whole file."""

    @property
    def environment(self) -> Environment:
        """Where it was made, as it says."""
        return Environment(self.versions, self.machine, self.code)


class Manifest(_Made):
    """`manifest.json` of a report folder."""

    FILE, kind = MANIFEST, "report"
    schema_: Literal["calib/manifest/2"] = Field(alias="schema")
    title: str
    command: tuple[str, ...]
    tasks: Annotated[dict[str, TaskRecord], Field(min_length=1)]
    pdf: bool = False
    files: dict[_File, _Hash]
    left_out: dict[_File, _Hash]

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


class _Estimate(_Record):
    method: str
    theta: tuple[float, ...]
    reported: dict[str, float]
    cost: float
    rmse: float


class RunRecord(_Made):
    """`run.json` of a run folder."""

    FILE, kind = RUN, "run"
    schema_: Literal["calib/run/1"] = Field(alias="schema")
    model: _Model
    label: str
    estimates: tuple[_Estimate, ...]
    fixed: dict[str, float]
    references: dict[str, float]
    prior_file: _Name
    prior_text: str
    prior_references: dict[str, float]
    data_source: str
    data_label: str
    sha256: dict[_File, _Hash]


class _Compared(_Record):
    elpd_rows: Annotated[tuple[float, ...], Field(min_length=2)]
    converged: bool
    refits_not_converged: int


class ComparisonRecord(_Made):
    """`comparison.json` of a comparison folder."""

    FILE, kind = COMPARISON, "comparison"
    schema_: Literal["calib/comparison/2"] = Field(alias="schema")
    held_out: str
    header: tuple[str, ...] = ()
    command: tuple[str, ...]
    models: Annotated[dict[_Model, _Compared], Field(min_length=2)]
    files: dict[_File, _Hash]

    @property
    def unsound(self) -> tuple[str, ...]:
        """Models of which a posterior is recorded as one that did not pass the gate."""
        return tuple(
            name for name, m in self.models.items() if not m.converged or m.refits_not_converged
        )


type Record = Manifest | RunRecord | ComparisonRecord


def read_folder(folder: Path) -> Record:
    """Read what a folder says of itself.

    Raises
    ------
    CalibError
        If it is none that can be checked, or its record is damaged or of an earlier version.
    """
    kinds: tuple[type[Record], ...] = (Manifest, RunRecord, ComparisonRecord)
    for kind in kinds:
        if (folder / kind.FILE).is_file():
            return read_record(kind, folder)
    raise _unchecked(folder, f"no {', '.join(kind.FILE for kind in kinds)} in it")


def read_record[R: _Made](kind: type[R], folder: Path) -> R:
    """Read the record of a kind in a folder; see `read_folder`."""
    path = folder / kind.FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return kind.model_validate({**content, "document": content})
    except ValidationError as error:
        found = error.errors()
    except CalibError as error:
        raise error.within(str(path)) from None
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise _damaged(path, f"it cannot be read ({type(error).__name__})") from None
    of_schema = next((e for e in found if e["loc"] == ("schema",)), None)
    if of_schema is None:
        place = ".".join(map(str, found[0]["loc"]))
        raise _damaged(path, f"{place or 'in it'}: {found[0]['msg']}")
    # A folder of `calib sbc` has a run.json as well, which is no record of a run.
    if "schema" not in content and (folder / "sbc.json").is_file():
        raise _unchecked(folder, "it is one of `calib sbc`")
    expected = of_schema.get("ctx", {}).get("expected")
    mend = "make the folder again with this version, or check it with the one that made it"
    said = f"the schema is {content.get('schema')!r}"
    raise CalibError(said, where=str(path), allowed=expected, mend=mend)


def _unchecked(folder: Path, why: str) -> CalibError:
    return CalibError(
        f"this is no folder that can be checked ({why})", where=str(folder),
        allowed="a folder written by `calib report`, `calib fit` or `calib compare`",
        mend="give the folder that --out of one of these named",
    )  # fmt: skip


def _damaged(path: Path, found: str) -> CalibError:
    allowed, mend = "the file as it was written", "restore the file, or make the folder again"
    return CalibError(found, where=str(path), allowed=allowed, mend=mend)
