"""Differences of the field other than effects: parameter shifts and free discrepancies."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from scipy.linalg import block_diag
from scipy.special import expit

from calib.errors import CalibError
from calib.gap.campaigns import Campaigns, OutputData, other_conditions
from calib.gap.constants import ONSET_WIDTH, RADIUS_ERROR, RIPPLES, SHIFT_DIFFERENCE
from calib.gap.effects import View
from calib.gap.effects.base import each
from calib.gap.hypotheses import SETTINGS, Hypothesis, ShiftAs
from calib.inference.mode import prior_widths
from calib.inference.prior_files import default_priors
from calib.models.base import Array

# Another zero of slip: unit of the relative error of the rolling radius.
ZERO_OF_SLIP = "slip_zero"
# What water does to the strength of a soil: its prior spans all soils there are, of which those of
# two campaigns with one density relation are near neighbours.
_OF_WATER = ("C2", "C3")
# The same quantity under another name: the exponent of plain Bekker is that without slip.
_SAME = {"n": "n0"}


@dataclass(frozen=True)
class ShiftMap:
    """What the coordinates of a shift change, per unit of each.

    Attributes
    ----------
    parameters : mapping of str to ndarray, shape (d, k)
        By output, its d parameters in internal coordinates.
    radius_error : ndarray, shape (k,)
        Relative error of the rolling radius behind the recorded slip.
    """

    parameters: Mapping[str, Array]
    radius_error: Array


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    ways: tuple[float, ...]
    own: float = Field(gt=0.0)


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    unit: str = Field(min_length=1)
    reason: str = Field(min_length=1)
    source: str = Field(min_length=1)
    ways: tuple[str, ...]
    parameters: dict[str, _Row]

    @model_validator(mode="after")
    def _as_many_loadings(self) -> _File:
        if any(len(row.ways) != len(self.ways) for row in self.parameters.values()):
            raise ValueError("a parameter has not as many loadings as there are ways")
        return self


def another_soil() -> dict[str, tuple[Array, float]]:
    """Read how quantities move together when the soil is another one.

    Returns
    -------
    dict
        Quantity to its loadings on the ways in which soils differ, shape (ways,), and the sd of
        what it does by itself; in units of the prior sds.

    Raises
    ------
    CalibError
        If the prior file cannot be read or is not complete.
    """
    path = default_priors("shifts/another_soil")
    try:
        file = _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError, ValidationError) as error:
        raise CalibError(
            f"the prior of parameter shifts cannot be read ({error})",
            where=str(path),
            hint="install the package again",
        ) from None
    return {name: (np.array(row.ways), row.own) for name, row in file.parameters.items()}


def quantities(names: Sequence[str]) -> list[str]:
    """Name the coordinates in which a model's shifts are described.

    The values at the two end pressures, K_lo and K_hi, become K, which both share, and
    K_difference, half of what they differ by.
    """
    found = []
    for name in names:
        stem, _, end = name.rpartition("_")
        if end in ("lo", "hi") and {f"{stem}_lo", f"{stem}_hi"} <= set(names):
            found.append(stem if end == "lo" else f"{stem}_difference")
        else:
            found.append(_SAME.get(name, name))
    return found


def coordinates(outputs: Sequence[OutputData]) -> list[tuple[str, str]]:
    """Name output and quantity of every coordinate of a shift, in the order in which they come."""
    found = []
    for o in outputs:
        kinds = quantities(o.priors.names)
        if o.role == "pull":
            kinds.append(ZERO_OF_SLIP)
        found += [(o.name, kind) for kind in kinds]
    return found


def alone_sd(quantity: str) -> float:
    """Prior sd of a quantity that shifts by itself, in its parameter's prior sds."""
    lesser = quantity.endswith(("_bend", "_difference")) or quantity in ("n1", *_OF_WATER)
    return SHIFT_DIFFERENCE if lesser else 1.0


