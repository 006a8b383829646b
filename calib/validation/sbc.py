"""Simulation-based calibration: whether posteriors and bands are right where the truth is known.

Parameters are drawn from the prior, data from the parameters, and the posterior of those data is
sampled exactly as a user's would be. If prior, likelihood and sampler agree, the rank of the truth
among posterior draws is uniform for every quantity [3]_ [4]_.

The statistic is the smallest pointwise binomial tail of the ECDF over its evaluation points
(Saeilynoja, Buerkner & Vehtari 2022). Bands come from ArviZ, which simulates the statistic; the
p value is exact, so that it can be corrected for many quantities.

References
----------
.. [1] Saeilynoja, Buerkner & Vehtari (2022), doi:10.1007/s11222-022-10090-6.
.. [2] Moscovich & Nadler (2017), doi:10.1016/j.spl.2016.11.027: the Poisson recursion.
.. [3] Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788.
.. [4] Modrak, Moon, Kim, Buerkner, Huurre, Faltejskova, Gelman & Vehtari (2023),
   doi:10.1214/23-BA1404.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom, norm, poisson

from calib.batch.folders import check_room, write_whole, writing
from calib.batch.tasks import run_tasks
from calib.data.files import read_text
from calib.errors import CalibError
from calib.inference.prior_files import DeclaredPriors, prior_file_model
from calib.inference.random import generator
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, get_model
from calib.models.base import Array
from calib.models.simulators.declaration import slow_simulator
from calib.validation.constants import LEVEL, LEVELS
from calib.validation.replicate import Item, design_of, most_runs, replicate
from calib.validation.scores import holm


@dataclass(frozen=True)
class EcdfBand:
    """ECDF of probability integral transforms, its simultaneous band; arrays of shape (n + 1,)."""

    x: Array
    ecdf: Array
    lower: Array
    upper: Array


def pit(ranks: Sequence[Sequence[int]], rng: np.random.Generator) -> Array:
    """Turn ranks (draws below the truth, and draws) into what is uniform on (0, 1) if all is right.

    Each rank is spread over its share of the interval, so that they are uniform exactly.
    """
    below, draws = np.array(ranks, dtype=float).reshape(-1, 2).T
    return np.asarray((below + rng.uniform(size=below.size)) / (draws + 1.0))


def ecdf_band(values: Array, level: float) -> EcdfBand:
    """ECDF of values (n,) and the band that holds a uniform sample's with a probability."""
    ecdf_pit: Any = import_module("arviz_stats.ecdf_utils").ecdf_pit

    # The same random numbers every time: the band is a property of n and the level.
    return EcdfBand(*ecdf_pit(values, level, 4000, rng=np.random.default_rng(1)))


def p_value(values: Array) -> float:
    """Probability that as many uniform values (n,) leave the band by as much, exactly."""
    n = values.size
    z = np.arange(1, n) / n
    counts = np.searchsorted(np.sort(values), z, side="right")
    tails = np.minimum(binom.cdf(counts, n, z), binom.sf(counts - 1, n, z))
    return _p_of_tail(n, float(tails.min()))


