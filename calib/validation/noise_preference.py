"""Whether the rows prefer the noise that a prior file asks for to normal noise of one sd."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.inference.calibration import Calibration, calibrate
from calib.inference.noise import NORMAL, USUAL, Noise
from calib.inference.problem import Problem
from calib.inference.sampling.sampler import Progress, SamplerSettings
from calib.validation.comparison import CLEAR, SMALL
from calib.validation.validate import Validation, leave_one_out


@dataclass(frozen=True)
class NoisePreference:
    """How much better a noise predicts rows left out than normal noise of one sd does.

    Difference of the expected log predictive densities, and its standard error. It is sound if both
    calibrations, and all without a row, passed the gate, and every row has a density. `line` is
    that of the row in the file that makes more than half of the difference; 0 if none does.
    """

    noise: Noise
    elpd: float
    se: float
    sound: bool
    line: int = 0

    @property
    def preferred(self) -> str:
        """``"chosen"``, ``"normal"``, ``"neither"``, or ``"unknown"`` where it is not sound."""
        if not self.sound:
            return "unknown"
        if abs(self.elpd) <= max(SMALL, CLEAR * self.se):
            return "neither"
        return "chosen" if self.elpd > 0.0 else "normal"

    @property
    def sentence(self) -> str:
        """What was found, in plain words."""
        chosen, usual = noise_words(self.noise), "normal noise of one standard deviation"
        if self.preferred == "unknown":
            return (
                f"Whether {chosen} is preferred to {usual} cannot be said: one of the posteriors "
                "that this rests on did not converge, or gives a row that was left out no density."
            )
        said = {
            "neither": f"The data cannot tell {chosen} from {usual}",
            "chosen": f"The data prefer {chosen} to {usual}",
            "normal": f"The data prefer {usual} to {chosen}",
        }[self.preferred]
        places = 1 if self.se >= 0.1 else 2
        text = (
            f"{said} (elpd by leave-one-out {self.elpd:+.{places}f}, standard error "
            f"{self.se:.{places}f})."
        )
        if self.line and abs(self.elpd) > SMALL:
            text += (
                f" More than half of that is line {self.line} of the file alone, so that the "
                "standard error says little: look at this reading first."
            )
        return text


def noise_words(noise: Noise) -> str:
    """Name a noise in plain words."""
    law = "Student-t noise" if noise.student else "normal noise"
    along = noise.choice.correlated_along
    said = [f"depends on {noise.choice.depends_on}"] * bool(noise.column)
    said += [f"is correlated along {along}"] * bool(along)
    return f"{law} that {' and '.join(said)}" if said else law


def with_usual_noise(problem: Problem) -> Problem:
    """Return a problem with normal noise of one standard deviation, and the same other priors."""
    left_out = problem.noise.choice.parameters
    kept = tuple(p for p in problem.priors.entries if p.name not in left_out)
    return replace(problem, noise=NORMAL, priors=replace(problem.priors, entries=kept, noise=USUAL))


def noise_preference(
    calibration: Calibration,
    *,
    loo: Validation | None = None,
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
    workers: int = 1,
) -> NoisePreference | None:
    """Compare the noise of a calibration with normal noise of one sd by leave-one-out.

    None where the noise is that of all by default. `loo` is of the calibration, where it was left
    one out already; settings are for the other calibration and the refits.

    References
    ----------
    Vehtari, Gelman & Gabry (2017), doi:10.1007/s11222-016-9696-4.
    """
    problem = calibration.problem
    if problem.noise.usual:
        return None
    usual = calibrate(
        with_usual_noise(problem), calibration.seed, label=f"{calibration.label} normal noise",
        estimates=calibration.estimates, settings=settings,
    )  # fmt: skip
    parts = [
        leave_one_out(c, settings=settings, progress=progress, workers=workers)
        if done is None else done
        for c, done in ((calibration, loo), (usual, None))
    ]  # fmt: skip
    rows = [np.full(p.observed.size, np.nan) if p.elpd_rows is None else p.elpd_rows for p in parts]
    if not all(np.isfinite(r).all() for r in rows):
        return NoisePreference(problem.noise, float("nan"), float("nan"), sound=False)
    difference = rows[0] - rows[1]
    sound = all(c.converged for c in (calibration, usual)) and not any(p.unconverged for p in parts)
    se = float(np.sqrt(difference.size * difference.var(ddof=1)))
    elpd, most = float(difference.sum()), int(np.argmax(np.abs(difference)))
    alone = 2.0 * abs(difference[most]) > abs(elpd)
    line = int(problem.table.lines[most]) if alone else 0
    return NoisePreference(problem.noise, elpd, se, sound, line)