def shift_map(outputs: Sequence[OutputData], shift_as: ShiftAs) -> tuple[ShiftMap, list[float]]:
    """Map shift coordinates to shifts of each output's parameters, and of the zero of slip.

    Another soil changes the traction curve at all pressures, and the exponent of sinkage at all
    slips, much alike: the values at the two end pressures share one shift, and differ by less, as
    the bends between them and the exponent's growth with slip (n1) do. With "soil", what a softer
    soil does to the traction curve goes along with what it does to the ruts.

    Slip was zeroed in the laboratory, where the wheel pulled nothing. Elsewhere it pulls nothing at
    another slip, for the resistance differs: the recorded slip is then wrong as with a wrong
    rolling radius. It is sought where drawbar pull is measured.
    """
    at = coordinates(outputs)
    kinds = [kind for _, kind in at]
    blocks: list[Array] = []
    for o in outputs:
        names = [kind for name, kind in at if name == o.name and kind != ZERO_OF_SLIP]
        blocks.append(prior_widths(o.priors)[:, None] * _unfold(names))
        if o.role == "pull":
            blocks.append(np.full((1, 1), RADIUS_ERROR))
    matrix = block_diag(*blocks)
    sds = np.array([alone_sd(kind) for kind in kinds])
    if shift_as == "soil":
        matrix = matrix @ _together(kinds, sds)
        sds = np.ones(sds.size)
    parameters = {
        o.name: matrix[[name == o.name and kind != ZERO_OF_SLIP for name, kind in at]]
        for o in outputs
    }
    zero = [kind == ZERO_OF_SLIP for kind in kinds]
    return ShiftMap(parameters, matrix[zero].sum(axis=0)), sds.tolist()


def _unfold(names: Sequence[str]) -> Array:
    """From what end pressures share and differ by to their values, shape (d, d)."""
    matrix = np.eye(len(names))
    for j, name in enumerate(names):
        if name.endswith("_difference"):
            i = names.index(name.removesuffix("_difference"))
            matrix[i, j], matrix[j, i] = -1.0, 1.0
    return matrix


def _together(kinds: Sequence[str], alone: Array) -> Array:
    """Square root of the covariance of the quantities, shape (k, k)."""
    known = another_soil()
    covariance = np.diag(alone**2)
    at = [i for i, kind in enumerate(kinds) if kind in known]
    if at:
        ways = np.stack([known[kinds[i]][0] for i in at])
        own = np.array([known[kinds[i]][1] for i in at])
        covariance[np.ix_(at, at)] = ways @ ways.T + np.diag(own**2)
    return np.asarray(np.linalg.cholesky(covariance))


# Where a discrepancy may set in, and how sharply, on a covariate scaled to -1..1.
THRESHOLDS = (-0.85, 0.9)


class Discrepancy:
    """What a hypothesis's free discrepancy may look like on a pair of campaigns.

    Parameters
    ----------
    lab_mode : mapping of str to ndarray
        Internal parameters of the simulators as the lab calibrated them; for a discrepancy that
        varies with the level of the output.
    """

    def __init__(
        self,
        data: Campaigns,
        hypothesis: Hypothesis,
        lab_mode: Mapping[str, Array],
    ) -> None:
        self.data, self.hypothesis = data, hypothesis
        self.lab_mode = lab_mode
        # Worked out once for the field rows, which every step of a fit predicts.
        self._of_field = {
            name: self._smooth_basis(data.view, name) for name in hypothesis.smooth_outputs
        }

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
        beyond = (u - threshold[:, None]) / ONSET_WIDTH
        step = expit(beyond)
        if self.hypothesis.onset_over == "low_pressure":
            # An underinflated tyre may lose a part of the pull, and more of it the more it pulls.
            return step, step * self._known(self._level(view, output))
        shapes = step, ONSET_WIDTH * np.logaddexp(0.0, beyond)
        return (*shapes, np.ones_like(step)) if self.hypothesis.onset_over == "slip" else shapes

    def onset_covariate(self, view: View, output: str) -> Array:
        """What a sudden discrepancy sets in over, scaled to -1..1, shape (n,)."""
        over = self.hypothesis.onset_over or ""
        if over in ("level", "sinkage"):
            return self._known(self._level(view, self._level_of(over, output)))
        u = self._known(self.data.scaled(view, over))
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
            terms = self._cosines(self.data.scaled(view, "order"), 12, 0.7)
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
        slip = self.data.scaled(view, "slip")
        slips = self._cosines(slip, 10, 0.7)
        terms = list(slips)
        if everything:
            terms += self._cosines(self.data.scaled(view, "order"), 6, 0.5)
        bends = 2 if everything else 1
        for u, sd in self._cosines(*self._settings(view, "pressure", bends), 0.5):
            terms.append((u, sd))
            terms += [(u * b, sd * w) for b, w in slips[:4]]
        for name in ("speed", "passes", "water", "load", "cone", *other_conditions(view)):
            values = self.data.scaled(view, name)
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
        reference = self.data.scaled(self.data.view, over)
        values = 1 if reference is None else np.unique(reference).size
        return self.data.scaled(view, over), min(values - 1, most)

    def _ripples(self, view: View) -> list[tuple[Array, float]]:
        """Waves over the slips, none more probable than another, of rms 1 in all."""
        slip = self.data.scaled(view, "slip")
        each = (2 * RIPPLES) ** -0.5
        return [(basis, each) for basis, _ in self._cosines(slip, 2 * RIPPLES, 1.0)]

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
