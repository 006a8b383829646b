"""Make a blind test: cases, their withheld answers, and the hash of each in its case."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np

from calib.batch.tasks import completed
from calib.errors import CalibError
from challenge.build import try_case, unlisted_order
from challenge.design import TIERS, Tier
from challenge.effects import LISTED, wheel_effects
from challenge.files import CaseFiles, case_files
from challenge.mechanism import NONE, SHIFT, UNKNOWN
from challenge.seal import check_new, new_folder, write_case

type Progress = Callable[[int, int], None]
type Job = tuple[np.random.SeedSequence, Tier, str]

NULL_FRACTION, UNKNOWN_FRACTION, SHIFT_FRACTION = 1.0 / 3.0, 1.0 / 8.0, 1.0 / 10.0
# Of the listed effects' cases, those of two and of three at once.
PAIR_FRACTION: Mapping[Tier, float] = {"easy": 0.0, "hard": 0.5, "large": 0.35}
TRIPLE_FRACTION: Mapping[Tier, float] = {"easy": 0.0, "hard": 0.0, "large": 0.15}
_TRIES = 60
_FALLBACKS = 12


def plan(
    rng: np.random.Generator,
    n_cases: int,
    tiers: tuple[Tier, ...],
    null_fraction: float = NULL_FRACTION,
) -> list[tuple[Tier, str]]:
    """Return tier and truth of every case, in random order within each tier.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    n_cases : int
        Number of cases, shared evenly among the tiers, the earlier tier first.
    tiers : tuple of str
        Of `TIERS`.
    null_fraction : float
        Share of cases without any effect.
    """
    planned: list[tuple[Tier, str]] = []
    for i, tier in enumerate(tiers):
        count = n_cases // len(tiers) + (1 if i < n_cases % len(tiers) else 0)
        truths = _truths(rng, count, tier, null_fraction)
        planned += [(tier, truths[j]) for j in rng.permutation(count)]
    return planned


def _truths(rng: np.random.Generator, count: int, tier: Tier, null_fraction: float) -> list[str]:
    # No null is large, nor is a shift of plausible parameters.
    nulls = 0 if tier == "large" else round(null_fraction * count)
    shift = 0 if tier == "large" else round(SHIFT_FRACTION * count)
    unknown = round(UNKNOWN_FRACTION * count)
    fixed = [NONE] * nulls + [UNKNOWN] * unknown + [SHIFT] * shift
    listed = count - len(fixed)
    pairs, triples = (round(part[tier] * listed) for part in (PAIR_FRACTION, TRIPLE_FRACTION))
    truths = fixed + [_draw_several(rng, 2) for _ in range(pairs)]
    truths += [_draw_several(rng, 3) for _ in range(triples)]
    while len(truths) < count:
        truths += [str(name) for name in rng.permutation(list(LISTED))]
    return truths[:count]


def _draw_several(rng: np.random.Generator, count: int) -> str:
    drawn = rng.choice(wheel_effects(), size=count, replace=False)
    return "+".join(sorted(str(name) for name in drawn))


def _draw_like(rng: np.random.Generator, truth: str) -> str:
    """Draw another truth of the same class, for one that no design seems to show."""
    if truth in (NONE, UNKNOWN, SHIFT):
        return truth
    count = 1 + truth.count("+")
    return _draw_several(rng, count) if count > 1 else str(rng.choice(list(LISTED)))


def make_case(seed: np.random.SeedSequence, tier: Tier, truth: str) -> CaseFiles:
    """Return one case, the same for the same seed.

    Parameters
    ----------
    seed : numpy.random.SeedSequence
        The case's own seed.
    tier, truth : str
        Level of difficulty and what happens in the field; where no design shows an effect,
        another of the same class takes its place.

    Raises
    ------
    CalibError
        If no fair case is found.
    """
    rng = np.random.default_rng(seed)
    unlisted = unlisted_order(rng)
    wanted = truth
    for i in range(_FALLBACKS):
        for _ in range(_TRIES):
            case = try_case(rng, tier, wanted, unlisted[i % len(unlisted)])
            if case is not None:
                return case_files(rng, case)
        wanted = _draw_like(rng, truth)
    raise CalibError(
        f"no fair {tier} case of {truth} in {_TRIES * _FALLBACKS} draws",
        hint="use another seed",
    )


def case_jobs(
    seed: int, n_cases: int, tiers: tuple[Tier, ...], null_fraction: float = NULL_FRACTION
) -> dict[str, Job]:
    """Return what each case of a blind test is made from, by name.

    Parameters
    ----------
    seed, n_cases, tiers, null_fraction
        As for `make`.

    Raises
    ------
    CalibError
        If a number will not do.
    """
    if n_cases < 1:
        raise CalibError(f"{n_cases} cases were asked for", expected="1 or more")
    if not tiers or not set(tiers) <= set(TIERS):
        raise CalibError(f"unknown tiers {tiers}", expected=", ".join(TIERS))
    if not 0.0 <= null_fraction <= 0.7:
        raise CalibError(f"null_fraction is {null_fraction}", expected="0 to 0.7")
    planning, *own = np.random.SeedSequence(seed).spawn(n_cases + 1)
    planned = plan(np.random.default_rng(planning), n_cases, tiers, null_fraction)
    jobs = zip(own, planned, strict=True)
    return {f"case-{i:03d}": (s, *job) for i, (s, job) in enumerate(jobs)}


def make_job(job: Job) -> CaseFiles:
    """Return the case of a job."""
    return make_case(*job)


def make(
    out_dir: Path,
    answers_dir: Path,
    *,
    seed: int,
    n_cases: int,
    tiers: tuple[Tier, ...] = ("easy", "hard"),
    null_fraction: float = NULL_FRACTION,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> None:
    """Write a blind test.

    Parameters
    ----------
    out_dir : Path
        Folder for ``case-000/`` and so on; new or empty.
    answers_dir : Path
        Folder for ``case-000/answer.json`` and so on, outside `out_dir`; new or empty.
    seed : int
        Seed of everything; kept in the answers only, since it gives them away.
    n_cases : int
        Number of cases.
    tiers : tuple of str
        Of `TIERS`.
    null_fraction : float
        Share of cases without any effect.
    workers, scheduler
        As for `calib.batch.tasks.completed`; the result does not depend on them.
    progress : callable, optional
        Called with the number of cases done and their total.

    Raises
    ------
    CalibError
        If a path or a number will not do.
    """
    check_new(out_dir, answers_dir)
    jobs = case_jobs(seed, n_cases, tiers, null_fraction)
    done = 0
    with (
        new_folder(out_dir),
        closing(completed(make_job, jobs, workers=workers, scheduler=scheduler)) as coming,
    ):
        for task in coming:
            if task.result is None:
                raise CalibError(f"{task.name} could not be made: {task.error}")
            answer = task.result.answer | {"seed": seed}
            write_case(out_dir / task.name, task.result.files, answers_dir, answer)
            done += 1
            if progress is not None:
                progress(done, n_cases)
