"""What a folder says of itself, checked.

`manifest.json` of a report, `run.json` of a run, `comparison.json` of a comparison.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    StringConstraints,
    ValidationError,
)

from calib.batch.environment import Environment
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.io import SCHEMA as RUN_SCHEMA
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import MODELS
from calib.report.comparison import FILE as COMPARISON
from calib.report.comparison import SCHEMA as COMPARISON_SCHEMA
from calib.report.sections import SECTIONS
from calib.report.writer import SCHEMA as REPORT_SCHEMA


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


class _UnknownModel(ValueError):
    """A model that is not known here: most likely its file was not passed."""


def _known_model(name: str) -> str:
    if name not in MODELS:
        raise _UnknownModel(f"{name} is not one of {', '.join(MODELS)}")
    return name


type _Hash = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
type _File = Annotated[str, AfterValidator(_inside)]
type _Name = Annotated[str, AfterValidator(_name)]
type _Model = Annotated[str, AfterValidator(_known_model)]
type _Seed = Annotated[int, Field(ge=0)]


class _Record(BaseModel):
    # What later versions add is compared as numbers are, and not needed to compute again.
    model_config = ConfigDict(frozen=True, extra="ignore")


class _HeldOut(_Record):
    column: str
    value: float


class _Data(_Record):
    file: _File
    sha256: _Hash
    source: str
    source_sha256: _Hash
    # Where it is not that of the file that is kept: messages and units of the page are by it.
    header: tuple[str, ...] = ()
    ignored: tuple[str, ...]


class _PriorFile(_Record):
    file: _File
    sha256: _Hash
    source: _Name
    shipped: bool


class TaskRecord(_Record):
    """One output of a report: model, rows held out, data and priors."""

    model: _Model
    held_out: _HeldOut | None
    label: str
    data: _Data
    priors: _PriorFile


class _Made(_Record):
    versions: dict[str, str]
    machine: dict[str, str]
    code: str

    @property
    def environment(self) -> Environment:
        """Where it was made, as it says."""
        return Environment(self.versions, self.machine, self.code)


class Manifest(_Made):
    """`manifest.json` of a report folder."""

    schema_: Literal["calib/manifest/2"] = Field(alias="schema")
    title: str
    command: tuple[str, ...]
    seed: _Seed
    settings: SamplerSettings
    tasks: dict[str, TaskRecord]
    pdf: bool = False
    sections: dict[str, JsonValue] = {}
    files: dict[_File, _Hash]
    left_out: dict[_File, _Hash]


class _Estimate(_Record):
    method: str
    theta: tuple[float, ...]
    reported: dict[str, float]
    cost: float
    rmse: float


class RunRecord(_Made):
    """`run.json` of a run folder."""

    schema_: Literal["calib/run/1"] = Field(alias="schema")
    model: _Model
    seed: _Seed
    label: str
    settings: SamplerSettings
    estimates: tuple[_Estimate, ...]
    fixed: dict[str, float]
    references: dict[str, float]
    prior_file: _Name
    prior_text: str
    prior_references: dict[str, float]
    data_source: str
    data_label: str
    sha256: dict[_File, _Hash]
    document: dict[str, JsonValue]
    """The whole file."""


class _Compared(_Record):
    """What is said of a model that was compared."""

    elpd_rows: Annotated[tuple[float, ...], Field(min_length=2)]
    converged: bool
    refits_not_converged: int


class ComparisonRecord(_Made):
    """`comparison.json` of a comparison folder."""

    schema_: Literal["calib/comparison/2"] = Field(alias="schema")
    seed: _Seed
    settings: SamplerSettings
    held_out: str
    header: tuple[str, ...] = ()
    command: tuple[str, ...]
    models: Annotated[dict[_Model, _Compared], Field(min_length=2)]
    files: dict[_File, _Hash]
    document: dict[str, JsonValue]
    """The whole file."""

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
    readers: dict[str, Callable[[Any, Path], Record]] = {
        "manifest.json": _manifest, "run.json": _run, COMPARISON: _comparison,
    }  # fmt: skip
    found = [name for name in readers if (folder / name).is_file()]
    if not found:
        raise _unchecked(folder, f"no {', '.join(readers)} in it")
    return readers[found[0]](_content(folder / found[0]), folder / found[0])


def read_run(folder: Path) -> RunRecord:
    """Read what a run folder inside another says of itself; see `read_folder`."""
    return _run(_content(folder / "run.json"), folder / "run.json")


def read_comparison(folder: Path) -> ComparisonRecord:
    """Read what a comparison inside a report says of itself; see `read_folder`."""
    return _comparison(_content(folder / COMPARISON), folder / COMPARISON)


def _content(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise _damaged(path, f"it cannot be read ({type(error).__name__})") from None


def _comparison(content: Any, path: Path) -> ComparisonRecord:
    _check_schema(content, COMPARISON_SCHEMA, path)
    return _validated(ComparisonRecord, content, path, document=content)


def _manifest(content: Any, path: Path) -> Manifest:
    _check_schema(content, REPORT_SCHEMA, path)
    sections = {name: content[name] for name in SECTIONS if name in content}
    manifest = _validated(Manifest, content, path, sections=sections)
    for name, record in sections.items():
        try:
            SECTIONS[name].again(record)
        except ValueError as error:
            raise _damaged(path, f"{name}: {error}") from None
    unknown = [key for key in manifest.tasks if key not in OUTPUTS]
    if unknown or not manifest.tasks:
        raise _damaged(path, f"tasks: there is no output {', '.join(unknown) or 'at all'}")
    return manifest


def _run(content: Any, path: Path) -> RunRecord:
    _check_schema(content, RUN_SCHEMA, path)
    return _validated(RunRecord, content, path, document=content)


def _check_schema(content: Any, schema: str, path: Path) -> None:
    given = content.get("schema") if isinstance(content, Mapping) else None
    # A folder of `calib sbc` has a run.json as well, which is no record of a run.
    if given is None and (path.parent / "sbc.json").is_file():
        raise _unchecked(path.parent, "it is one of `calib sbc`")
    if given != schema:
        raise CalibError(
            f"the schema is {given!r}",
            where=str(path),
            allowed=schema,
            mend="make the folder again with this version, or check it with the one that made it",
        )


def _validated[R: _Made](kind: type[R], content: Any, path: Path, **more: Any) -> R:
    try:
        return kind.model_validate({**content, **more})
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        unknown = first.get("ctx", {}).get("error")
        if isinstance(unknown, _UnknownModel):
            raise CalibError(
                f"{place}: {unknown}", where=str(path),
                allowed="a model that is known here",
                mend="pass the file of your own that declares it (--models FILE or --simulator "
                "FILE); if there is none, restore the folder's",
            ) from None  # fmt: skip
        raise _damaged(path, f"{place}: {first['msg']}") from None


def _unchecked(folder: Path, why: str) -> CalibError:
    return CalibError(
        f"this is no folder that can be checked ({why})",
        where=str(folder),
        allowed="a folder written by `calib report`, `calib fit` or `calib compare`",
        mend="give the folder that --out of one of these named",
    )


def _damaged(path: Path, found: str) -> CalibError:
    return CalibError(
        found,
        where=str(path),
        allowed="the file as it was written",
        mend="restore the file, or make the folder again",
    )
