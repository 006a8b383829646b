"""What a folder says of itself, read and checked: what all kinds have, and the record of a run."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Literal, get_args

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
from calib.errors import CalibError, in_words
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import MODELS

RUN, POSTERIOR, PRIORS, DATA = "run.json", "posterior.nc", "priors.toml", "data.csv"


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
            f"model: {name} is not one of {', '.join(MODELS)}", expected="a model known here",
            hint="pass the file of your own that declares it (--models FILE or --simulator FILE); "
            "if there is none, restore the folder's",
        )  # fmt: skip
    return name


type Hash = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
type File = Annotated[str, AfterValidator(_inside)]
type Name = Annotated[str, AfterValidator(_name)]
type KnownModel = Annotated[str, AfterValidator(_known_model)]


class Entry(BaseModel):
    """Some entries of a record: what later versions add to them is not needed."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Record(Entry):
    """What a folder of any kind says of itself, in one of its files."""

    FILE: ClassVar[str]
    kind: ClassVar[Literal["report", "run", "comparison"]]
    WRITTEN_BY: ClassVar[str]
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


class _Estimate(Entry):
    method: str
    theta: tuple[float, ...]
    reported: dict[str, float]
    cost: float
    rmse: float


class RunRecord(Record):
    """`run.json` of a run folder."""

    FILE, kind, WRITTEN_BY = RUN, "run", "calib fit"
    schema_: Literal["calib/run/1"] = Field(alias="schema")
    model: KnownModel
    label: str
    estimates: tuple[_Estimate, ...]
    fixed: dict[str, float]
    references: dict[str, float]
    prior_file: Name
    prior_text: str
    prior_references: dict[str, float]
    data_source: str
    data_label: str
    sha256: dict[File, Hash]


def read_record[R: Record](kind: type[R], folder: Path) -> R:
    """Read the record of a kind in a folder.

    Raises
    ------
    CalibError
        If there is none, or it is damaged or of an earlier version.
    """
    path = folder / kind.FILE
    if not path.is_file():
        raise CalibError(
            f"this is not a {kind.kind} folder (no readable {kind.FILE} in it)", where=str(folder),
            expected=f"a folder written by `{kind.WRITTEN_BY}`",
            hint=f"give the folder that `{kind.WRITTEN_BY} ... --out` named",
        )  # fmt: skip
    try:
        content = json.loads(path.read_bytes())
        return kind.model_validate({**content, "document": content})
    except ValidationError as error:
        found = error.errors()
    except CalibError as error:
        raise error.within(str(path)) from None
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise _damaged(kind, path, f"it cannot be read ({type(error).__name__})") from None
    if any(e["loc"] == ("schema",) for e in found):
        schema, expected = content.get("schema"), kind.model_fields["schema_"].annotation
        hint = f"run `{kind.WRITTEN_BY}` again, or use the version that made the folder"
        said, allowed = f"the schema is {schema!r}", get_args(expected)[0]
        raise CalibError(said, where=str(path), expected=allowed, hint=hint)
    place = ".".join(map(str, found[0]["loc"]))
    raise _damaged(kind, path, f"{place or 'in it'}: {in_words(found[0])}")


def _damaged(kind: type[Record], path: Path, found: str) -> CalibError:
    hint = f"restore the file, or run `{kind.WRITTEN_BY}` again"
    return CalibError(found, where=str(path), expected="the file as it was written", hint=hint)
