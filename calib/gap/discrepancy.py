"""A free discrepancy of the field: smooth over conditions, or setting in beyond a threshold."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import expit

from calib.gap.campaigns import Campaigns, OutputData
from calib.gap.covariates import other_conditions
from calib.gap.effects import View
from calib.gap.effects.base import each
from calib.gap.hypothesis import Hypothesis, Setting
from calib.models.base import Array

# Where a discrepancy may set in, and how sharply, on a covariate scaled to -1..1.
THRESHOLDS = (-0.85, 0.9)
_ONSET_WIDTH = 0.06
# Single conditions that it may vary with, whatever the others are.
SETTINGS: tuple[Setting, ...] = ("pressure", "speed", "passes", "water")
# Most waves over the range of slips that a ripple may have.
_WAVES = 12


# Basis (n, m) and the sds of its coefficients (m,), by what they depend on.
type Bases = dict[tuple[str, str, float, str | None], tuple[Array, Array]]


class Discrepancy:
    """What a hypothesis's free discrepancy may look like on a pair of campaigns.

    Parameters
    ----------
    lab_mode : mapping of str to ndarray
        Internal parameters of the simulators as the lab calibrated them; for a discrepancy that
        varies with the level of the output.
    bases : dict, optional
        Where to keep what other discrepancies of the same case and `lab_mode` share.
    """

    def __init__(
        self,
        data: Campaigns,
        hypothesis: Hypothesis,
        lab_mode: Mapping[str, Array],
        bases: Bases | None = None,
    ) -> None:
        self.data, self.hypothesis = data, hypothesis
        self.covariates, self.lab_mode = data.covariates, lab_mode
        # Worked out once for the field rows, which every step of a fit predicts.
        h, bases = hypothesis, {} if bases is None else bases
        self._of_field: dict[str, tuple[Array, Array]] = {}
        for name in h.smooth_outputs:
            key = (name, h.smooth_over, h.smooth_decay, h.onset_over)
            if key not in bases:
                bases[key] = self._smooth_basis(data.view, name)
            self._of_field[name] = bases[key]

    def sds(self, output: str) -> Array:
        """Relative prior sds of an output's amplitudes, shape (m,)."""
        return self._of_field[output][1]

    def at(self, amplitudes: Array, threshold: Array, view: View, output: str) -> Array:
        """Discrepancy of an output, amplitudes (k, m), thresholds (k,) if it sets in, (k, n)."""
        if self.hypothesis.onset_over is None:
            return np.asarray(amplitudes @ self._smooth(view, output).T)
        shapes = self.onset(view, output, threshold)
        return np.asarray(sum(a * s for a, s in zip(each(amplitudes), shapes, strict=True)))

    def shapes(self, threshold: Array, view: View, output: str) -> Array:
        """What amplitudes are multiplied with, thresholds (k,), shape (k, m, n) or (m, n)."""
        if self.hypothesis.onset_over is None:
            return self._smooth(view, output).T
        return np.stack(self.onset(view, output, threshold), axis=1)

    def _smooth(self, view: View, output: str) -> Array:
        same = view.conditions is self.data.view.conditions
        return (self._of_field[output] if same else self._smooth_basis(view, output))[0]

    def onset(self, view: View, output: str, threshold: Array) -> tuple[Array, ...]:
        """Step and bend of a discrepancy that sets in at thresholds (k,), shapes (k, n).

        Over slip a constant as well: the laboratory's rows are of both sides of what gives way at
        a slip, so the field may differ from them before it too. Below a pressure it is a step and a
        part of the output's level instead.
        """
        u = self.onset_covariate(view, output)
        beyond = (u - threshold[:, None]) / _ONSET_WIDTH
        step = expit(beyond)
        if self.hypothesis.onset_over == "low_pressure":
            # An underinflated tyre may lose a part of the pull, and more of it the more it pulls.
            return step, step * self._known(self._level(view, output))
        shapes = step, _ONSET_WIDTH * np.logaddexp(0.0, beyond)
        return (*shapes, np.ones_like(step)) if self.hypothesis.onset_over == "slip" else shapes

    def onset_covariate(self, view: View, output: str) -> Array:
        """What a sudden discrepancy sets in over, scaled to -1..1, shape (n,)."""
        over = self.hypothesis.onset_over or ""
        if over in ("level", "sinkage"):
            return self._known(self._level(view, self._level_of(over, output)))
        u = self._known(self.covariates.over(view, over))
        return -u if over == "low_pressure" else u

    def _known(self, u: Array | None) -> Array:
        if u is None:
            raise ValueError(f"nothing to set in over: {self.hypothesis.onset_over}")
        return u

    def _smooth_basis(self, view: View, output: str) -> tuple[Array, Array]:
        """Basis of an output's free discrepancy, shape (n, m), and its coefficients' sds."""
        over = self.hypothesis.smooth_over
        if self.hypothesis.onset_over is not None:
            # Its shape depends on the threshold; here are its amplitudes.
            both_sides = self.hypothesis.onset_over == "slip"
            return np.array([]), np.array([1.0, 2.0, 0.5] if both_sides else [1.0, 2.0])
        if over == "before":
            change = self._from_the_run_before(view, output)
            return change[:, None], np.ones(1)
        if over in ("level", "sinkage"):
            terms = self._cosines(self._level(view, self._level_of(over, output)), 8, 0.8)
        elif over == "order":
            terms = self._cosines(self.covariates.over(view, "order"), 12, 0.7)
        elif over == "ripple":
            terms = self._ripples(view)
        elif over in SETTINGS or over in other_conditions(self.data.view):
            terms = self._setting_terms(view, output, over)
        else:
            terms = self._condition_terms(view, everything=over == "all")
        n = next(iter(view.conditions.values())).size
        basis = [np.ones(n)] + [b for b, _ in terms]
        return np.stack(basis, axis=1), np.array([1.0] + [w for _, w in terms])

    def _condition_terms(self, view: View, *, everything: bool) -> list[tuple[Array, float]]:
        slip = self.covariates.over(view, "slip")
        slips = self._cosines(slip, 10, 0.7)
        terms = list(slips)
        if everything:
            terms += self._cosines(self.covariates.over(view, "order"), 6, 0.5)
        bends = 2 if everything else 1
        for u, sd in self._cosines(*self._settings(view, "pressure", bends), 0.5):
            terms.append((u, sd))
            terms += [(u * b, sd * w) for b, w in slips[:4]]
        for name in ("speed", "passes", "water", "load", "cone", *other_conditions(view)):
            values = self.covariates.over(view, name)
            if values is not None and everything:
                terms += self._cosines(values, 3, 0.4)
                if slip is not None:
                    terms.append((values * slip, 0.4))
        return terms

    def _setting_terms(self, view: View, output: str, over: str) -> list[tuple[Array, float]]:
        """Of one condition by itself: added to an output, or a part of its level."""
        terms = self._cosines(*self._settings(view, over, 6), 0.8)
        log = self._of(output).problem.bound.model.response == "log"
        if not log:  # on a logarithmic scale adding is to be a part of it
            level = self._known(self._level(view, output))
            terms += [(level, 0.5), *((level * b, 0.6 * w) for b, w in terms)]
        return terms

    def _settings(self, view: View, over: str, most: int) -> tuple[Array | None, int]:
        """A condition, and how many cosines of it its values in the field can tell apart."""
        reference = self.covariates.over(self.data.view, over)
        values = 1 if reference is None else np.unique(reference).size
        return self.covariates.over(view, over), min(values - 1, most)

    def _ripples(self, view: View) -> list[tuple[Array, float]]:
        """Up to `_WAVES` waves over the slips, none more probable than another, of rms 1 in all."""
        slip = self.covariates.over(view, "slip")
        each = (2 * _WAVES) ** -0.5
        return [(basis, each) for basis, _ in self._cosines(slip, 2 * _WAVES, 1.0)]

    def _cosines(self, u: Array | None, most: int, scale: float) -> list[tuple[Array, float]]:
        """Cosines of a covariate scaled to -1..1, and the sds of their coefficients."""
        if u is None:
            return []
        angle = 0.5 * np.pi * (np.clip(u, -1.2, 1.2) + 1.0)
        return [
            (
                np.sqrt(2.0) * np.cos(j * angle),
                scale / (1.0 + (j / self.hypothesis.smooth_decay) ** 2),
            )
            for j in range(1, most + 1)
        ]

    def _level(self, view: View, output: str) -> Array | None:
        """Predicted level of an output, scaled to the field's range."""
        if output not in self.lab_mode:
            return None
        reference = self._predicted(self.data.view, output)
        low, high = float(np.nanmin(reference)), float(np.nanmax(reference))
        level = np.nan_to_num(self._predicted(view, output), nan=low)
        return np.clip((level - low) / max(high - low, 1e-12) * 2.0 - 1.0, -1.5, 1.5)

    def _level_of(self, over: str, output: str) -> str:
        """The output whose level something varies with: its own, or the sinkage."""
        return output if over == "level" else self.data.with_role("sinkage")[0]

    def _of(self, output: str) -> OutputData:
        return next(o for o in self.data.outputs if o.name == output)

    def _predicted(self, view: View, output: str) -> Array:
        """Prediction of an output as the lab calibrated it, on the response's scale."""
        o = self._of(output)
        theta = o.priors.to_natural(self.lab_mode[output][None])
        selected = o.problem.bound.model.select(view.conditions)
        return np.asarray(o.problem.bound.mean_response(theta, selected)[0])

    def _from_the_run_before(self, view: View, output: str) -> Array:
        """How much more the run before is predicted to give, as a part of its rms in the field."""

        def change(view: View) -> Array:
            level = np.nan_to_num(self._predicted(view, output))
            run = view.of("order")
            if not np.ptp(run):
                return np.zeros(level.size)  # nobody knows what went before
            order = np.argsort(run, kind="stable")
            before = np.empty_like(level)
            before[order] = level[order][np.maximum(np.arange(order.size) - 1, 0)]
            return before - level

        rms = float(np.sqrt(np.mean(np.square(change(self.data.view)))))
        return change(view) / max(rms, 1e-12)
