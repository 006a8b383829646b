"""The models, one equation set per file, by name in `MODELS`."""

from __future__ import annotations

from pathlib import Path

from calib.data.registry import Registry
from calib.errors import CalibError, meant
from calib.models import magic_formula, soil, traction, wong_reece
from calib.models.base import Array, BoundModel, Conditions, Model, References

__all__ = [
    "MODELS", "Array", "BoundModel", "Conditions", "Model", "References", "example_csv",
    "get_model", "template_csv",
]  # fmt: skip

MODELS: Registry[Model] = Registry(
    "model",
    lambda model: model.name,
    *soil.MODELS[:2],
    *magic_formula.MODELS,
    *soil.MODELS[2:],
    *traction.MODELS,
    *wong_reece.MODELS,
    group="terracalib.models",
)


def example_of(model: Model) -> str:
    """Return a model's own example, or that of the shipped model of its name; empty if none."""
    path = Path(__file__).parent / "examples" / f"{model.name}.csv"
    return model.example or (path.read_text(encoding="utf-8") if path.exists() else "")


def example_csv(model_name: str) -> str:
    """Return an example of the data a model is calibrated on, as CSV.

    Units are in the column names; any other unit in `calib.data.quantities` may stand in their
    place. A CalibError names a model that has no example.
    """
    model = get_model(model_name)
    example = example_of(model)
    if not example:
        raise CalibError(
            f"the model {model_name!r} has no example of its data",
            expected=f"columns {', '.join((*model.conditions, model.output))}",
            hint="write a CSV with these columns, in any of their units (`calib quantities NAME`); "
            'a Model of your own may have an example="..."',
        )
    return example


def template_csv(model_name: str) -> str:
    """Return the example with the column ``run_order``, which any data may have or lack.

    What drifts, jumps or is correlated along a run is only seen in data that have it.
    """
    text = example_csv(model_name)
    head, *rows = text.strip().splitlines()
    if "," not in head or "run_order" in head:
        return text
    numbered = [f"{row},{i}" for i, row in enumerate(rows, start=1)]
    return "\n".join([f"{head},run_order", *numbered, ""])


# Said to whom types commands, and to whom calls functions.
DECLARE = (
    "name the file that declares it: --models FILE or --simulator FILE; in Python, calib.register "
    "the model, or what calib.read_simulator(FILE) returns"
)


def get_model(name: str) -> Model:
    """Return a model by its name; a CalibError lists those there are."""
    if name not in MODELS:
        raise CalibError(
            f"there is no model {name!r}",
            expected=", ".join(MODELS),
            hint=f"{meant(name, MODELS, 'use one of these names,')} or {DECLARE}",
        )
    return MODELS[name]
