"""The document of a diagnosis: every number that its files, page, terminal and figures show.

It is computed once from a diagnosis (`calib.gap.describe`), saved as ``document.json``, and loaded
again without any fit. Values are in canonical units.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError
from scipy.special import betaincinv

from calib.errors import CalibError, in_words
from calib.gap.corrected import Shrink
from calib.gap.curves import Curve
from calib.gap.laboratory_bias import Bias
from calib.gap.mixture import Region
from calib.gap.noise import Noise
from calib.gap.suggestions import Suggestion

FILE = "document.json"

type Numbers = tuple[float, ...]
type Interval = tuple[float, float]
# Of a change over the runs.
type Form = Literal["drift", "step", "both", "neither"]

# What the cases are, which is not what a user has.
BENCH = (
    "these cases are synthetic and calib's own, of mechanics that share no formula with the "
    "diagnosis; none is measured"
)


@dataclass(frozen=True)
class TrackRecord:
    """Blind cases whose first explanation was stated between two ends, and how many were right."""

    low: float
    high: float
    cases: int
    right: int

    @property
    def share(self) -> float:
        """Part of them that was right."""
        return self.right / self.cases

    @property
    def interval(self) -> tuple[float, float]:
        """Jeffreys 95 % interval of that part, closed at the ends where all or none were right."""
        a, b = self.right + 0.5, self.cases - self.right + 0.5
        low = float(betaincinv(a, b, 0.025)) if self.right else 0.0
        high = float(betaincinv(a, b, 0.975)) if self.right < self.cases else 1.0
        return low, high


def track_record(probability: float) -> TrackRecord:
    """Return the record of the bin that the probability of a first explanation lies in."""
    return next(r for r in reversed(_records()) if probability >= r.low)


@cache
def _records() -> tuple[TrackRecord, ...]:
    """The bins in order, all seeds together."""
    text = files("calib.gap").joinpath("track_record.toml").read_text(encoding="utf-8")
    pooled: dict[tuple[float, float], list[int]] = {}
    for record in tomllib.loads(text)["record"]:
        for low, high, cases, right in record["bins"]:
            sums = pooled.setdefault((low, high), [0, 0])
            sums[0] += cases
            sums[1] += right
    return tuple(TrackRecord(*ends, *sums) for ends, sums in sorted(pooled.items()))


@dataclass(frozen=True)
class Output:
    """One output: its simulator, and its field rows.

    Parameters
    ----------
    relative : bool
        Whether noise is a part of the value (the model predicts its logarithm).
    noise : Noise
        Of a reading, under the most probable explanation.
    rows : tuple of int
        Rows of the field file, from 0; the sequences below are of these rows.
    measured, before, after, noise_sd : tuple of float
        Reading, calibrated simulator, corrected simulator; sd of a reading.
    gap, gap_sd, probability : tuple of float
        Truth minus simulator, its sd, and the probability that it exceeds the noise.
    residual : tuple of float
        Standardised, after the most probable explanation.
    """

    name: str
    title: str
    n_lab: int
    relative: bool
    noise: Noise
    latex: tuple[str, ...]
    numbers: str
    parametrisation: str
    references: Mapping[str, float]
    parameters: tuple[str, ...]
    rows: tuple[int, ...]
    measured: Numbers
    before: Numbers
    after: Numbers
    noise_sd: Numbers
    gap: Numbers
    gap_sd: Numbers
    probability: Numbers
    residual: Numbers


@dataclass(frozen=True)
class Parameter:
    """An estimated parameter of an effect, or a shift of a simulator's.

    Parameters
    ----------
    mean, sd : float
        In its own unit; the sd is 0 where the parameter is fixed.
    form : {"value", "range", "limit"}
        How to show it: mean and sd; median with 90 % interval; upper limit (95 %).
    shown : tuple of float
        The numbers to show, as `form` says.
    of_prior : bool
        Whether the data did not narrow it.
    """

    effect: str
    name: str
    unit: str
    mean: float
    sd: float
    form: Literal["value", "range", "limit"]
    shown: Numbers
    of_prior: bool = False


@dataclass(frozen=True)
class Definition:
    """What a parameter is, its prior, and their source."""

    effect: str
    name: str
    unit: str
    reason: str
    prior: str
    source: str


@dataclass(frozen=True)
class Explanation:
    """A hypothesis about the whole gap.

    Parameters
    ----------
    name : str
        ``none``, ``unknown``, or its causes joined by ``+``.
    prior : float
        Its probability before the data.
    log_evidence : float
        Over that of ``none``.
    left : float or None
        Residual on the field rows, rms over the noise; None of sets that were not compared.
    shifts : tuple of Parameter
        Shifts of the simulator's parameters that stand out from their sd.
    shift : {"", "alone", "soil"}
        Whether the simulator's parameters shift, each by itself or together.
    """

    name: str
    probability: float
    prior: float
    log_evidence: float
    left: float | None
    parameters: tuple[Parameter, ...] = ()
    shifts: tuple[Parameter, ...] = ()
    shift: Literal["", "alone", "soil"] = ""


@dataclass(frozen=True)
class Expected:
    """What a check of a faulty instrument should show: its parameters, or a drift's two ends."""

    parameters: tuple[Parameter, ...] = ()
    output: str = ""
    first: Interval | None = None
    last: Interval | None = None


