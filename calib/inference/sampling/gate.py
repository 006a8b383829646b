"""The convergence gate that every posterior passes before it is shown as one."""

from __future__ import annotations

from dataclasses import dataclass

from calib.data.numbers import plain_number
from calib.inference.diagnostics import convergence
from calib.models.base import Array

# R-hat compares ensembles: of fewer it says little.
LEAST_ENSEMBLES = 4


@dataclass(frozen=True)
class Gate:
    """What a set of ensembles must reach, for every parameter.

    Rank-normalised split R-hat between ensembles (Vehtari et al. 2021, doi:10.1214/20-BA1221), bulk
    and tail effective sample size, and length in integrated autocorrelation times.
    """

    rhat_max: float = 1.01
    ess_min: float = 400.0
    taus_min: float = 50.0


@dataclass(frozen=True)
class GateReport:
    """Convergence figures of each parameter, arrays of shape (d,), and the verdict."""

    names: tuple[str, ...]
    rhat: Array
    ess_bulk: Array
    ess_tail: Array
    tau: Array
    steps: int
    passed: bool
    reasons: tuple[str, ...]


def judge(
    draws: Array,
    names: tuple[str, ...],
    gate: Gate,
    *,
    tau: Array,
    steps: int | None = None,
    min_ensembles: int = LEAST_ENSEMBLES,
) -> GateReport:
    """Judge draws of independently seeded ensembles, shape (ensembles, walkers, steps, d).

    `tau` (d,) is the integrated autocorrelation time in steps, the worst of the ensembles; `steps`
    the length of the chain that was run, that of the draws if it is not thinned.
    """
    ensembles = draws.shape[0]
    steps = draws.shape[2] if steps is None else steps
    found = convergence(draws)
    r, bulk, tail = found.rhat, found.ess_bulk, found.ess_tail
    reasons = []
    if ensembles < min_ensembles:
        reasons.append(f"{ensembles} ensembles, at least {min_ensembles} are needed")
    # Written so that NaN fails.
    for label, value, good, limit in (
        ("R-hat", r, r <= gate.rhat_max, f"at most {gate.rhat_max}"),
        ("bulk ESS", bulk, bulk >= gate.ess_min, f"at least {gate.ess_min:.0f}"),
        ("tail ESS", tail, tail >= gate.ess_min, f"at least {gate.ess_min:.0f}"),
        ("steps/tau", steps / tau, steps / tau >= gate.taus_min, f"at least {gate.taus_min:.0f}"),
    ):
        for name, v, ok in zip(names, value, good, strict=True):
            if not ok:
                reasons.append(f"{label} of {name} is {plain_number(v, 4)}, {limit} is needed")
    return GateReport(names, r, bulk, tail, tau, steps, not reasons, tuple(reasons))