@cache
def _p_of_tail(n: int, tail: float) -> float:
    """Probability that the smallest pointwise tail of n uniform values is no larger."""
    z = np.arange(1, n) / n
    k = np.arange(n + 1)
    # The observed tail itself must count, whatever its last bit.
    limit = tail * (1.0 + 1e-9)
    inside = (binom.cdf(k, n, z[:, None]) > limit) & (binom.sf(k - 1, n, z[:, None]) > limit)
    # Counts of n uniform values are those of a Poisson process of rate n, given n in all.
    # A Poisson variable of mean one exceeds 60 with probability below 1e-80.
    jump = poisson.pmf(np.arange(min(60, n + 1)), 1.0)
    mass = np.zeros(n + 1)
    mass[0] = 1.0
    for allowed in np.asarray(inside):
        mass = np.convolve(mass, jump)[: n + 1] * allowed
    stays = np.convolve(mass, jump)[n] / poisson.pmf(n, n)
    return float(np.clip(1.0 - stays, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class Quantity:
    """One quantity whose truth was ranked.

    Parameters
    ----------
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
        former are left out of ranks and coverage, as a user is warned not to use them: a choice
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
    """Score the records of a run, as `calib.validation.replicate.replicate` returns them.

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
        seed,
        simulations,
        tuple(
            score_model(
                [r for r in records if r["model"] == model],
                {n: e for n, e in errors.items() if n.rpartition("-")[0] == model},
            )
            for model in models
        ),
    )


def score_model(
    records: Sequence[Mapping[str, Any]], failed: Mapping[str, str] | None = None
) -> ModelScore:
    """Score the records of one model."""
    model, seed = records[0]["model"], records[0]["seed"]
    good = [r for r in records if r["converged"]]
    if len(good) < 2:  # of a single rank there is no distribution
        raise CalibError(
            f"{len(good)} of {len(records)} posteriors of {model} converged: nothing can be told",
            expected="2 or more that converged",
            hint="simulate more campaigns, or leave the model out; those that are done are kept",
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


# As for a report, but a chain is extended to 3200 steps, not 25,600, before it counts as one that
# did not converge: simulated campaigns are many, and some tell next to nothing.
SETTINGS = SamplerSettings(max_steps=3200)


def run_sbc(
    out: Path,
    *,
    models: Sequence[str] = (),
    simulations: int = 300,
    seed: int,
    settings: SamplerSettings = SETTINGS,
    priors: Sequence[Path] = (),
    data: Path | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> SbcScore:
    """Simulate, calibrate and rank; what is there already is not done again.

    The folder's ``replicates`` gets one JSON file for each replicate of each model, by default of
    all that are not slow. A prior file says which model it is for; `data`, a CSV, at which
    conditions to simulate, if not at those of the models' examples. The others are as for
    `calib.batch.tasks.run_tasks`. With a slow simulator among the models campaigns are done one
    after the other, and `workers` or `scheduler` make its runs: they share one folder of runs.

    Raises
    ------
    CalibError
        If there is no such model, it is a table of runs, or the folder holds a run of another seed
        or other settings.
    """
    names = chosen_models(models)
    # As text: replicates may run where the files are not.
    given = {prior_file_model(p): DeclaredPriors(p.name, read_text(p)) for p in priors}
    if unused := [model for model in given if model not in names]:
        raise CalibError(
            f"there are priors of {', '.join(unused)}, which is not among the models",
            expected=", ".join(names),
            hint="name it with --model, or leave its priors out",
        )
    said: dict[str, Any] = (
        {"priors": {model: p.text for model, p in given.items()}} if given else {}
    )
    slow = {model: found for model in names if (found := slow_simulator(model)) is not None}
    asked = [*slow] if data is None else names
    designs = {model: design_of(model, data) for model in asked}
    if data is not None:
        said["data"] = read_text(Path(data))
    told = [most_runs(m, found, designs[m], simulations) for m, found in slow.items()]
    _claim(out, {"seed": seed, "settings": asdict(settings), **said})
    if announce is not None:
        for line in told:
            announce(line)
    spread: dict[str, Any] = {"workers": workers, "scheduler": scheduler}
    items = {
        f"{model}-{i:04d}": Item(
            model, i, seed, settings, given.get(model), None if data is None else designs[model],
            **(spread if model in slow else {}),
        )
        for model in names
        for i in range(simulations)
    }  # fmt: skip
    outcome = run_tasks(
        replicate, items, out / "replicates", **({} if slow else spread),
        progress=progress, announce=announce,
    )  # fmt: skip
    records = [json.loads((out / "replicates" / f"{n}.json").read_bytes()) for n in outcome.done]
    return score(records, seed, simulations, outcome.failed)


def chosen_models(models: Sequence[str] = ()) -> list[str]:
    """Return the names of models, which must be known; of all that are not slow by default."""
    named = [get_model(name).name for name in models]
    return named or [m.name for m in MODELS.values() if not m.slow]


def _claim(out: Path, run: dict[str, Any]) -> None:
    """Write what is run into the folder, or check that it is the same that is there."""
    check_room(out)
    path = out / "run.json"
    text = json.dumps(run, indent=1) + "\n"
    with writing(out):
        if path.exists():
            if path.read_text(encoding="utf-8") != text:
                raise CalibError(
                    "the folder holds replicates of another seed, other sampler settings or priors",
                    where=str(path),
                    hint="choose another folder, or the seed that is there",
                )
            return
        if out.exists() and any(p.suffix != ".part" for p in out.iterdir()):
            raise CalibError(
                "the output folder exists, is not empty and holds no simulation-based calibration",
                where=str(out),
                hint="choose another folder",
            )
        out.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
