"""Problems with known answers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.inference.problem import Problem, build_problem
from calib.models import get_model, magic_formula

SLIPS = np.array([0.0, 2.5, 5, 7.5, 10, 12.5, 15, 17.5, 20, 30, 40, 50, 60, 70]) / 100 + 0.02


def _grid(*axes):
    return [a.ravel() for a in np.meshgrid(*axes, indexing="ij")]


def _conditions(model: str) -> dict[str, np.ndarray]:
    if model == "magic_formula":
        return {"slip_ratio": SLIPS}
    if model == "magic_formula_pressure":
        psi, slip = _grid([18.0, 30.0, 42.0], SLIPS)
        return {"slip_ratio": slip, "inflation_pressure_psi": psi}
    if model in ("bekker", "modified_bekker"):
        kpa, slip = _grid([106.6, 178.2], np.linspace(0.0, 0.2, 9))
        both = {"average_ground_pressure_kpa": kpa, "slip_ratio": slip}
        return both if model == "modified_bekker" else {"average_ground_pressure_kpa": kpa}
    index, water = _grid(np.geomspace(200.0, 1500.0, 6), np.linspace(0.02, 0.09, 5))
    kind = "volumetric" if model.endswith("volumetric") else "gravimetric"
    return {"cone_index_kpa": index, f"{kind}_water_content": water}


TRUTH = {
    "magic_formula": {"K": 0.2, "C": 1.55, "D": 1.6, "G": 4.0, "Sh": 0.0, "Sv": 0.0},
    "magic_formula_pressure": {
        "K_lo": 0.2, "K_hi": 0.1, "K_bend": 0.1, "D_lo": 1.6, "D_hi": 0.6, "D_bend": 0.08,
        "G_lo": 2.0, "G_hi": 9.0, "G_bend": -0.2, "C": 1.55,
    },
    "bekker": {"z_ref": 20.0, "n": 1.2},
    "modified_bekker": {"z_ref": 20.0, "n0": 1.9, "n1": 1.2},
    "ayers_perumpral": {"gamma_ref": 1.5, "C2": 0.003, "C3": 0.1, "C4": 10.0},
    "ayers_perumpral_volumetric": {"gamma_ref": 1.5, "A2": 10.0, "A3": 0.003, "A4": 0.1},
}  # fmt: skip


def make_problem(model: str, *, noise: float = 0.0, fixed=None, rows=None, columns=None):
    """A problem whose data are the model's at `TRUTH`, with noise on the response."""
    cols = columns or _conditions(model)
    if rows is not None:
        cols = {name: values[rows] for name, values in cols.items()}
    bound = get_model(model).bind(cols)
    theta = np.array([TRUTH[model][name] for name in bound.model.parameters])
    location = bound.mean_response(theta, cols)[0]
    location = location + noise * np.random.default_rng(7).standard_normal(location.size)
    table = table_from_arrays({**cols, bound.model.output: bound.from_response(location)})
    if model == "magic_formula" and fixed is None:
        fixed = {"Sh": 0.0, "Sv": 0.0}
    return build_problem(model, table, fixed=fixed), theta


@pytest.fixture
def problem_of() -> Callable[..., tuple[Problem, np.ndarray]]:
    return make_problem


@pytest.fixture(scope="session")
def table_4() -> tuple[Problem, float]:
    """Fourteen pulls of which Table 4 at 18 psi is the least-squares optimum, and its cost."""
    B, C, D, E, cost = 0.0794, 1.5619, 1.6480, -0.1026, 0.0485
    slip = 100.0 * SLIPS
    h = 1e-6
    columns = []
    for j in range(4):
        up, down = [B, C, D, E], [B, C, D, E]
        up[j] += h
        down[j] -= h
        columns.append(
            (magic_formula.magic_formula(slip, *up) - magic_formula.magic_formula(slip, *down))
            / (2 * h)
        )
    q, _ = np.linalg.qr(np.column_stack(columns))
    noise = np.random.default_rng(1).standard_normal(slip.size)
    noise -= q @ (q.T @ noise)
    noise *= np.sqrt(cost / (noise @ noise))
    pull = magic_formula.magic_formula(slip, B, C, D, E) + noise
    table = table_from_arrays({"slip_ratio": SLIPS, "drawbar_pull_kn": pull})
    return build_problem("magic_formula", table, fixed={"Sh": 0.0, "Sv": 0.0}), cost
