"""What is done with the embedded data: the report's calibrations, and designs of simulations.

Only the conditions are taken from the embedded data for a design; every output is simulated.
Drawbar pull and rut depth are calibrated at 18 and 42 psi and held out at 30 psi, as in the report;
the other models are held out between the conditions that they are calibrated at.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from calib.data import hold_out, table_from_arrays
from calib.he2019.embedded import load_he2019
from calib.models import get_model
from calib.validation.replicate import Design, ModelDesign

if TYPE_CHECKING:
    from calib.report.study import Task

_PSI = "inflation_pressure_psi"
# Between the embedded samples: cone index (kPa) and water content (g/g).
_HELD_INDEX, _HELD_WATER = (130.0, 400.0, 1300.0), (0.02, 0.05, 0.08)


def _held_30_psi(name: str, key: str) -> Design:
    fitted, held = hold_out(load_he2019(key), _PSI, 30.0)
    text = f"{len(fitted)} embedded conditions of 18 and 42 psi; held out: {len(held)} of 30 psi"
    return Design(name, fitted, get_model(name).select(held.columns), text)


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


DESIGNS = (
    *(ModelDesign(n, partial(_density, n)) for n in ("ayers_perumpral",
                                                     "ayers_perumpral_volumetric")),
    ModelDesign("magic_formula", _one_pressure),
    ModelDesign("magic_formula_pressure",
                partial(_held_30_psi, "magic_formula_pressure", "drawbar_pull")),
    ModelDesign("bekker", partial(_held_30_psi, "bekker", "rut_depth")),
    ModelDesign("modified_bekker", partial(_held_30_psi, "modified_bekker", "rut_depth")),
)  # fmt: skip


def he2019_tasks() -> tuple[Task, ...]:
    """Return the paper's three calibrations on the embedded, reconstructed data.

    The 30 psi rows of drawbar pull and rut depth are held out.
    """
    # Late: every command registers the designs, and few work a report out.
    from calib.report.study import HoldOut, Task

    held = HoldOut("inflation_pressure_psi", 30.0)
    models = {
        "bulk_density": ("ayers_perumpral", None),
        "drawbar_pull": ("magic_formula_pressure", held),
        "rut_depth": ("modified_bekker", held),
    }
    return tuple(Task(key, model, load_he2019(key), rows) for key, (model, rows) in models.items())
