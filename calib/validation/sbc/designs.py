"""The conditions under which each model is simulated: those of its example, or of its design."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calib.data import Table, read_for_model
from calib.data.registry import Registry
from calib.models import Model, example_csv, get_model
from calib.models.base import Array


@dataclass(frozen=True)
class Design:
    """Where a model is measured.

    Parameters
    ----------
    table : Table
        The rows to calibrate on; their outputs are placeholders for simulated ones.
    held : mapping of str to ndarray, shape (m,)
        Conditions of the rows that are held out.
    text : str
        Both in words.
    """

    model: str
    table: Table
    held: dict[str, Array]
    text: str

    @property
    def watched(self) -> int:
        """The held-out row at which a single prediction is followed."""
        return len(next(iter(self.held.values()))) // 2


@dataclass(frozen=True)
class ModelDesign:
    """Where a model is measured, unless at the conditions of its own example.

    Parameters
    ----------
    make : callable
        ``() -> Design``.
    """

    model: str
    make: Callable[[], Design]

    def register(self) -> None:
        """Have the model simulated there."""
        DESIGNS.add(self)


DESIGNS: Registry[ModelDesign] = Registry("design", lambda design: design.model)


def design_of(model_name: str, data: Path | None = None) -> Design:
    """Return the design of a model, or that of a campaign's CSV if one is given.

    Raises
    ------
    CalibError
        If it has neither a design nor an example, or the file cannot be read.
    """
    model = get_model(model_name)
    known = DESIGNS.get(model.name)
    if data is not None:
        design = _of_file(model, data, str(data))
    else:
        design = known.make() if known is not None else _of_example(model)
    # For noise that is correlated along a run, if the priors ask for it.
    order = {"run_order": np.arange(1.0, len(design.table) + 1.0)}
    return replace(design, table=replace(design.table, columns=order | dict(design.table.columns)))


def _of_example(model: Model) -> Design:
    """The conditions of a model's own example."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{model.name}.csv"
        path.write_text(example_csv(model.name), encoding="utf-8")
        return _of_file(model, path, "the model's example")


def _of_file(model: Model, path: Path, where: str) -> Design:
    table = read_for_model(path, (*model.conditions, model.output))
    held = {name: 0.5 * (v[1:] + v[:-1]) for name, v in model.select(table.columns).items()}
    n = len(table)
    text = f"{n} conditions of {where}; held out: {n - 1} midway between them"
    return Design(model.name, table, held, text)