@dataclass(frozen=True)
class Cause:
    """A cause, in whichever explanation: how probably it acts, and its share of the gap.

    Parameters
    ----------
    check : str
        How to check the instrument that is at fault; empty if wheel or soil is.
    faults : tuple of str
        All tested faults of that instrument.
    """

    name: str
    probability: float
    share: float
    share_interval: Interval
    check: str = ""
    expected: Expected = field(default_factory=Expected)
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class Size:
    """How much the most probable explanation changes an output or a condition.

    Parameters
    ----------
    kind : {"rms", "end", "step", "condition"}
        Over all rows; at one end of a condition; at some run; of a condition that was misread.
    quantity : str
        Name of the output, or column of the condition.
    mean, sd : float
        With their sign; of a step that is `relative` a part of the output.
    reads : bool
        Whether the reading is wrong, not the output.
    place : {"all", "start", "end", "stretch"}
        All runs, the first or last ones, or where `column` lies between `ends`.
    ends : tuple of float
        Of a stretch of `column`; of a step the last run before and the first after.
    """

    kind: Literal["rms", "end", "step", "condition"]
    quantity: str
    mean: float
    sd: float
    together: bool = False
    reads: bool = False
    relative: bool = False
    place: Literal["all", "start", "end", "stretch"] = "all"
    column: str = ""
    ends: Interval = (0.0, 0.0)


@dataclass(frozen=True)
class Unlisted:
    """What a gap that nothing listed explains goes along with.

    Parameters
    ----------
    over : str
        As `calib.gap.hypothesis.Hypothesis` has it.
    threshold : tuple of float, optional
        Where it sets in and its sd, in the unit of `column`; None where it is smooth.
    column : str
        Of the threshold: a condition, or an output.
    pressure_alone : bool
        Whether a predicted rut depth, which it goes along with, depends on pressure alone.
    beside : str
        A listed cause that acts as well.
    surest : Region, optional
        Where to repeat runs.
    """

    over: str
    outputs: tuple[str, ...]
    column: str = ""
    threshold: Interval | None = None
    pressure_alone: bool = False
    beside: str = ""
    surest: Region | None = None


@dataclass(frozen=True)
class RunTrend:
    """A change over the order of the runs: of which outputs, how probable, in which form.

    Parameters
    ----------
    forms : tuple of (str, float)
        ``drift``, ``step``, ``both`` or ``neither`` with its probability, the most probable first.
    together : bool
        Whether several outputs change at once.
    only : bool
        Whether no other output is measured.
    surest : float
        Probability of the surest listed cause of such a change.
    """

    outputs: tuple[str, ...]
    probability: float
    forms: tuple[tuple[Form, float], ...]
    together: bool = False
    only: bool = False
    surest: float = 1.0


