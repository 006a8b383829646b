"""The conditions under which each model is simulated: those it is used under on the embedded data.

Only the conditions are taken from the embedded data; every output is simulated. Drawbar pull and
rut depth are calibrated at 18 and 42 psi and held out at 30 psi, as in the report; the other models
are held out between the conditions that they are calibrated at.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calib.data import Table, hold_out, read_for_model, table_from_arrays
from calib.he2019.datasets.embedded import load_he2019
from calib.models import Model, example_csv, get_model
from calib.models.base import Array

__all__ = ["Design", "design_of"]

_PSI = "inflation_pressure_psi"
# Between the embedded samples: cone index (kPa) and water content (g/g).
_HELD_INDEX, _HELD_WATER = (130.0, 400.0, 1300.0), (0.02, 0.05, 0.08)


@dataclass(frozen=True)
class Design:
    """Where a model is measured.

    Parameters
    ----------
    model : str
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


def design_of(model_name: str) -> Design:
    """Return the design of a model.

    Raises
    ------
    CalibError
        If there is no such model.
    """
    model = get_model(model_name)
    if model.priors:
        return _of_example(model)
    if model.output == "bulk_density_g_cm3":
        return _density(model.name)
    if model.name == "magic_formula":
        return _one_pressure()
    key = "drawbar_pull" if model.output == "drawbar_pull_kn" else "rut_depth"
    fitted, held = hold_out(load_he2019(key), _PSI, 30.0)
    text = f"{len(fitted)} embedded conditions of 18 and 42 psi; held out: {len(held)} of 30 psi"
    return Design(model.name, fitted, model.select(held.columns), text)


def _of_example(model: Model) -> Design:
    """The conditions of a model's own example."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{model.name}.csv"
        path.write_text(example_csv(model.name), encoding="utf-8")
        table = read_for_model(path, (*model.conditions, model.output))
    held = {name: 0.5 * (v[1:] + v[:-1]) for name, v in model.select(table.columns).items()}
    n = len(table)
    text = f"{n} conditions of the model's example; held out: {n - 1} midway between them"
    return Design(model.name, table, held, text)


def _density(name: str) -> Design:
    table = load_he2019("bulk_density")
    index, water = (a.ravel() for a in np.meshgrid(_HELD_INDEX, _HELD_WATER, indexing="ij"))
    held = {"cone_index_kpa": index, "gravimetric_water_content": water}
    text = "36 embedded conditions; held out: 9 between them"
    if name == "ayers_perumpral_volumetric":
        # theta_v = theta_g gamma_d, with water at 1 g/cm^3.
        columns = dict(table.columns)
        density = columns["bulk_density_g_cm3"]
        columns["volumetric_water_content"] = columns.pop("gravimetric_water_content") * density
        held["volumetric_water_content"] = held.pop("gravimetric_water_content") * density.mean()
        table = table_from_arrays(columns, source=table.source)
        text += "; volumetric water content is gravimetric times the embedded density"
    return Design(name, table, held, text)


def _one_pressure() -> Design:
    table = load_he2019("drawbar_pull")
    rows = table.take(table[_PSI] == 18.0)
    slip = rows["slip_ratio"]
    held = {"slip_ratio": 0.5 * (slip[1:] + slip[:-1])}
    text = f"{len(rows)} embedded slips of 18 psi; held out: {slip.size - 1} midway between them"
    return Design("magic_formula", rows, held, text)
