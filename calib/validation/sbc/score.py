"""From replicates to figures: whether ranks are uniform, and bands cover what they claim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import norm

from calib.errors import CalibError
from calib.inference.random import generator
from calib.models.base import Array
from calib.validation.sbc.uniformity import holm, p_value, pit
from calib.validation.scores import LEVELS

# Chance of a false alarm in all quantities and bands of a run together.
LEVEL = 0.05
# Of a single rank there is no distribution.
_FEWEST = 2


@dataclass(frozen=True, eq=False)
class Quantity:
    """One quantity whose truth was ranked.

    Parameters
    ----------
    name : str
    pit : ndarray, shape (n,)
        Probability integral transforms of the truths; uniform if all is right.
    p : float
        Of their uniformity, for this quantity alone.
    p_all : float
        The same with the replicates that did not converge among them.
    """

    name: str
    pit: Array
    p: float
    p_all: float


@dataclass(frozen=True)
class BandCoverage:
    """Coverage of one predictive band on measurements of simulated hold-outs.

    The mean over campaigns of the part of their measurements inside the band, and its standard
    error between campaigns, whose rows share a posterior; no less than that of as many independent
    rows of a band that is right, which few campaigns may fall short of.
    """

    level: float
    rows: int
    replicates: int
    proportion: float
    se: float

    @property
    def p(self) -> float:
        """Probability of a proportion as far from the level, if the band is right."""
        if not self.rows:
            return 1.0
        return float(2.0 * norm.sf(abs(self.proportion - self.level) / self.se))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the proportion."""
        half = float(norm.ppf(0.975)) * self.se
        return max(0.0, self.proportion - half), min(1.0, self.proportion + half)


@dataclass(frozen=True)
class ModelScore:
    """Everything that was found for a model.

    Parameters
    ----------
    design : str
        Where it was measured, in words.
    unconverged, extended : int
        Posteriors that did not pass the gate even when extended, and all that were extended. The
        former are left out of ranks and coverage, as a user is told not to use them: a choice
        made from data and chains alone, which keeps ranks uniform.
    attempts : int
        Draws from the prior that were needed.
    no_band : int
        Held-out measurements for which no band was given.
    failed : mapping of str to str
        Replicates that ended with an error.
    """

    model: str
    design: str
    replicates: int
    unconverged: int
    extended: int
    attempts: int
    no_band: int
    quantities: tuple[Quantity, ...]
    coverage: tuple[BandCoverage, ...]
    failed: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SbcScore:
    """A whole run, so many simulations of each model."""

    seed: int
    simulations: int
    models: tuple[ModelScore, ...]

    @property
    def adjusted(self) -> dict[tuple[str, str], float]:
        """Adjusted p values of all quantities and bands, by model and name, family-wise."""
        raw = {(m.model, q.name): q.p for m in self.models for q in m.quantities}
        raw |= {
            (m.model, f"{100 * c.level:g} % band"): c.p for m in self.models for c in m.coverage
        }
        return dict(zip(raw, holm(list(raw.values())), strict=True))

    @property
    def alarms(self) -> dict[tuple[str, str], float]:
        """Those of `adjusted` below `LEVEL`."""
        return {key: p for key, p in self.adjusted.items() if p < LEVEL}


def score(
    records: Sequence[Mapping[str, Any]], seed: int, simulations: int,
    failed: Mapping[str, str] | None = None,
) -> SbcScore:  # fmt: skip
    """Score the records of a run, as `calib.validation.sbc.replicate.replicate` returns them.

    Errors are by the name of the replicate, which begins with its model's.

    Raises
    ------
    CalibError
        If there is no record at all, or too few posteriors of a model converged.
    """
    models = dict.fromkeys(r["model"] for r in records)
    errors = failed or {}
    if not records:
        why = next(iter(errors.values()), "none was done")
        raise CalibError(f"no simulated campaign could be calibrated: {why}")
    return SbcScore(
        seed, simulations,
        tuple(
            score_model(
                [r for r in records if r["model"] == model],
                {n: e for n, e in errors.items() if n.rpartition("-")[0] == model},
            )
            for model in models
        ),
    )  # fmt: skip


def score_model(
    records: Sequence[Mapping[str, Any]], failed: Mapping[str, str] | None = None
) -> ModelScore:
    """Score the records of one model."""
    model, seed = records[0]["model"], records[0]["seed"]
    good = [r for r in records if r["converged"]]
    if len(good) < _FEWEST:
        raise CalibError(
            f"{len(good)} of {len(records)} posteriors of {model} converged: nothing can be told",
            allowed=f"{_FEWEST} or more that converged",
            mend="simulate more campaigns, or leave the model out; those that are done are kept",
        )
    names = dict.fromkeys(name for r in records for name in r["ranks"])
    return ModelScore(
        model=model,
        design=records[0].get("design", ""),
        replicates=len(records),
        unconverged=len(records) - len(good),
        extended=sum(r["extended"] for r in records),
        attempts=sum(r["attempts"] for r in records),
        no_band=sum(r["no_band"] for r in good),
        quantities=tuple(_quantity(name, records, good, seed) for name in names),
        coverage=tuple(_coverage(level, good) for level in LEVELS),
        failed=dict(failed or {}),
    )


def _quantity(
    name: str, records: Sequence[Mapping[str, Any]], good: Sequence[Mapping[str, Any]], seed: int
) -> Quantity:
    model = records[0]["model"]

    def transforms(some: Sequence[Mapping[str, Any]]) -> Array:
        ranks = [r["ranks"][name] for r in some if name in r["ranks"]]
        return pit(ranks, generator(seed, "sbc", model, name))

    values = transforms(good)
    p_all = p_value(transforms(records)) if len(good) < len(records) else p_value(values)
    return Quantity(name, values, p_value(values), p_all)


def _coverage(level: float, records: Sequence[Mapping[str, Any]]) -> BandCoverage:
    banded = [r for r in records if r["rows"]]
    part = np.array([r["covered"][f"{100 * level:g}"] / r["rows"] for r in banded])
    rows = sum(r["rows"] for r in banded)
    between = float(part.std(ddof=1) / np.sqrt(part.size)) if part.size > 1 else 0.0
    independent = np.sqrt(level * (1.0 - level) / rows) if rows else float("nan")
    return BandCoverage(
        level=level,
        rows=rows,
        replicates=len(banded),
        proportion=float(part.mean()) if part.size else float("nan"),
        se=float(max(between, independent)),
    )