@dataclass(frozen=True)
class Next:
    """A measurement that would separate two explanations.

    Parameters
    ----------
    matters : tuple of str
        Columns whose values matter, of those that vary.
    last : bool
        Whether it is best made after the last run.
    repeats : int or None
        Readings for expected odds of twenty to one; None where that is out of reach.
    output : str
        The one that tells most there; empty in a document of before.
    expected : sequence of pairs of float
        Mean and sd of one reading of it under either explanation, in its canonical unit.
    """

    separates: tuple[str, str]
    conditions: Mapping[str, float]
    gain_nats: float
    matters: tuple[str, ...] = ()
    last: bool = False
    repeats: int | None = None
    output: str = ""
    expected: Sequence[tuple[float, float]] = ()


@dataclass(frozen=True)
class Untested:
    """A listed effect that a missing column hides: wholly, with the reason, or in part."""

    name: str
    reason: str = ""
    lacking: tuple[str, ...] = ()
    assumed: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Design:
    """What the design could show, before any outcome.

    Parameters
    ----------
    absorbed, detectable : mapping of str to float
        As in `calib.gap.isolate.Isolability`.
    likeness : tuple of (str, str, float)
        Cosine similarity of two effects.
    alike : tuple of (str, str)
        Pairs that the design cannot distinguish.
    """

    absorbed: Mapping[str, float] = field(default_factory=dict)
    detectable: Mapping[str, float] = field(default_factory=dict)
    likeness: tuple[tuple[str, str, float], ...] = ()
    alike: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class UnusedRow:
    """A field row that an output was not judged by, with the reason."""

    output: str
    row: int
    gap: float
    gap_sd: float
    probability: float
    reason: str


@dataclass(frozen=True)
class DataFile:
    """A file of the case: what it is of, its name, rows and hash."""

    role: Literal["calibration", "field", "predict"]
    name: str
    rows: int
    sha256: str


