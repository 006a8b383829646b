"""Whether readings are consistent with a reference campaign, by its posterior predictive.

Readings of one campaign share the uncertainty of the reference's curve, so no test here takes them
for independent: each statistic is held against the same statistic of the predictive draws, every
one of which is a campaign at the same conditions that the reference deems possible (Gelman, Meng &
Stern 1996, Statistica Sinica 6:733). The probabilities are adjusted for their number (Holm).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri

from calib.arguments import takes
from calib.data import as_table
from calib.data.checks import check_conditions
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES
from calib.data.reader import Tabular
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.validation.constants import LEVEL
from calib.validation.prediction import bias_probability, coverage_probability, outside
from calib.validation.scores import holm
from calib.validation.validate import check_unseen, validate_held_out


@dataclass(frozen=True)
class Consistency:
    """What some readings say beside a reference campaign.

    Parameters
    ----------
    output : str
        Canonical column, with its unit.
    n, hits, aside : int
        Rows judged; those inside the reference's 90 % band; those set aside, because they lie
        outside its calibrated range or are rows that it was fitted to.
    offset, scatter : tuple of float
        Mean of readings minus predicted medians, in the output's unit, and scatter about the
        reference's curve over what it expects: each with its 90 % interval, in which the
        uncertainty of the reference is. NaN for the scatter of fewer than three rows.
    detectable : float
        Offset that would be found with a probability of about 0.8.
    p : mapping of str to float
        Of `offset`, `scatter` and `coverage`: probability of readings at least as far off, were
        they consistent.
    converged : bool
        Whether the reference's posterior passed the gate.
    """

    output: str
    n: int
    hits: int
    aside: int
    offset: tuple[float, float, float]
    scatter: tuple[float, float, float]
    detectable: float
    p: Mapping[str, float]
    converged: bool

    @property
    def differs(self) -> tuple[str, ...]:
        """The tests that fail, their probabilities adjusted for their number."""
        adjusted = zip(self.p, holm(list(self.p.values())), strict=True)
        return tuple(name for name, p in adjusted if p <= LEVEL)

    @property
    def verdict(self) -> str:
        """One sentence."""
        unit, found = QUANTITIES[self.output].unit, self.differs
        said = {
            "offset": f"{plain_number(abs(self.offset[0]))} {unit} "
            f"{'above' if self.offset[0] > 0.0 else 'below'} it on average",
            "scatter": f"scatter {plain_number(self.scatter[0])} times the expected",
            "coverage": f"only {self.hits} of {self.n} rows inside its 90 % band",
        }
        if not self.converged:
            return "cannot be judged: the reference did not converge"
        if found:
            return f"NOT CONSISTENT with the reference: {'; '.join(said[name] for name in found)}"
        reach = f"an offset of {plain_number(self.detectable, 2)} {unit} would probably be found"
        return f"consistent with the reference; {reach}"

    @property
    def lines(self) -> tuple[str, ...]:
        """The numbers in words, then the verdict."""
        aside = f", {self.aside} set aside (outside its range, or its own)" if self.aside else ""
        found = [f"{self.n} rows judged{aside}"]
        found.append(f"inside the 90 % band: {self.hits} of {self.n}, p = {self.p['coverage']:.2g}")
        measured = {"offset": self.offset, "scatter": self.scatter}
        units = {"offset": QUANTITIES[self.output].unit, "scatter": "times the expected"}
        for name in (name for name in measured if name in self.p):
            value, low, high = (plain_number(v) for v in measured[name])
            band = f"{value} {units[name]} (90 %: {low} to {high})"
            found.append(f"{name}: {band}, p = {self.p[name]:.2g}")
        return (*found, f"verdict: {self.verdict}")

    def document(self) -> dict[str, Any]:
        """Return it as plain data."""
        said = {"differs": list(self.differs), "verdict": self.verdict}
        return {"schema": "calib/consistency/1", **asdict(self), "p": dict(self.p), **said}


@takes(calibration=Calibration)
def consistency(calibration: Calibration, readings: Tabular) -> Consistency:
    """Judge whether readings are consistent with the campaign that a calibration is of.

    Parameters
    ----------
    calibration : Calibration
        Of the reference.
    readings : Table, mapping of str to array_like, or pandas.DataFrame
        With the model's conditions and its output, of another campaign.

    Raises
    ------
    CalibError
        If no row lies in the calibrated range, all are the reference's own, or a column looks as if
        it were in another unit.

    Notes
    -----
    To fail no test is no proof: `detectable` says how large an offset would have been found. A
    scatter ratio is the sd of (reading - median)/(half the 16 to 84 % band) over its own median
    among the draws; it grows as well where the curve has another shape.

    Examples
    --------
    >>> import calib
    >>> pulls = calib.load_he2019("drawbar_pull")
    >>> reference, mine = calib.hold_out(pulls, "slip_ratio", float(pulls["slip_ratio"][4]))
    >>> calibration = calib.calibrate(calib.build_problem("magic_formula_pressure", reference), 1)
    >>> calib.consistency(calibration, mine).differs
    ()
    """
    table, problem = as_table(readings), calibration.problem
    model = problem.bound.model
    check_conditions(table, problem.conditions)
    columns = (*problem.conditions, model.output)
    check_unseen(problem.table, table, columns)
    seen, rows = (
        [*zip(*(t[name] for name in columns), strict=True)] for t in (problem.table, table)
    )
    own = np.array([row in set(seen) for row in rows])
    away = np.array([bool(f) for f in outside(problem.conditions, model.select(table.columns))])
    if (own | away).all():
        raise CalibError(
            "no row lies where the reference was calibrated", where=table.source,
            expected="rows inside the calibrated range of every condition",
            hint="measure there, or calibrate a reference that covers these conditions",
        )  # fmt: skip
    found = validate_held_out(calibration, table.take(~(own | away)))
    draws, observed, n = found.draws, found.observed, found.scores.n
    hits = found.scores.coverage[0.9].hits
    means = draws.mean(axis=1) - found.scores.median.mean()
    offset = float((observed - found.scores.median).mean())
    p = {"offset": bias_probability(draws, found.scores.pit)}
    scatter = math.nan
    spreads = np.full(1, math.nan)
    if n > 2:
        below, middle, above = np.quantile(draws, [0.16, 0.5, 0.84], axis=0)
        standard = (np.vstack([observed, draws]) - middle) / (0.5 * (above - below))
        scatter, spreads = standard.std(axis=1, ddof=1)[0], standard.std(axis=1, ddof=1)[1:]
        tail = min((spreads >= scatter).sum(), (spreads <= scatter).sum())
        p["scatter"] = min(1.0, 2.0 * float(1 + tail) / (1 + spreads.size))
    p["coverage"] = coverage_probability(draws, hits, 0.9)
    # Two-sided at the strictest level of the family, with a power of 0.8.
    reach = float(ndtri(1.0 - 0.5 * LEVEL / len(p)) + ndtri(0.8))
    low, high = np.quantile(offset - means, [0.05, 0.95])
    least, ratio, most = scatter / np.quantile(spreads, [0.95, 0.5, 0.05])
    return Consistency(
        model.output, n, hits, int((away | own).sum()), (offset, float(low), float(high)),
        (float(ratio), float(least), float(most)), reach * float(means.std()), p,
        calibration.converged,
    )  # fmt: skip
