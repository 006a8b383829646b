"""What a case's answer and a diagnosis must hold: files that any program may write.

`docs/formats/cases.md` says what they mean. Keys beside those named here are the writer's own.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calib.data.documents import invalid, read_numbers
from calib.data.files import open_csv
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError, several

type Probability = Annotated[float, Field(ge=0.0, le=1.0)]
type Interval = Annotated[list[float], Field(min_length=2, max_length=2)]
type ByOutput = dict[str, list[float]]

SUMS_TO_ONE = 1e-3


class _Open(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False, use_attribute_docstrings=True)


class Answer(_Open):
    """`answer.json`: what is true of a case."""

    schema_: Literal["calib/answer/1"] = Field(alias="schema")
    truth: Annotated[str, Field(pattern=r"^[A-Za-z]\w*(\+[A-Za-z]\w*)*$")]
    """The causes that act, joined by +; `none`, or `unknown` for what has no name in the list."""
    salt: Annotated[str, Field(min_length=16)] | None = None
    """Random text, so that nobody finds the answer by hashing guesses."""
    defensible: list[str] = []
    """Causes that are no wrong answer either."""
    tier: str = "all"
    """The group of cases in which it is scored."""
    noise_sd: ByOutput = {}
    """Standard deviation of the noise of every field row."""
    field_truth: ByOutput = {}
    """Noise-free outputs of every field row."""
    field_without: ByOutput = {}
    """The same without what is true."""
    fresh_truth: ByOutput = {}
    """Outputs of every row of `predict`: noise-free, or as measured."""
    contributions: dict[str, Annotated[float, Field(ge=0.0)]] = {}
    """Rms part of the gap that goes with each cause that acts, in standard deviations of noise."""

    @model_validator(mode="after")
    def _of_outputs(self) -> Self:
        rows = (self.noise_sd, self.field_truth, self.field_without)
        if any({*one} != {*self.noise_sd} for one in rows):
            raise ValueError("noise_sd, field_truth and field_without are of different outputs")
        if strange := {*self.noise_sd, *self.fresh_truth} - {*OUTPUTS}:
            raise ValueError(f"{min(strange)} is no output; there are {', '.join(OUTPUTS)}")
        return self


class Explanation(_Open):
    """A set of causes that explains the whole gap."""

    name: str
    """Causes joined by +, or `none`; `unknown` is what has no name in the list."""
    probability: Probability


class Acting(_Open):
    """A cause."""

    probability: Probability
    """That it acts, whatever else acts."""
    share_interval: Interval | None = None
    """90 % interval of its part of the gap."""


class Located(_Open):
    """A field row and an output."""

    output: str
    row: Annotated[int, Field(ge=0)]
    """Data rows of the field's file, from 0."""
    probability: Probability
    """That the gap there is larger than one standard deviation of the noise."""


class Reduction(_Open):
    """How far the error of an output shrinks."""

    interval: Interval | None = None
    """90 % interval of 1 - rmse after / rmse before, at the rows of `predict`."""


class Scored(_Open):
    """`diagnosis.json`: what is scored of it."""

    verdict: Literal["effect", "none", "unknown", "ambiguous"]
    effects: Annotated[list[Explanation], Field(min_length=1)]
    """Explanations that exclude one another; their probabilities sum to 1."""
    inclusion: dict[str, Acting] = {}
    """By cause; without it the probabilities of `effects` are summed."""
    remainder: Acting | None = None
    """Something that has no name in the list."""
    where: list[Located] = []
    shrink: dict[str, Reduction] = {}

    @model_validator(mode="after")
    def _whole(self) -> Self:
        total = sum(e.probability for e in self.effects)
        if abs(total - 1.0) > SUMS_TO_ONE:
            raise ValueError(f"the probabilities of effects sum to {total:g}, not 1")
        return self


def read_document[M: BaseModel](path: Path, kind: type[M]) -> tuple[M, str]:
    """Return a JSON file as its schema has it, and its SHA-256; a CalibError has all faults."""
    try:
        raw = Path(path).read_bytes()
        return kind.model_validate_json(raw), hashlib.sha256(raw).hexdigest()
    except OSError as error:
        raise CalibError(f"it cannot be read ({error.strerror})", where=str(path)) from None
    except ValidationError as error:
        raise several(invalid(error, str(path))) from None


def faults(case: Path, answer: Path | None, diagnosis: Path | None) -> list[CalibError]:
    """Return what is wrong with the answer to a case, and with a diagnosis of it.

    Parameters
    ----------
    case : Path
        Its folder.
    answer : Path, optional
        ``answer.json``, which lies elsewhere.
    diagnosis : Path, optional
        Folder with ``diagnosis.json`` and, if there are conditions to predict,
        ``fresh_prediction.csv``.
    """
    said: dict[str, Any] = {}
    rows: dict[str, int] = {}
    found: list[CalibError] = []
    try:
        said = tomllib.loads((case / "case.toml").read_text(encoding="utf-8-sig"))
        for key in ("field", "predict"):
            if key in said:
                rows[key] = len(open_csv(case / said[key]).rows)
    except (CalibError, OSError, ValueError, TypeError):
        pass  # the case is checked by itself
    checks = []
    if answer is not None:
        checks.append(_of_answer(answer, said, rows))
    if diagnosis is not None:
        checks.append(_of_diagnosis(diagnosis, said, rows))
    for check in checks:
        try:
            found += check
        except CalibError as error:
            found += error.each or (error,)
    return found


def _of_answer(
    path: Path, case: Mapping[str, Any], rows: Mapping[str, int]
) -> Iterator[CalibError]:
    answer, sha256 = read_document(path, Answer)
    if (said := case.get("answer_sha256")) != sha256:
        yield CalibError(
            f"its SHA-256 is {sha256}", where=str(path), expected=f"{said}, as case.toml says"
        )
    for name in ("noise_sd", "field_truth", "field_without", "fresh_truth"):
        n = rows.get("predict" if name == "fresh_truth" else "field")
        for output, values in getattr(answer, name).items():
            where = f"{path}, {name}.{output}"
            if output not in case.get("models", {}):
                yield CalibError("the case has no model of it", where=where)
            elif len(values) != n:
                yield CalibError(f"{len(values)} values for {n} rows", where=where)


def _of_diagnosis(
    folder: Path, case: Mapping[str, Any], rows: Mapping[str, int]
) -> Iterator[CalibError]:
    path, predicted = folder / "diagnosis.json", folder / "fresh_prediction.csv"
    models, n = case.get("models", {}), rows.get("field", 0)
    said, _ = read_document(path, Scored)
    for i, row in enumerate(said.where):
        if row.output not in models or row.row >= n:
            yield CalibError(
                f"the case has no row {row.row} of {row.output}", where=f"{path}, where.{i}",
                expected=f"rows 0 to {n - 1} of {', '.join(models)}",
            )  # fmt: skip
    if "predict" in rows and predicted.exists():
        read_numbers(predicted, prediction_columns(models), rows["predict"])


def prediction_columns(outputs: Iterable[str]) -> list[str]:
    """Return the columns that a prediction of these outputs has."""
    columns = [OUTPUTS[output] for output in outputs if output in OUTPUTS]
    return [f"{column}_{when}" for column in columns for when in ("before", "after")]