@dataclass(frozen=True)
class GapDocument:
    """All that a diagnosis found.

    Parameters
    ----------
    headers : tuple of str
        Column names of the field and the calibration: a page is in their units.
    explanations, causes : tuple
        Most probable first; `remainder` is something unlisted, alone or beside listed causes.
    titles : mapping of str to str
        Effect to what happens, in a few words.
    sizes : tuple of Size
        What the most probable explanation amounts to.
    conditions : mapping of str to tuple of float
        Of all field rows, in the order in which a reader looks for a cause.
    covered : mapping of str to (float, float)
        Conditions of both campaigns together.
    covariates : mapping of str to tuple of str
        Values of declared categories; none for numbers.
    false_discovery_rate : float or None
        Part of `regions` that is expected not to exceed the noise; None where it was not kept low.
    leading : tuple of int
        Places in `regions`: the first of each output, and one along what the best is about.
    laboratory_bias : tuple of Bias
        Of every free parameter of the simulators.
    suggestions : tuple of Suggestion
        Terms that would explain what is unlisted; none where nothing unlisted probably acts.
    judged_on, parts
        What the error reduction was judged on; in how many parts rows were left out.
    gap, left, coarsening, uncoarsened : float
        Size of the gap and what no formula has the shape of (noise sds, rms), by what logarithms of
        odds are divided for it, and the first explanation's probability without that.
    before, smallest : float
        Residual of the calibrated simulator on the field rows (rms over the noise); smallest effect
        that the design can name (noise sds of the laboratory).
    assumed : mapping of str to float
        Conditions that the calibration does not record, as the best explanation takes them.
    put_in, suspected, excluded, without_context
        What was put in beyond the data, in words; causes suspected or sized; causes excluded; and
        the probabilities of causes without all that.
    shift_if_same_soil : float, optional
        Probability of ``parameter_shift`` if the soil were known to be the same; None if it is
        known, or no shift is in play.
    doubts : tuple of str
        What the most probable explanation should not leave in the field, each a clause.
    curves : tuple of Curve
        Of each output, over the condition that matters.
    prediction : mapping of str to tuple
        Columns of ``fresh_prediction.csv``; empty without conditions to predict.
    """

    __pydantic_config__ = ConfigDict(ser_json_inf_nan="strings", extra="forbid")

    name: str
    verdict: Literal["effect", "none", "unknown", "ambiguous"]
    seed: int
    outputs: tuple[Output, ...]
    explanations: tuple[Explanation, ...]
    track_record: TrackRecord
    causes: tuple[Cause, ...]
    remainder: Cause
    titles: Mapping[str, str]
    conditions: Mapping[str, Numbers]
    shrink: Mapping[str, Shrink]
    judged_on: Literal["new conditions", "rows left out", "fitted rows"]
    design: Design
    gap: float
    left: float
    coarsening: float
    uncoarsened: float
    before: float
    files: tuple[DataFile, ...]
    schema: Literal["calib/gap-document/1"] = "calib/gap-document/1"
    label: str = ""
    headers: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    remainder_where: tuple[Region, ...] = ()
    definitions: tuple[Definition, ...] = ()
    equations: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    sizes: tuple[Size, ...] = ()
    unlisted: Unlisted | None = None
    runs: RunTrend | None = None
    covered: Mapping[str, Interval] = field(default_factory=dict)
    covariates: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    regions: tuple[Region, ...] = ()
    false_discovery_rate: float | None = None
    leading: tuple[int, ...] = ()
    laboratory_bias: tuple[Bias, ...] = ()
    suggestions: tuple[Suggestion, ...] = ()
    parts: int = 0
    next_measurements: tuple[Next, ...] = ()
    smallest: float = float("nan")
    not_testable: Mapping[str, str] = field(default_factory=dict)
    untested: tuple[Untested, ...] = ()
    assumed: Mapping[str, float] = field(default_factory=dict)
    put_in: tuple[str, ...] = ()
    suspected: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()
    without_context: Mapping[str, float] | None = None
    shift_if_same_soil: float | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    unused: tuple[UnusedRow, ...] = ()
    curves: tuple[Curve, ...] = ()
    prediction: Mapping[str, tuple[str, ...] | Numbers] = field(default_factory=dict)

    @property
    def best(self) -> Explanation:
        """The most probable explanation."""
        return self.explanations[0]

    @property
    def acting(self) -> list[Cause]:
        """Causes that are more likely to act than not, the largest share first."""
        return sorted((c for c in self.causes if c.probability >= 0.5), key=lambda c: -c.share)

    @property
    def probability(self) -> dict[str, float]:
        """Of every explanation, by name."""
        return {e.name: e.probability for e in self.explanations}

    def json(self) -> bytes:
        """Return the content of ``document.json``; numbers that are not finite are strings."""
        return _adapter().dump_json(self) + b"\n"


@cache
def _adapter() -> TypeAdapter[GapDocument]:
    return TypeAdapter(GapDocument)


def load_document(folder: Path) -> GapDocument:
    """Read the document of a diagnosis.

    Parameters
    ----------
    folder : Path
        That `calib diagnose` wrote.

    Raises
    ------
    CalibError
        If there is none, or it is damaged or of another version.
    """
    path = Path(folder) / FILE
    try:
        return _adapter().validate_json(path.read_bytes())
    except OSError as error:
        raise CalibError(
            f"this is no readable diagnosis (no {FILE} in it: {error.strerror})", where=str(folder),
            expected="a folder written by `calib diagnose`", hint="diagnose the case again",
        ) from None  # fmt: skip
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "in it"
        raise CalibError(
            f"{place}: {in_words(first)}", where=str(path), expected="the file as it was written",
            hint="restore the file, or diagnose the case again",
        ) from None  # fmt: skip
