"""Models compared on the same rows: the document, its views, and the section of a report.

A folder of `calib compare` has `comparison.json`, a figure, a page, a run folder for each model,
the rows that were held out and a hash of every file, so that it can be computed again. A report
that compares models has such a folder beside its page.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import Field

from calib.batch.environment import Environment
from calib.data import read_for_model, write_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.io import (
    Entry,
    File,
    Hash,
    KnownModel,
    Record,
    load_calibration,
    own_names,
    read_record,
    save_calibration,
)
from calib.inference.problem import Problem, build_problem
from calib.inference.sampler import SamplerSettings
from calib.models import get_model
from calib.models.base import Array
from calib.report.figures import style
from calib.report.figures.bands import said_of_rows
from calib.report.figures.style import Plate, mark, png_bytes, points_in
from calib.report.labels import Axis, aligned, axis_of, units_of
from calib.report.numbers import finite, format_number
from calib.report.page.template import equation, picture, template
from calib.report.sections import Section, Target, coverage_words
from calib.report.study import Progress, Study, Task, fitted_rows
from calib.report.verdict import Verdict, keep_verdict, kept_verdict, verdict
from calib.report.writer import file_hashes
from calib.validation.comparison import (
    Candidate,
    Comparison,
    check_comparable,
    compare,
    compare_problems,
    difference,
    sentence,
)
from calib.validation.constants import N_DRAWS, PARETO_K_MAX
from calib.validation.scores import Scores
from calib.validation.validate import Validation


def comparison_figure(comparison: Comparison) -> Figure:
    """Draw, for each model, measured rows and the 90 % interval it gives each without it."""
    candidates = comparison.candidates
    column = _main_condition(comparison)
    x, y = axis_of(column), axis_of(candidates[0].calibration.problem.bound.model.output)
    cols = min(3, len(candidates))
    margins = {"left": 15.0, "top": 9.0, "bottom": 20.0, "gap_y": 16.0}
    with style.style():
        figure, axes = style.panels(
            -(-len(candidates) // cols), cols, height=58.0, sharex=True, sharey=True, **margins
        )
        handles: dict[str, Any] = {}
        for ax, candidate in zip(axes.flat, candidates, strict=False):
            loo = candidate.loo
            at, values = x.factor * loo.table[column], y.factor * loo.observed
            place = _spread(at)
            low, middle, high = expected = y.factor * np.quantile(
                loo.draws, [0.05, 0.5, 0.95], axis=0
            )
            bars = ax.vlines(place, low, high, color=style.BLUE, alpha=0.35, linewidth=1.6)
            (dash,) = ax.plot(place, middle, "_", color=style.BLUE)
            (dots,) = ax.plot(place, values, ".", color=style.BLACK, ms=3.0)
            style.say_of_points(dots, said_of_rows(x, y, at, values, expected, "left out"))
            handles = {"measured": dots, "median without the row": dash}
            handles["90 % interval without the row"] = bars
            if candidate.held is not None:
                _draw_held(ax, candidate.held, (x, y), column, handles)
            weight = comparison.weights[candidate.model]
            ax.set(title=f"{candidate.model}, weight {weight:.2f}", xlabel=x.label)
        style.hide_rest(axes, len(candidates))
        for row in axes:
            row[0].set_ylabel(y.label)
        style.legend_below(figure, handles, 3)
    return figure


def _draw_held(
    ax: Axes, held: Validation, axes: tuple[Axis, Axis], column: str, handles: dict[str, Any]
) -> None:
    """Draw the rows that were held out, ringed, and the intervals in which they were expected."""
    x, y = axes
    at, values = x.factor * held.table[column], y.factor * held.observed
    place = _spread(at)
    low, _, high = expected = y.factor * np.nanquantile(held.draws, [0.05, 0.5, 0.95], axis=0)
    ax.vlines(place, low, high, color=style.VERMILION, alpha=0.35, linewidth=1.6)
    look: Any = {"ms": 4.0, "mfc": "white", "mec": style.VERMILION, "mew": 1.0}
    (dots,) = ax.plot(place, values, "o", **look)
    style.say_of_points(dots, said_of_rows(x, y, at, values, expected, "held out"))
    handles["held out"] = dots


def _main_condition(comparison: Comparison) -> str:
    """Return the condition along which the two best models' predictions of a row differ most.

    By how much of the difference of log densities a parabola in its ranks takes up.
    """
    first, second = comparison.candidates[:2]
    table = first.loo.table
    named = dict.fromkeys(n for c in (first, second) for n in c.calibration.problem.conditions)
    shared = [n for n in named if all(n in c.loo.table for c in comparison.candidates)]
    difference = first.rows - second.rows

    def taken_up(name: str) -> float:
        _, place = np.unique(table[name], return_inverse=True)
        if place.max() < 1:
            return -1.0
        design = np.vander(place / place.max(), min(3, int(place.max()) + 1))
        fitted = design @ np.linalg.lstsq(design, difference, rcond=None)[0]
        return float(np.var(fitted))

    return max(shared, key=taken_up)


def _spread(x: Array) -> Array:
    """Move rows that share a place apart, so that each bar is seen."""
    room = 0.012 * (np.ptp(x) or 1.0)
    moved = x.copy()
    for value in np.unique(x):
        (same,) = np.nonzero(x == value)
        beside = np.arange(same.size) - 0.5 * (same.size - 1)
        moved[same] += room * beside / same.size**0.5
    return moved


def table(found: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of the table, from the content of `comparison.json`.

    Errors are in the unit of the file that was compared on.
    """
    models = found["models"]
    with units_of(found.get("header", ())):
        axis = axis_of(get_model(next(iter(models))).output)

    def shown(value: float | None, factor: float | None = None) -> str:
        if value is None:
            return "none"
        return f"{value:.1f}" if factor is None else format_number(factor * value)

    rows = []
    for name, m in models.items():
        row = {
            "Model": name,
            "Below the best, elpd": shown(m["below_best"]),
            "Standard error": shown(m["below_best_se"]),
            "Stacking weight": f"{m['weight']:.2f}",
            f"RMSE ({axis.unit})": shown(m["rmse"], axis.factor),
            "90 % covers": f"{100 * m['coverage_90']:.0f} %",
            "Rows fitted again": str(m["refitted_rows"]),
            "Log evidence": shown(m["log_evidence"]),
        }
        if found["held_out"] and (held := m.get("held_out")):
            row |= {
                "held-out elpd": shown(held["elpd"]),
                f"held-out RMSE ({axis.unit})": shown(held["rmse"], axis.factor),
                f"held-out CRPS ({axis.unit})": shown(held["crps"], axis.factor),
                "held-out 90 % covers": f"{100 * held['coverage_90']:.0f} %",
            }
        rows.append(row)
    return list(rows[0]), [list(row.values()) for row in rows]


