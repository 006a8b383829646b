"""What an audit finds: a published claim, how it was tested, and a verdict with its evidence.

What is claimed and how it is tested is in `claims.toml`, in sentences that a `finding` completes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from calib.data.files import plain_number
from calib.he2019 import declared
from calib.he2019.audit.bounds import Interval
from calib.he2019.published import PUBLISHED
from calib.report.numbers import format_number
from calib.report.page.template import sentences
from calib.report.reference import Figure


def percent(fraction: float, digits: int = 3) -> str:
    """Write a fraction as a percentage."""
    return f"{format_number(100.0 * fraction, digits)} %"


class _Word(StrEnum):
    @property
    def meaning(self) -> str:
        """One sentence on what it means, if it needs one."""
        meanings: dict[str, str] = _CLAIMS["meanings"]
        return meanings.get(self.value, "")


class Verdict(_Word):
    """What a test says of a published figure."""

    CONTRADICTED = "contradicted"
    CORRECTED = "corrected"
    CONFIRMED = "confirmed"
    CONSISTENT = "consistent"
    UNTESTABLE = "cannot be tested"


class Basis(_Word):
    """What a verdict rests on; its meaning is what a reader must not conclude from it."""

    PRINTED = "printed figures alone"
    SLIPS = "printed figures and the assumed slips"
    PHYSICS = "printed figures and physical limits"
    RECONSTRUCTED = "reconstructed data"


@dataclass(frozen=True)
class Quantity:
    """A figure found (NaN if only its interval counts), its interval, and the printed figure."""

    name: str
    value: float
    unit: str = "1"
    lower: float = math.nan
    upper: float = math.nan
    interval: str = ""
    published: str = ""

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        low, high = (plain_number(end, 4) for end in (self.lower, self.upper))
        span = ""
        if not math.isnan(self.lower):
            span = f"{low} to {high}" if low != high else low
        if math.isnan(self.value):
            return f"{self.name} {span}{unit} ({self.interval})"
        around = f" ({span}, {self.interval})" if span else ""
        return f"{self.name} {plain_number(self.value, 4)}{unit}{around}"


def rounded(
    name: str, interval: Interval, unit: str = "1", published: Figure | None = None, *,
    middle: bool = True,
) -> Quantity:  # fmt: skip
    """Return what the printed digits allow, least to largest; `middle` is shown if asked."""
    low, high = float(interval.lower.min()), float(interval.upper.max())
    value = 0.5 * (low + high) if middle else math.nan
    return Quantity(name, value, unit, low, high, "rounding", published.text if published else "")


def between(
    name: str, low: float, high: float, unit: str, interval: str, published: str = ""
) -> Quantity:
    """Return a quantity of which only the interval is meant."""
    return Quantity(name, math.nan, unit, float(low), float(high), interval, published)


@dataclass(frozen=True)
class Finding:
    """One finding: what is claimed, how it was tested, the evidence, and what stays undecided.

    Its key is unique; `figures` are those it judges, by where they stand: "Table 4, 18 psi: E".
    """

    key: str
    family: str
    where: str
    figures: tuple[str, ...]
    claim: str
    test: str
    found: tuple[Quantity, ...]
    verdict: Verdict
    evidence: str
    stays_open: str
    basis: Basis

    @property
    def reconstructed(self) -> bool:
        """Whether the verdict depends on the reconstruction."""
        return self.basis is Basis.RECONSTRUCTED


def consistent_if(possible: bool) -> Verdict:
    """Return the verdict on a figure by whether the other printed figures allow it."""
    return Verdict.CONSISTENT if possible else Verdict.CONTRADICTED


def beside_rival(read: bool, rival: bool) -> Verdict:
    """Return the verdict on a reading by whether it and its rival pass a test."""
    if read:
        return Verdict.CONSISTENT if rival else Verdict.CONFIRMED
    return Verdict.CORRECTED if rival else Verdict.CONTRADICTED


def finding(
    key: str, verdict: Verdict, found: Iterable[Quantity] = (), *, claim: str = "",
    figures: Iterable[str] = (), basis: Basis | None = None, **facts: Any,
) -> Finding:  # fmt: skip
    """Judge a claim of `claims.toml`, by its key or one given apart; facts fill its sentences."""
    entry = _CLAIMS[claim or key]

    def said(part: str) -> str:
        return _said(entry.get(part, ""), verdict=verdict, **facts)

    named = (name for item in (*entry.get("figures", ()), *figures) for name in _expanded(item))
    return Finding(
        key, entry["family"], said("where"), tuple(named), said("claim"), said("test"),
        tuple(found), verdict, said("evidence"), said("stays_open"),
        basis or Basis[entry["basis"]],
    )  # fmt: skip


def _expanded(item: str) -> Iterator[str]:
    """Yield each figure of a table by itself, at every pressure where it says so."""
    source, _, names = item.partition(": ")
    psi = PUBLISHED.setup.inflation_pressures_psi if "*" in source else ("",)
    for pressure in psi:
        for name in names.split() if source.startswith("Table") else [names]:
            yield f"{source.replace('*', str(pressure))}: {name}"


def _span(interval: Interval) -> str:
    return f"{format_number(float(interval.lower))} to {format_number(float(interval.upper))}"


_CLAIMS = declared("audit/claims.toml")
_said = sentences(number=format_number, percent=percent, span=_span)
