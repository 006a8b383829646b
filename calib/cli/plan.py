"""The command `plan`: which tests to run next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.gap.corrected import Corrected
    from calib.inference.calibration import Calibration
    from calib.validation.plan import NextTests


def plan(
    run: Annotated[Path, typer.Argument(help="Folder of `calib fit` or `calib diagnose`.")],
    grid: Annotated[
        Path,
        typer.Option(help="CSV with conditions of possible tests, and their cost if it differs."),
    ],
    budget: Annotated[float, typer.Option(help="What all tests may cost; by default 1 each.")],
    at: Annotated[
        Path | None, typer.Option(help="CSV with the conditions to predict; by default the grid.")
    ] = None,
    exceeds: Annotated[
        str | None,
        typer.Option(help="Decide whether the mean exceeds this there, e.g. drawbar_pull_kn=1.2."),
    ] = None,
    aim: Annotated[
        Literal["bands", "causes", "decision"] | None,
        typer.Option(help="bands: narrow the prediction. causes: separate those of a diagnosis. "
                     "decision: the default with --exceeds."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="CSV to write, with the output to fill in.")
    ] = None,
    effects: opt.EffectsFile = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:  # fmt: skip
    """Choose the tests to run next, and say what they are expected to bring."""
    from calib import load_calibration
    from calib.batch.folders import check_room
    from calib.cli.prediction import loaded
    from calib.data import read_table, write_table
    from calib.data.quantities import OUTPUTS
    from calib.gap.plan import plan_tests
    from calib.report.labels import units_of
    from calib.validation.prediction import echoed

    if out is not None:
        check_room(out)
        if out.exists():
            wrong, hint = "the file exists, and may be filled in", "choose another --out"
            raise CalibError(wrong, where=str(out), hint=hint)
    found: Corrected | Calibration
    if (run / "corrected.json").exists():
        found = loaded(run, effects)
        known, converged = found.data.case.field, True
    else:
        found = load_calibration(run)
        known, converged = found.problem.table, found.converged
    if not converged:
        announce("this calibration did not converge; a plan made from it is not to be used")
    tests, wanted = (
        read_table(path, allow_missing=tuple(OUTPUTS.values())) for path in (grid, at or grid)
    )
    level = None if exceeds is None else dict([opt.column_value("--exceeds", exceeds)])
    chosen = plan_tests(found, tests, budget, wanted, exceeds=level, aim=aim)
    for remark in remarks(chosen):
        announce(remark)
    columns: dict[str, Any] = echoed(chosen.table, *chosen.outputs)
    if not converged:
        columns["converged"] = ["no"] * len(chosen.table)
    with units_of(known.header):
        print(*lines(chosen, columns), sep="\n")
    if out is not None:
        empty = {known.header_of(name): [""] * len(chosen.table) for name in chosen.outputs}
        write_table(out, {**columns, **empty})
        print(f"fill in the results: {out}")
    document = {name: value for name, value in vars(chosen).items() if name != "table"} | {
        "tests": columns, "cost": chosen.cost.tolist(),
        "forecast": {name: values.tolist() for name, values in chosen.forecast.items()},
    }  # fmt: skip
    finish(0 if converged else 3, document)


_WHAT = {
    "bands": "the width of the 90 % band of the mean",
    "causes": "the probability of wrong explanations",
    "decision": "the probability of a wrong decision",
}


def lines(chosen: NextTests, columns: Mapping[str, Any]) -> Iterator[str]:
    """Say what the tests bring, their aim first, and list them."""
    from calib.report.labels import aligned, axis_of, percent
    from calib.report.numbers import format_value
    from calib.validation.constants import MOST_TESTS

    n, forecast = len(chosen.table), chosen.forecast
    for name in sorted(forecast, key=lambda name: name != chosen.aim):
        before, after = (percent(float(forecast[name][i])) for i in (0, -1))
        checked = format_value(*(100.0 * value for value in chosen.simulated[name]))
        yield (
            f"{n} test{'s reduce' if n > 1 else ' reduces'} {_WHAT[name]} from {before} to {after} "
            f"(by simulation {checked} %)."
        )
    for output, band, noise in zip(chosen.outputs, chosen.band, chosen.reading, strict=True):
        axis, then = axis_of(output), band * float(forecast["bands"][-1])
        yield (
            f"{axis.name}: from {axis.value_text(band)} to {axis.value_text(then)} {axis.unit} "
            f"over {chosen.targets} condition{'s' if chosen.targets > 1 else ''}; noise "
            f"alone spreads readings over {axis.value_text(noise)} {axis.unit} (90 %)."
        )
    if chosen.halved:
        yield f"The band is half as wide after {chosen.halved} tests chosen in this way."
    elif chosen.aim == "bands":
        yield f"Even {MOST_TESTS} tests would leave {percent(chosen.left)} of the band's width."
    found: dict[str, Sequence[Any]] = {"test": range(1, n + 1), **columns}
    found |= {f"{name} %": [f"{100.0 * v:.1f}" for v in forecast[name][1:]] for name in forecast}
    found["outside the calibrated range"] = [
        ", ".join(map(chosen.table.header_of, row)) for row in chosen.outside
    ]
    if not any(chosen.outside):
        found.popitem()
    yield from aligned(
        [[*found], *([str(c) for c in row] for row in zip(*found.values(), strict=True))]
    )


def remarks(chosen: NextTests) -> Iterator[str]:
    """Say what is to be kept in mind."""
    if any(chosen.excluded):
        tests, targets = chosen.excluded
        yield (
            f"the model has no value at {tests} rows of the grid and {targets} conditions to "
            "predict: they are left out"
        )
    if outside := sum(map(bool, chosen.outside)):
        lie = "test lies" if outside == 1 else "tests lie"
        yield (f"{outside} {lie} outside the calibrated range, where what they tell is a guess")
    if chosen.unreliable > 0.05:  # of twenty outcomes, more than one
        yield (
            f"the simulation is rough: for {chosen.unreliable:.0%} of its outcomes too few "
            "posterior draws carry weight"
        )