def text(found: Mapping[str, Any]) -> str:
    """Lay the table out as text, the verdict below it."""
    head, body = table(found)
    return "\n".join([*aligned([head, *body]), found["verdict"]])


def _one_is_best(found: Mapping[str, Any]) -> bool:
    """Whether the best model is told apart from all others."""
    return all(m["told_apart"] for m in list(found["models"].values())[1:])


def _coverage_off(found: Mapping[str, Any]) -> Iterator[str]:
    """Say of which models the 90 % band covers more or fewer rows than it should."""
    for name, m in found["models"].items():
        held = m.get("held_out") if found["held_out"] else None
        for share, n, rows in (
            (m["coverage_90"], found["rows"], "left-out"),
            *([(held["coverage_90"], held["rows"], "held-out")] if held else []),
        ):
            said = coverage_words(share, n)
            if not said.endswith("should be"):
                yield f"{name}: of {n} {rows} rows the 90 % band covers {said}"


def page(found: Mapping[str, Any], image: bytes) -> str:
    """Return the page of a comparison, from the content of `comparison.json` and the figure."""
    head, body = table(found)
    tone = "no" if not found["converged"] else "fine" if _one_is_best(found) else "even"
    return template("comparison.html.j2").render(
        found=found,
        tone=tone,
        coverage=list(_coverage_off(found)),
        equation=equation,
        data_label=found.get("data_label", ""),
        head=head,
        rows=body,
        figure=picture(Plate(None, "bands", "", points=points_in(image)), image, ""),
        models=[get_model(name) for name in found["models"]],
        command=shlex.join(found["command"]),
    )


FILE, PAGE, HELD_OUT = "comparison.json", "index.html", "held_out.csv"
FIGURE = "figures/bands.png"


class _Compared(Entry):
    weight: float
    elpd_rows: Annotated[tuple[float, ...], Field(min_length=2)]
    converged: bool
    refits_not_converged: int


class ComparisonRecord(Record):
    """`comparison.json` of a comparison folder."""

    FILE, kind, WRITTEN_BY = FILE, "comparison", "calib compare"
    schema_: Literal["calib/comparison/2"] = Field(alias="schema")
    held_out: str
    header: tuple[str, ...] = ()
    command: tuple[str, ...]
    models: Annotated[dict[KnownModel, _Compared], Field(min_length=2)]
    files: dict[File, Hash]

    @property
    def unsound(self) -> tuple[str, ...]:
        """Models of which a posterior is recorded as one that did not pass the gate."""
        return tuple(
            name for name, m in self.models.items() if not m.converged or m.refits_not_converged
        )


