"""What the report of the embedded data is of."""

from __future__ import annotations

from calib.he2019.datasets.embedded import load_he2019
from calib.report.study_tasks import HoldOut, Task


def he2019_tasks() -> tuple[Task, ...]:
    """Return the paper's three calibrations on the embedded, reconstructed data.

    The 30 psi rows of drawbar pull and rut depth are held out.
    """
    held = HoldOut("inflation_pressure_psi", 30.0)
    models = {
        "bulk_density": ("ayers_perumpral", None),
        "drawbar_pull": ("magic_formula_pressure", held),
        "rut_depth": ("modified_bekker", held),
    }
    return tuple(Task(key, model, load_he2019(key), rows) for key, (model, rows) in models.items())
