"""The limit of a blind test: how far the oracle gets on its cases, beside any diagnosis."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.tasks import LateItems, run_tasks
from calib.challenge.answers import CaseAnswer
from calib.challenge.design import Tier
from calib.challenge.mechanism import NONE, UNKNOWN
from calib.challenge.oracle.case import CaseItem, examine, read_item
from calib.challenge.oracle.combine import errors, probabilities
from calib.challenge.score import TierScore, score_tier
from calib.challenge.seal import check_outside, open_key, published_hash
from calib.errors import CalibError

LIMIT_SCHEMA = "calib/challenge-limit/1"
LIMIT_NAME = "limit.json"
_TIERS: tuple[Tier, ...] = ("easy", "hard")
_NAMED = 0.5  # a hypothesis is named from this probability on, as a diagnosis names it
_DIGITS = 6


@dataclass(frozen=True)
class Limit:
    """What the oracle says of the cases of a blind test.

    Attributes
    ----------
    answers : dict
        Case to its answer with the soil known from the lab's data only.
    known_soil : dict
        Case to its answer with the soil known.
    errors : dict
        Case to the Monte Carlo standard error of the truth's probability.
    seed, effort : int
        Where and how closely the oracle looked.
    """

    answers: dict[str, CaseAnswer]
    known_soil: dict[str, CaseAnswer]
    errors: dict[str, float]
    seed: int
    effort: int

    def of(self, cases: Collection[str]) -> Limit:
        """Return the limit of some of the cases."""
        return replace(
            self,
            answers={name: a for name, a in self.answers.items() if name in cases},
            known_soil={name: a for name, a in self.known_soil.items() if name in cases},
            errors={name: e for name, e in self.errors.items() if name in cases},
        )

    def tier(self, tier: str) -> TierScore:
        """Return the oracle's figures of merit in a tier, those of its probabilities only."""
        return _score(self.answers, tier)

    def tier_known_soil(self, tier: str) -> TierScore:
        """Return the same for one who knows the soil."""
        return _score(self.known_soil, tier)

    def expected_first(self, tier: str) -> float:
        """Return how often the oracle expects to name the truth first where there is a gap.

        By its own probabilities, not by the key: without the luck of these cases' noise.
        """
        right, gaps = 0.0, 0.0
        for answer in self.answers.values():
            if answer.tier == tier:
                shares = dict(answer.ranked)
                gaps += 1.0 - shares.get(NONE, 0.0)
                right += 0.0 if answer.called == NONE else answer.confidence
        return right / gaps if gaps else float("nan")


def _score(answers: Mapping[str, CaseAnswer], tier: str) -> TierScore:
    return score_tier(tier, [answer for answer in answers.values() if answer.tier == tier])


def find_limit(
    cases_dir: Path,
    key_path: Path,
    out: Path,
    *,
    seed: int = 1,
    effort: int = 1,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> Path:
    """Ask the oracle about every case, and write what it says.

    Parameters
    ----------
    cases_dir : Path
        Folder that `calib.challenge.make.make` wrote.
    key_path : Path
        The sealed key.
    out : Path
        Folder for `LIMIT_NAME` and, beside it, one file per case; what is there of the same key,
        seed and effort is not done again. It gives the answers away.
    seed : int
        Of the places where the oracle looks.
    effort : int
        Multiplies their number.
    workers, scheduler, progress, announce
        As for `calib.batch.tasks.run_tasks`.

    Returns
    -------
    Path
        Of `LIMIT_NAME`.

    Raises
    ------
    CalibError
        If the key is not that of the cases, `out` lies among them, or a case fails.
    """
    check_outside(cases_dir, out)
    entries = open_key(cases_dir, key_path)["cases"]
    digest = published_hash(cases_dir)
    parts = out / f"cases-{digest[:12]}-{seed}-{effort}"

    def read(name: str) -> CaseItem:
        return read_item(cases_dir / name, entries[name])

    outcome = run_tasks(
        partial(examine, seed=seed, effort=effort),
        LateItems({name: name for name in entries}, read),
        parts, workers=workers, scheduler=scheduler, progress=progress, announce=announce,
    )  # fmt: skip
    for name, error in outcome.failed.items():
        raise CalibError(f"the oracle failed on {name} and {len(outcome.failed) - 1} more: {error}")
    found = {
        name: json.loads((parts / f"{name}.json").read_text(encoding="utf-8")) for name in entries
    }
    path = out / LIMIT_NAME
    content = {
        "schema": LIMIT_SCHEMA, "key_sha256": digest, "seed": seed, "effort": effort,
        "cases": _combined(found),
    }  # fmt: skip
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path


def _combined(found: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return every case's probabilities, those that are not zero to six digits."""
    cases: dict[str, Any] = {}
    for tier in _TIERS:
        part = {name: case for name, case in found.items() if case["tier"] == tier}
        if not part:
            continue
        after_lab, known = (
            probabilities(part, tier, which) for which in ("log_evidence", "known_soil")
        )
        error = errors(part, tier)
        for name, case in part.items():
            cases[name] = {
                "tier": tier,
                "truth": case["truth"],
                "outputs": case["outputs"],
                "probabilities": _rounded(after_lab[name]),
                "known_soil": _rounded(known[name]),
                "error": round(error[name], _DIGITS),
            }
    return {name: cases[name] for name in found}


def _rounded(shares: Mapping[str, float]) -> dict[str, float]:
    rounded = {name: round(share, _DIGITS) for name, share in shares.items()}
    kept = [name for name in rounded if rounded[name] > 0.0]
    return {name: rounded[name] for name in sorted(kept, key=lambda name: -rounded[name])}


def read_limit(path: Path, cases_dir: Path) -> Limit:
    """Return the limit of a blind test.

    Parameters
    ----------
    path : Path
        `LIMIT_NAME` as `find_limit` wrote it.
    cases_dir : Path
        The cases, whose published hash says whether it is theirs.

    Raises
    ------
    CalibError
        If it cannot be read, or is that of other cases.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        schema, digest = content["schema"], content["key_sha256"]
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise CalibError(
            f"the limit cannot be read ({type(problem).__name__})",
            where=str(path),
            mend="write it with `calib challenge limit`",
        ) from problem
    if schema != LIMIT_SCHEMA or digest != published_hash(cases_dir):
        raise CalibError(
            "the limit is that of other cases",
            where=str(path),
            mend="write that of these cases with `calib challenge limit`",
        )
    cases = content["cases"]
    return Limit(
        answers={name: _answer(name, case, "probabilities") for name, case in cases.items()},
        known_soil={name: _answer(name, case, "known_soil") for name, case in cases.items()},
        errors={name: float(case["error"]) for name, case in cases.items()},
        seed=int(content["seed"]),
        effort=int(content["effort"]),
    )


def _answer(name: str, case: Mapping[str, Any], which: str) -> CaseAnswer:
    ranked = tuple((str(h), float(p)) for h, p in case[which].items())
    best, share = ranked[0]
    verdict = best if best in (NONE, UNKNOWN) else "effect"
    verdict = "ambiguous" if share < _NAMED else verdict
    outputs = tuple(case["outputs"])
    return CaseAnswer(name, case["tier"], case["truth"], verdict, ranked, None, (), outputs)


def rms_error(limit: Limit) -> float:
    """Return the rms over cases of the Monte Carlo error of the truth's probability."""
    return float(np.sqrt(np.mean(np.square(list(limit.errors.values())))))
