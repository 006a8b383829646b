"""How a simulator is emulated, and what became of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from calib.errors import CalibError
from calib.inference.problem import Problem
from calib.models.base import Array
from calib.models.simulators.emulator import Emulator
from calib.models.simulators.runs import Run

# What is being done, how much of it is done, and of how much.
type Progress = Callable[[str, int, int], None]

_CHECKS = 20


@dataclass(frozen=True)
class EmulationSettings:
    """How many runs an emulator may take, and how good it has to be.

    Parameters
    ----------
    runs : int
        At most, whatever they are made for, those of an earlier call with the same cache among
        them. A run that is tried again after it failed counts once.
    first : int, optional
        Of the space-filling design over the prior; ten for each parameter by default.
    checks : int, optional
        Runs at draws of the posterior that the emulator is checked on before it sees them, a fifth
        of all at most; 20 by default, or the fifth.
    tolerance : float
        Largest rms error of the emulator over rows and posterior, in sds of the noise. It is
        checked when somewhat less is expected. At 0.1 the error adds 1 % to the variance of a
        reading; it is in the likelihood besides.
    nodes : int, optional
        Conditions at which each run is evaluated, see `calib.inference.emulation.nodes`.
    sequential : bool
        Whether points are put where the posterior needs them; else the whole budget is one
        Latin hypercube over the prior.
    """

    runs: int = 200
    first: int | None = None
    checks: int | None = None
    tolerance: float = 0.1
    nodes: int | None = None
    sequential: bool = True

    def __post_init__(self) -> None:
        for key, found, most, why in (
            ("checks", self.checks, self.runs // 5, "a fifth of the runs"),
            ("first", self.first, self.runs - self.checks_of(self.runs),
             "the runs less those that it is checked on"),
        ):  # fmt: skip
            if found is not None and found > most:
                raise CalibError(
                    f"{key} = {found} is more than runs = {self.runs} leaves room for",
                    where=f"emulator.{key}", expected=f"at most {most}, {why}",
                    hint="lower it, or give more runs",
                )  # fmt: skip

    def checks_of(self, most: int) -> int:
        """How many of so many runs are kept for the check."""
        wanted = _CHECKS if self.checks is None else self.checks
        return min(wanted, most // 5) if self.sequential else 0

    def repeats(self, deterministic: bool) -> tuple[int, int]:
        """How many of the first runs are made again, to see whether they differ, and how often."""
        return (1, 1) if deterministic else (min(5, max(self.runs // 10, 1)), 2)

    def spread(self, free: int, deterministic: bool, made: int = 1) -> int:
        """How many runs are spread over the prior of so many parameters, where some are made."""
        runs, times = self.repeats(deterministic)
        most = max(self.runs - made - runs * times - self.checks_of(self.runs), 1)
        return min(self.first or 10 * free, most) if self.sequential else most


@dataclass(frozen=True)
class HeldOut:
    """The emulator against runs that it had not seen, at draws of the posterior.

    The rms error is over runs and rows, in sds of the noise. `z` are errors of the coefficients in
    their predicted sds, `pit` where these lie in their predicted distributions (even from 0 to 1 if
    the emulator knows its error), `covered` the share within central 90 % intervals, `errors` are
    those at the data's rows, (runs, n), on the scale of the response.
    """

    runs: int
    rmse: float
    z: Array
    pit: Array
    covered: float
    errors: Array


@dataclass(frozen=True)
class Emulation:
    """A problem whose simulator is emulated, and how well.

    Parameters
    ----------
    problem : Problem
        To be calibrated: its model is the emulator.
    runs : tuple of Run
        All that were asked for: probes, repeats and those that failed among them.
    held_out : HeldOut, optional
        None where no run was left for it.
    expected : float
        The error that the emulator itself expects, as `HeldOut.rmse`.
    between : float
        Rms error at conditions between the nodes, in sds of the noise.
    own_noise : float
        Sd of the simulator's own noise on the scale of the response; zero if it is deterministic.
    passed : bool
        Whether the emulator is good enough.
    reasons : tuple of str
        Why not.
    history : tuple of (int, float)
        Runs, and the expected error then.
    extended : bool
        Whether an emulator that was there serves another campaign, to which the runs were added.
    wider : mapping of str to float
        How many times as wide the posterior of each parameter is for the emulator's error, which
        is in the likelihood (to first order).
    shifted : mapping of str to float
        By how many of its posterior sds errors as those on runs not seen shift it (rms).
    """

    problem: Problem
    emulator: Emulator
    runs: tuple[Run, ...]
    held_out: HeldOut | None
    expected: float
    between: float
    own_noise: float
    passed: bool
    reasons: tuple[str, ...]
    history: tuple[tuple[int, float], ...]
    extended: bool = False
    wider: Mapping[str, float] = field(default_factory=dict)
    shifted: Mapping[str, float] = field(default_factory=dict)

    @property
    def failed(self) -> tuple[Run, ...]:
        """Runs without a value."""
        return tuple(run for run in self.runs if not run.ok)

    def document(self) -> Mapping[str, Any]:
        """Return it for JSON."""
        h = self.held_out
        return {
            "runs": len(self.runs),
            "nodes": next(iter(self.emulator.training.nodes.values())).size,
            "curves": len(self.emulator.curves),
            "expected_error_in_noise_sds": self.expected,
            "between_nodes_error_in_noise_sds": self.between,
            "simulator_noise_sd": self.own_noise,
            "passed": self.passed,
            "reasons": list(self.reasons),
            "posterior_times_as_wide": dict(self.wider),
            "posterior_shifted_by_sds": dict(self.shifted),
            "history": [list(entry) for entry in self.history],
            "held_out": None if h is None else {
                "runs": h.runs, "rmse_in_noise_sds": h.rmse,
                "covered_90": h.covered, "pit": h.pit.tolist(),
            },
            "failed": [
                {"parameters": r.theta.tolist(), "kind": r.failure.kind,
                 "reason": r.failure.reason, "printed": r.failure.printed}
                for r in self.failed if r.failure is not None
            ],
        }  # fmt: skip
