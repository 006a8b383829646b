"""Models compared on the rows of a report, as one of its sections.

The folder ``compared`` beside the page is what `calib compare` would write. The page has the table
and the verdict, from what the manifest says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calib.batch.pool import Pool
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.problem import build_problem
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import get_model
from calib.report.comparison import document, table, write_comparison
from calib.report.page.template import template
from calib.report.sections import Written
from calib.report.study import Progress, Study
from calib.report.study_tasks import Task, fitted_rows
from calib.validation.comparison import Comparison, check_comparable, compare

FOLDER = "compared"


@dataclass(frozen=True)
class ComparisonSection:
    """Models to be compared on the rows of a task, those that it holds out among them."""

    task: Task
    models: Sequence[str]
    priors: Mapping[str, Path] = field(default_factory=dict)
    settings: SamplerSettings | None = None
    command: Sequence[str] = ()
    workers: int = 1

    def begin(self, seed: int, pool: Pool) -> Callable[[Study, Progress], FoundComparison]:
        """Return what compares them, its own processes leaving rows out."""

        def finish(study: Study, tell: Progress) -> FoundComparison:
            fitted, held = fitted_rows(self.task)
            found = compare(
                fitted, self.models, seed, held_out=held, priors=self.priors,
                settings=self.settings, progress=tell, workers=self.workers,
            )  # fmt: skip
            kept = "" if self.task.held_out is None else str(self.task.held_out)
            return FoundComparison(document(found, kept), found, self.command)

        return finish


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


@dataclass(frozen=True)
class StatedComparison:
    """A comparison as a manifest states it; `calib.check` makes the folder again by itself."""

    document: Mapping[str, Any]

    def begin(self, seed: int, pool: Pool) -> Callable[[Study, Progress], FoundComparison]:
        """Return what hands it on."""
        return lambda study, tell: FoundComparison(self.document)


@dataclass(frozen=True)
class FoundComparison:
    """A comparison's document; with the models themselves if their folder is to be written."""

    document: Mapping[str, Any]
    comparison: Comparison | None = None
    command: Sequence[str] = ()
    name: str = "comparison"

    def summary(self) -> None:
        """Add nothing to the summary: the numbers are in ``compared/comparison.json``."""

    def record(self) -> dict[str, Any]:
        """Return every number, for the manifest."""
        return dict(self.document)

    def begin(
        self, folder: Path, *, versions: Mapping[str, str], pdf: bool, pool: Pool
    ) -> Callable[[Progress], Written]:
        """Write the folder; return what writes the piece of the page."""
        if self.comparison is not None:
            (folder / FOLDER).mkdir()
            write_comparison(
                self.comparison, folder / FOLDER, self.command, self.document["held_out"]
            )
        head, rows = table(self.document)
        html = template("compared.html.j2").render(
            found=self.document, head=head, rows=rows, page=f"{FOLDER}/index.html"
        )
        return lambda tell: Written("comparison", "Which model the data prefer", "", html)


def stated_again(record: Any) -> StatedComparison:
    """Return the section of a manifest's record; raise ValueError if it is none."""
    try:
        table(record)
        str(record["verdict"]), str(record["rows"])
    except (KeyError, TypeError, AttributeError, ValueError):
        raise ValueError("no record of a comparison") from None
    return StatedComparison(record)
