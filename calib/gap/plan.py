"""Plan tests for a calibration, or for the corrected models of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from calib.arguments import takes
from calib.data import Table, as_table
from calib.data.checks import check_conditions
from calib.data.quantities import OUTPUTS
from calib.data.reader import Tabular
from calib.data.table import MAX_TEXT_ROWS, parse_header
from calib.errors import CalibError
from calib.gap.corrected import Corrected, all_conditions, check_units_of, covered
from calib.gap.diagnose import Diagnosis
from calib.gap.effects import View
from calib.gap.mixture import Mixture
from calib.gap.noise import noise_conditions
from calib.inference.calibration import Calibration
from calib.inference.random import generator
from calib.validation.constants import HALF_BAND, MOST_TESTS
from calib.validation.plan import (
    MOMENTS,
    WEIGHTED,
    Aim,
    Beliefs,
    NextTests,
    beliefs_of,
    chosen_tests,
)
from calib.validation.prediction import outside


@takes(found=(Calibration, Diagnosis, Corrected), budget=Real, exceeds=Mapping)
def plan_tests(
    found: Calibration | Diagnosis | Corrected,
    grid: Tabular,
    budget: float,
    at: Tabular | None = None,
    *,
    exceeds: Mapping[str, float] | None = None,
    aim: Aim | None = None,
) -> NextTests:
    """Choose the tests to run next.

    Parameters
    ----------
    found : Calibration, Diagnosis or Corrected
    grid : Table, mapping of str to array_like, or pandas.DataFrame
        Conditions of possible tests, each of which may be run more than once, and what a test costs
        (``cost``; 1 by default).
    budget : float
        What all tests may cost.
    at : as the grid, optional
        Conditions to predict; those of the grid by default.
    exceeds : mapping of str to float, optional
        An output, with its unit, and a threshold: whether the mean exceeds it at each of the
        conditions to predict is to be decided.
    aim : {"bands", "causes", "decision"}, optional
        Narrow the band of the mean: its expected variance, within explanations of a diagnosis and
        between them. Separate the explanations: the expected probability of wrong ones. Decide:
        that of a wrong decision. The last is the default with `exceeds`, else the first.

    Returns
    -------
    NextTests

    Raises
    ------
    CalibError
        If a condition is missing, nothing can be paid for, or the aim does not go with the rest.

    Examples
    --------
    >>> import calib
    >>> plates = calib.load_he2019("rut_depth")
    >>> calibration = calib.calibrate(calib.build_problem("bekker", plates), seed=1)
    >>> grid = {"average_ground_pressure_kpa": [60.0, 100.0, 140.0, 180.0]}
    >>> tests = calib.plan_tests(calibration, grid, budget=3)
    >>> tests.to_dataframe().shape[0]
    3
    """
    aim = aim or ("decision" if exceeds else "bands")
    mine = {"bands": True, "causes": not isinstance(found, Calibration), "decision": bool(exceeds)}
    if not mine.get(aim):
        raise CalibError(
            f"aim = {aim!r}", where="calib.plan_tests",
            expected=" or ".join(a for a, there in mine.items() if there),
            hint="causes are those of a diagnosis; a decision needs a threshold (exceeds)",
        )  # fmt: skip
    tests = as_table(grid)
    wanted = tests if at is None else as_table(at)
    # Between explanations a decision is worked out condition by condition.
    few = aim == "decision" and not isinstance(found, Calibration)
    for table, most in ((tests, MAX_TEXT_ROWS), (wanted, MOST_TESTS if few else MAX_TEXT_ROWS)):
        if len(table) > most:
            raise CalibError(
                f"{len(table)} conditions", where=table.source, expected=f"at most {most}",
                hint="list the conditions of the decision (at)" if few else "thin them",
            )  # fmt: skip
    if isinstance(found, Calibration):
        of = _of_calibration(found, tests, wanted)
    else:
        of = _of_diagnosis(
            found if isinstance(found, Corrected) else found.corrected, tests, wanted
        )
    make, tests, names, flags, rng = of
    return chosen_tests(make, tests, budget, aim, _threshold(exceeds, names), names, flags, rng)


# Beliefs about some rows of the tests, the tests, outputs, what leaves the calibrated range, and
# random numbers.
type _Of = tuple[
    Callable[[NDArray[np.intp] | None], Beliefs], Table, tuple[str, ...],
    tuple[tuple[str, ...], ...], np.random.Generator,
]  # fmt: skip


def _of_calibration(found: Calibration, tests: Table, wanted: Table) -> _Of:
    model, known = found.problem.bound.model, found.problem.conditions
    at, to = (model.select(table.columns) for table in (tests, wanted))
    for table in (tests, wanted):
        check_conditions(table, known)
    rng = generator(found.seed, found.label, "plan")

    def make(rows: NDArray[np.intp] | None) -> Beliefs:
        some = at if rows is None else {name: v[rows] for name, v in at.items()}
        return beliefs_of(found, some, to, rng, MOMENTS if rows is None else WEIGHTED)

    return make, tests, (model.output,), outside(known, at), rng


def _of_diagnosis(found: Corrected, tests: Table, wanted: Table) -> _Of:
    for table in (tests, wanted):
        check_units_of(found, table)
    data, (tests, at), (_, to) = found.data, *(all_conditions(found, t) for t in (tests, wanted))
    used = [name for name in at if name in to and name not in OUTPUTS.values()]

    def make(rows: NDArray[np.intp] | None) -> Beliefs:
        some = np.arange(len(tests)) if rows is None else rows
        both = {name: np.concatenate([at[name][some], to[name]]) for name in used}
        return _beliefs(found.mixture, data.at_conditions(both), some.size)

    known = covered(found, tests)
    flags = outside(known, {n: tests[n] for n in known}) if known else ((),) * len(tests)
    rng = generator(found.mixture.seed, "gap", "plan")
    return make, tests, tuple(OUTPUTS[o] for o in data.names), flags, rng


def _threshold(
    exceeds: Mapping[str, float] | None, outputs: tuple[str, ...]
) -> tuple[int, float] | None:
    if not exceeds:
        return None
    (header, value), *more = exceeds.items()
    column = parse_header(header)
    if column is None or column.quantity.canonical not in outputs or more:
        raise CalibError(
            f"no decision can be made on {', '.join(exceeds)}", expected=" or ".join(outputs),
            hint="name one output, in any of its units, and a threshold",
        )  # fmt: skip
    return outputs.index(column.quantity.canonical), float(column.to_canonical([value])[0])


def _beliefs(mixed: Mixture, view: View, m: int) -> Beliefs:
    """All draws of all fits at m tests, then targets; those of one hypothesis together."""
    outputs, at = mixed.data.outputs, noise_conditions(view)
    names = list(dict.fromkeys(fit.forward.hypothesis.name for fit in mixed.fits))
    parts = []
    for fit, probability in zip(mixed.fits, mixed.probability, strict=True):
        n, mean = len(fit.sample), fit.forward.field(fit.sample, view)
        sd = np.stack([fit.noise[o.name].sd(at) for o in outputs])
        read = np.stack([mean[o.name][:, :m] for o in outputs], axis=-1)
        wanted = np.stack([o.problem.bound.from_response(mean[o.name][:, m:]) for o in outputs], 1)
        half = HALF_BAND * sd[:, m:] * np.ones_like(wanted)
        for i, o in enumerate(outputs):
            if o.problem.bound.model.response == "log":
                half[:, i] *= wanted[:, i]
        cause = np.full(n, names.index(fit.forward.hypothesis.name))
        scale = np.broadcast_to(sd[:, :m].T, read.shape)
        parts.append((cause, np.full(n, probability / n), read, scale, wanted, half))
    cause, *rest = map(np.concatenate, zip(*parts, strict=True))
    weight, read, scale, wanted, half = rest
    own = np.ones((weight.size, 1))
    return Beliefs(tuple(names), cause, weight, read, scale, wanted, half, own)
