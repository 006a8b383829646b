"""What the files that calib writes for programs hold, and a case: as models of pydantic.

Nothing in the package reads these files with them; tests hold them against files that it writes.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from calib.gap.case import CaseFile

type Probability = Annotated[float, Field(ge=0.0, le=1.0)]
type Interval = Annotated[list[float], Field(min_length=2, max_length=2)]
type Place = dict[str, list[float] | list[str]]
type Count = Annotated[int, Field(ge=0)]


class _Exactly(BaseModel):
    model_config = ConfigDict(extra="forbid", protected_namespaces=())


class _Spread(_Exactly):
    mean: float
    sd: float


class _Hypothesis(_Exactly):
    name: str
    probability: Probability
    parameters: dict[str, _Spread]


class _Cause(_Exactly):
    probability: Probability
    share: float
    share_interval: Interval


class _Somewhere(_Exactly):
    output: str
    conditions: Place


class _Remainder(_Cause):
    where: list[_Somewhere]


class _NotTestable(_Exactly):
    name: str
    reason: str


class _TrackRecord(_Exactly):
    stated: Interval
    cases: Count
    right: Count
    share: Probability
    interval: Interval
    of: str


class _Row(_Exactly):
    output: str
    row: Count
    gap: float
    gap_sd: float
    probability: Probability
    used: Literal[False] | None = None
    reason: str | None = None


class _Region(_Somewhere):
    gap: float
    probability: Probability


class _Shrink(_Exactly):
    rmse_before: float
    rmse_after: float
    fraction: float
    interval: Interval
    noise_floor: float


class _Next(_Exactly):
    separates: list[str]
    conditions: dict[str, float | str]
    gain_nats: float


class Diagnosis(_Exactly):
    """`diagnosis.json` of a diagnosis folder."""

    schema_: Literal["calib/diagnosis/1"] = Field(alias="schema")
    data_label: str | None = None
    verdict: Literal["effect", "none", "unknown", "ambiguous"]
    effects: list[_Hypothesis]
    track_record: _TrackRecord | None = None  # not in files of before
    inclusion: dict[str, _Cause]
    remainder: _Remainder
    not_testable: list[_NotTestable]
    where: list[_Row]
    regions: list[_Region]
    shrink: dict[str, _Shrink]
    next_measurement: list[_Next]


class _Ends(_Exactly):
    lower: float
    upper: float
    distinct: Count


class _Data(_Exactly):
    source: str
    label: str
    n: Count
    n_all: Count
    ranges: dict[str, _Ends]
    held_out: str | None


class _Prior(_Exactly):
    unit: str
    distribution: str
    reason: str
    source: str


class _Posterior(_Exactly):
    unit: str
    mean: float
    sd: float
    median: float
    hdi_lower: float
    hdi_upper: float
    ess_bulk: float
    ess_tail: float
    rhat: float
    mcse_mean: float | None
    mcse_median: float | None
    mcse_hdi_lower: float | None
    mcse_hdi_upper: float | None
    posterior_to_prior_sd: float | None


class _Result(_Exactly):
    model: str
    output: str
    data: _Data
    references: dict[str, float]
    noise: dict[str, Any] | None = None
    warnings: list[str] = []
    estimates: dict[str, dict[str, float | None]]
    fit: dict[str, dict[str, Any]]
    by_pressure: dict[str, dict[str, dict[str, float | None]]]
    priors: dict[str, _Prior]
    posterior: dict[str, _Posterior]
    prior_sensitivity: dict[str, Any]
    validation: dict[str, Any]
    sampling: dict[str, Any]


class _Failed(_Exactly):
    model: str
    error: str


class Summary(BaseModel):
    """`summary.json` of a report folder; a source's own sections stand beside these keys."""

    schema_: Literal["calib/summary/1"] = Field(alias="schema")
    seed: Count
    models: dict[str, _Result | _Failed]


class _Coverage(_Exactly):
    proportion: float | None
    standard_error: float | None
    interval: list[float | None]
    measurements: Count
    campaigns: Count
    p: float | None
    p_adjusted: float | None


class _Ranked(_Exactly):
    p: float | None
    p_adjusted: float | None
    p_with_not_converged: float | None
    pit: list[float]


class _Tested(_Exactly):
    design: str
    replicates: Count
    failed: dict[str, str]
    not_converged: Count
    extended: Count
    prior_draws: Count
    held_out_without_band: Count
    coverage: dict[str, _Coverage]
    quantities: dict[str, _Ranked]


class Sbc(_Exactly):
    """`sbc.json` of simulation-based calibration."""

    schema_: Literal["calib/sbc/1"] = Field(alias="schema")
    seed: Count
    simulations: Count
    settings: dict[str, Any]
    alarms: list[Any]
    models: dict[str, _Tested]


class _Both(_Exactly):
    there: str
    here: str


class _Item(BaseModel):
    group: str
    name: str
    status: str
    recorded: Any
    found: Any
    allowed: Any
    note: str


class Check(_Exactly):
    """What `calib check --json` prints of a folder that can be checked."""

    schema_: Literal["calib/check/1"] = Field(alias="schema")
    folder: str
    kind: Literal["report", "run", "comparison", "diagnosis"]
    quick: bool
    verdict: Literal["same", "different"]
    headline: str
    exit_code: Literal[0, 1]
    counts: dict[str, Count]
    environment: dict[str, _Both]
    allowed: str
    not_converged: list[str]
    items: list[_Item]


class _Task(_Exactly):
    kind: str
    state: Literal["done", "failed", "missing"]
    error: str | None = None
    numbers: dict[str, Any] | None = None


class Campaign(_Exactly):
    """`summary.json` of a campaign folder."""

    schema_: Literal["calib/campaign/1"] = Field(alias="schema")
    counts: dict[Literal["done", "failed", "missing"], Count]
    tasks: dict[str, _Task]


RESULTS = {
    "case": CaseFile, "diagnosis": Diagnosis, "summary": Summary, "sbc": Sbc, "check": Check,
    "campaign": Campaign,
}  # fmt: skip
