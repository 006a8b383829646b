"""A page for each model, from its `Model` and its priors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from declared_text import (
    code,
    picture_name,
    priors_table,
    quantity_link,
    table,
    unit,
    with_picture,
    with_symbols,
    words,
)

from calib.data import Table, read_for_model
from calib.data.quantities import QUANTITIES
from calib.inference.calibration import calibrate
from calib.inference.problem import build_problem
from calib.models import MODELS, Model, example_of
from calib.report.figures.style import png_bytes
from calib.report.labels import NOISE, model_priors
from calib.report.page.template import parametrisation

TITLE = "Models"
LEAD = (
    "Each page is made from the model's declaration and its prior file. `calib models NAME` "
    "says the same in a terminal; [a model of your own](../../extend.md) is one declaration more."
)


def overview() -> list[str]:
    """Return a table of all models."""
    rows = (
        (f"[{code(m.name)}]({m.name}.md)", words(m.title), quantity_link(m.output),
         ", ".join(map(quantity_link, m.conditions)))
        for m in MODELS.values()
    )  # fmt: skip
    return [table(("model", "what", "predicts", "from"), rows)]


def pages() -> dict[str, str]:
    """Return the page of every model by its name."""
    return {name: _page(model) for name, model in MODELS.items()}


def pictures() -> dict[str, Callable[[], bytes]]:
    """Return how to draw each model fitted to its example, by the name of its file."""
    return {
        picture_name(m.name, _page_without_picture(m)): partial(_drawn, m)
        for m in MODELS.values()
        if example_of(m)
    }


def example_table(model: Model) -> Table:
    """Read a model's example."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "example.csv"
        path.write_text(example_of(model), encoding="utf-8")
        return read_for_model(path, (*model.conditions, model.output))


def _drawn(model: Model) -> bytes:
    problem = build_problem(model.name, example_table(model))
    return png_bytes(calibrate(problem, seed=1).plot())


def _page(model: Model) -> str:
    page = _page_without_picture(model)
    if not example_of(model):
        return page
    said = f"{words(model.title)}, fitted to the example below: readings, median and bands"
    return with_picture(page, model.name, said)


def _page_without_picture(model: Model) -> str:
    return "\n".join(
        [
            f"# {model.name}\n",
            f"{words(model.title)}.\n",
            *_equation(model),
            *_use(model),
            *_parameters(model),
            *_example(model),
        ]
    )


def _equation(model: Model) -> list[str]:
    number = f", {model.numbers}" if model.numbers else ""
    after = f"After {words(model.source)}{number}.\n" if model.source else ""
    letters = f"{with_symbols(model.letters)}.\n" if model.letters else ""
    return ["## Equation\n", *(f"{part}\n" for part in model.latex), letters, after]


def _use(model: Model) -> list[str]:
    rows = [
        (quantity_link(c), unit(QUANTITIES[c].unit), words(QUANTITIES[c].range.describe()))
        for c in (model.output, *model.conditions)
    ]
    limits = f"{words(model.applies)}\n" if model.applies else ""
    parabolic = ""
    if model.parabolic_in:
        parabolic = (
            f"Its coefficients are parabolas in {quantity_link(model.parabolic_in)}: they are not "
            "to be trusted beyond the values that were calibrated.\n"
        )
    return [
        "## When it applies, and its limits\n", limits, parabolic,
        "## Units\n",
        "It works in these units; a file may use [any other](../quantities/index.md) in its "
        "column names. The first one is predicted.\n",
        table(("quantity", "unit", "allowed"), rows),
        f"{NOISE[model.response]}\n",
    ]  # fmt: skip


def _parameters(model: Model) -> list[str]:
    found = [
        "## Priors of the sampled parameters\n",
        _sampled(model),
        priors_table(model_priors(model)),
        "`normal(mean, sd)`, `lognormal(median, sd of the logarithm)`, `half_normal(sd)`, "
        "`uniform(lower, upper)`, on `[lower, upper]` where truncated. A prior with `x 5 (column)` "
        "is a part of that column's median, 5 where the data lack it. Print the file with "
        f"`calib priors {model.name}`, edit a copy, and pass it with `--priors`.\n",
    ]
    if model.meanings:
        rows = ((code(name), words(said)) for name, said in model.meanings.items())
        found += ["## Meanings of the parameters\n", table(("parameter", "meaning"), rows)]
    if not model.by_sampled:
        rows = ((code(name), unit(u)) for name, u in model.reported.items())
        found += ["## Reported parameters\n", table(("parameter", "unit"), rows)]
    return found


def _sampled(model: Model) -> str:
    """Say which parameters are sampled, at the reference conditions of the model's example."""
    if "{" not in model.parametrisation:
        return f"{words(model.parametrisation)}\n"
    references = model.bind(example_table(model).columns).references
    said = parametrisation(model.parametrisation, references)
    return f"{words(said)} (The numbers are those of the example below.)\n"


def _example(model: Model) -> list[str]:
    example = example_of(model)
    if not example:
        return []
    return [
        "## Example of its data\n",
        f"`calib template {model.name}` prints it:\n",
        f"```text\n{example}```\n",
    ]