def document(
    comparison: Comparison,
    hold_out: str = "",
    emulator_fails: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Return every number of a comparison as plain dictionaries.

    What was held out is said in words, and by model why its emulator is not good enough.
    Differences are from the first model.
    """
    fails = emulator_fails or {}
    candidates = {c.model: c for c in comparison.candidates}
    first = comparison.candidates[0].calibration.problem.table
    rows = {name: c.rows for name, c in candidates.items()}
    unsound = [name for name, c in candidates.items() if not c.sound]
    stated = stated_of_rows(rows, comparison.weights, unsound)
    for name, c in candidates.items():
        judged, loo = (c.loo, None) if c.held is None else (c.held, c.loo)
        how: Any = {"emulator_fails": fails.get(name, ()), "held_out": hold_out}
        said = verdict(c.calibration, judged, loo=loo, **how).document()
        stated["models"][name] |= {**_model(c), "verdict": said}
    return {
        "schema": "calib/comparison/2",
        "seed": comparison.seed,
        **own_names(first),
        "held_out": hold_out,
        **({"data_label": first.label} if first.label else {}),
        "converged": comparison.sound,
        **stated,
    }


def stated_of_rows(
    rows: Mapping[str, Array], weights: Mapping[str, float], unsound: Sequence[str]
) -> dict[str, Any]:
    """Return what is stated of models by the log predictive densities of rows without them, (n,).

    And by their stacking weights, which follow as well; the best first, `unsound` did not converge.
    """
    best = next(iter(rows.values()))
    below = {name: difference(best - r) for name, r in rows.items()}
    return {
        "rows": best.size,
        "verdict": sentence({name: d.clear for name, d in below.items()}, unsound),
        "models": {
            name: {
                "weight": weights[name],
                "elpd": float(r.sum()),
                "below_best": below[name].elpd,
                "below_best_se": below[name].se,
                "told_apart": below[name].clear,
            }
            for name, r in rows.items()
        },
    }


def _model(c: Candidate) -> dict[str, Any]:
    loo = c.loo
    found = {
        "elpd_se": loo.elpd_se,
        "elpd_rows": c.rows.tolist(),
        "converged": c.calibration.converged,
        "pareto_k_max": None if loo.pareto_k is None else float(loo.pareto_k.max()),
        "pareto_k_limit": PARETO_K_MAX,
        "refitted_rows": len(loo.refitted),
        "refits_not_converged": len(loo.unconverged),
        **_scores(loo.scores),
        "log_evidence": c.calibration.draws.log_evidence,
    }
    if c.held is not None:
        scores = c.held.scores
        found["held_out"] = {"rows": scores.n, "elpd": c.held_elpd, **_scores(scores)}
    plain: dict[str, Any] = finite(found)
    return plain


def _scores(s: Scores) -> dict[str, Any]:
    return {"rmse": s.rmse, "crps": s.crps, "coverage_90": s.coverage[0.9].proportion}


def write_comparison(
    comparison: Comparison,
    folder: Path,
    command: Sequence[str],
    hold_out: str = "",
    *,
    environment: Environment | None = None,
    emulator_fails: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Write a comparison into an empty folder and return what `comparison.json` holds.

    What was held out is said in words; the command line is for the page.
    """
    here = environment or Environment.here()
    first = comparison.candidates[0]
    found = {
        **document(comparison, hold_out, emulator_fails),
        "command": list(command),
        "settings": json.loads(json.dumps(asdict(first.calibration.settings))),
        **here.document(),
    }
    with units_of(first.calibration.problem.table.header):
        figure = comparison_figure(comparison)
        mark(figure, first.calibration.problem.table.label)
        image = png_bytes(figure, points=True)
    (folder / "figures").mkdir()
    (folder / FIGURE).write_bytes(image)
    (folder / PAGE).write_text(page(found, image), encoding="utf-8")
    if first.held is not None:
        held = first.held.table
        write_table(folder / HELD_OUT, held.to_write(held.columns))
    for c in comparison.candidates:
        run = folder / "runs" / c.model
        run.mkdir(parents=True)
        save_calibration(c.calibration, run, environment=here)
        keep_verdict(Verdict.of(found["models"][c.model]["verdict"]), run)
    found["files"] = file_hashes(folder)
    (folder / FILE).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    return found


def verdicts_of(folder: Path) -> dict[str, Verdict | None]:
    """Return the verdicts kept in a run or comparison folder, of the latter by model."""
    if not (folder / FILE).exists():
        return {"": kept_verdict(folder)}
    return {path.name: kept_verdict(path) for path in sorted((folder / "runs").iterdir())}


def load_stack(folder: Path) -> tuple[dict[str, Any], list[tuple[float, Calibration]]]:
    """Read a folder of `calib compare`: what it found, and the models that have a weight.

    A CalibError says that it is damaged.
    """
    record = read_record(ComparisonRecord, folder)
    used = {name: m.weight for name, m in record.models.items() if round(m.weight * N_DRAWS) > 0}
    runs = [(weight, load_calibration(folder / "runs" / name)) for name, weight in used.items()]
    return record.document, runs


def recompute_comparison(
    record: ComparisonRecord,
    problems: Mapping[str, Problem],
    folder: Path,
    out: Path,
    progress: Progress,
    workers: int,
) -> Comparison:
    """Compare the models of a folder again, and write that into an empty one, as in the record."""
    held_out = None
    if record.held_out:
        models = [p.bound.model for p in problems.values()]
        used = sorted({c for m in models for c in (*m.conditions, m.output)})
        held_out = read_for_model(folder / HELD_OUT, used)
    how: Any = {"settings": record.settings, "progress": progress, "workers": workers}
    again = compare_problems(list(problems.values()), record.seed, held_out=held_out, **how)
    # Differences are from the first, which with other draws may not be the best.
    by_name = {c.model: c for c in again.candidates}
    again = replace(again, candidates=tuple(by_name[name] for name in record.models))
    write_comparison(again, out, record.command, record.held_out, environment=record.environment)
    return again


FOLDER = "compared"


@dataclass(frozen=True)
class StatedComparison(Section[Mapping[str, Any]]):
    """A comparison as a manifest states it; `calib.check` makes its folder again by itself."""

    document: Mapping[str, Any]
    name, anchor, heading = "comparison", "comparison", "Which model the data prefer"

    def work_out(self, study: Study, pool: Executor, tell: Progress) -> Mapping[str, Any]:
        """Return the document."""
        return self.document

    def record(self, part: Mapping[str, Any]) -> dict[str, Any]:
        """Return every number."""
        return dict(part)

    def view(self, part: Mapping[str, Any], to: Target) -> str:
        """Render the table and the verdict."""
        head, rows = table(part)
        return template("compared.html.j2").render(
            found=part, head=head, rows=rows, page=f"{FOLDER}/{PAGE}"
        )

    @classmethod
    def again(cls, record: Any) -> StatedComparison:
        """Return the section of a manifest's record; raise ValueError if it is none."""
        try:
            table(record)
            str(record["verdict"]), str(record["rows"])
        except (KeyError, TypeError, AttributeError, ValueError):
            raise ValueError("no record of a comparison") from None
        return cls(record)


@dataclass(frozen=True)
class ComparisonSection(Section[Comparison]):
    """Models to be compared on the rows of a task, those that it holds out among them."""

    task: Task
    models: Sequence[str]
    priors: Mapping[str, Path] = field(default_factory=dict)
    settings: SamplerSettings | None = None
    command: Sequence[str] = ()
    workers: int = 1
    name, anchor, heading = "comparison", "comparison", "Which model the data prefer"

    def work_out(self, study: Study, pool: Executor, tell: Progress) -> Comparison:
        """Compare them; processes of its own leave rows out."""
        fitted, held = fitted_rows(self.task)
        how: Any = {"settings": self.settings, "progress": tell, "workers": self.workers}
        return compare(self.models, fitted, study.seed, held_out=held, priors=self.priors, **how)

    @property
    def _held_out(self) -> str:
        return "" if self.task.held_out is None else str(self.task.held_out)

    def record(self, part: Comparison) -> dict[str, Any]:
        """Return every number."""
        return document(part, self._held_out)

    def view(self, part: Comparison, to: Target) -> str:
        """Write the folder, and render the table and the verdict."""
        (to.folder / FOLDER).mkdir()
        found = write_comparison(part, to.folder / FOLDER, self.command, self._held_out)
        return StatedComparison(found).view(found, to)


def plan_comparison(
    tasks: Sequence[Task], models: Sequence[str], priors: Mapping[str, Path]
) -> ComparisonSection:
    """Find the task whose output the models predict, and check that each can be fitted.

    Raises
    ------
    CalibError
        If they are not two models of one output, it is not in the report, or a column is not.
    """
    check_comparable(models)
    output = get_model(models[0]).output
    task = next((t for t in tasks if OUTPUTS[t.output] == output), None)
    if task is None:
        raise CalibError(
            f"the models to compare predict {output}, which the report does not have",
            expected="models of " + ", ".join(OUTPUTS[t.output] for t in tasks),
            hint="add the file that has it, or compare others",
        )
    own = {} if task.prior_path is None else {task.model: task.prior_path}
    given = {**own, **priors}
    for name in models:
        build_problem(name, fitted_rows(task)[0], given.get(name))
    return ComparisonSection(task, models, given)
