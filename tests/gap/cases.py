"""Small cases made from the simulators themselves, with an effect's own formula on top."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from calib.data import Table, table_from_arrays, write_table
from calib.data.quantities import OUTPUTS, physical_role, role_of
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import Case
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.effects import EFFECTS, Effect
from calib.gap.ranking import Ranking
from calib.inference.prior_files import default_priors, read_priors
from calib.inference.problem import build_problem

SHARED = Path(__file__).resolve().parents[3] / "shared" / "cases"

MODELS = {"drawbar_pull": "magic_formula_pressure", "rut_depth": "modified_bekker"}
PULL_ONLY = {"drawbar_pull": "magic_formula"}
# Noise sd on the scale of the response: kN, ln mm, g/cm^3.
NOISE = {"drawbar_pull": 0.03, "rut_depth": 0.05, "bulk_density": 0.02}
# True parameters of the simulators, in the order of the model's parameters.
TRUTH: Mapping[str, Mapping[str, float]] = {
    "magic_formula_pressure": {
        "K_lo": 0.14, "K_hi": 0.11, "K_bend": 0.05, "D_lo": 1.5, "D_hi": 1.2, "D_bend": 0.05,
        "G_lo": 3.0, "G_hi": 3.0, "G_bend": 0.0, "C": 1.5,
    },
    "magic_formula": {"K": 0.12, "C": 1.5, "D": 1.4, "G": 3.0, "Sh": 0.0, "Sv": 0.0},
    "modified_bekker": {"z_ref": 25.0, "n0": 1.0, "n1": 0.6},
    "bekker": {"z_ref": 25.0, "n": 1.0},
}  # fmt: skip
# Sizes that are large beside the noise.
LARGE: Mapping[str, Mapping[str, float]] = {
    "force_offset": {"offset": 0.12},
    "sensor_drift": {"drift": 0.25, "curvature": 1.0, "half_way": 10.0, "zero_at": 0.0},
    "slip_zero_shift": {"radius_error": 0.05},
    "rate_effect": {"pull": 0.08, "slope": 0.08, "rut": -0.08},
    "lug_thrust": {"thrust": 0.09, "slip_scale": 0.25, "digging": 0.15},
    "rut_rebound": {"towed": 0.1, "growth": 0.8, "slip_exponent": 1.0},
}
# The effects that the larger tests choose among.
CHOICE = {name: EFFECTS[name] for name in LARGE}


def conditions(n: int, seed: int, *, varied: bool) -> dict[str, np.ndarray]:
    """Draw conditions; covariates are constant in the laboratory and vary in the field."""
    rng = np.random.default_rng(seed)
    psi = rng.permutation(np.resize([18.0, 30.0, 42.0], n))
    ground = 30.0 * psi**0.5
    drawn = {
        "run_order": np.arange(n, dtype=float),
        "slip_ratio": rng.permutation(np.linspace(0.02, 0.65, n)),
        "inflation_pressure_psi": psi,
        "average_ground_pressure_kpa": ground,
        "normal_load_kn": np.full(n, 5.0),
        "speed_m_s": np.full(n, 0.3),
        "pass_number": np.ones(n),
    }
    if varied:
        drawn["speed_m_s"] = rng.permutation(np.resize([0.1, 0.3, 1.0, 2.0], n))
        drawn["pass_number"] = rng.permutation(np.resize([1.0, 2.0, 3.0, 4.0], n))
    return drawn


def make_case(
    effect: str | None = None,
    *,
    size: Mapping[str, float] | None = None,
    models: Mapping[str, str] = MODELS,
    seed: int = 1,
    n_lab: int = 30,
    n_field: int = 27,
    n_fresh: int = 0,
    noise: float = 1.0,
) -> Case:
    """Simulate a laboratory campaign, and a field campaign with an effect in it.

    Parameters
    ----------
    effect : str, optional
        None for a field campaign in which the simulator holds.
    size : mapping of str to float
        Parameters of the effect; its entry of `LARGE` by default.
    noise : float
        Factor on the usual noise.
    """
    rng = np.random.default_rng(seed + 1000)
    lab, field = (conditions(n, seed + i, varied=i > 0) for i, n in enumerate((n_lab, n_field)))
    both = []
    for columns in (lab, field):
        placed = {OUTPUTS[o]: np.linspace(1.0, 2.0, columns["run_order"].size) for o in models}
        both.append(table_from_arrays(columns | placed))
    draft = Case("draft", both[0], both[1], models)
    truth = simulate(draft, effect, size)
    tables = []
    for columns, part in zip((lab, field), truth, strict=True):
        measured = {}
        for o, location in part.items():
            drawn = location + noise * NOISE[o] * rng.standard_normal(location.size)
            measured[OUTPUTS[o]] = np.exp(drawn) if o == "rut_depth" else drawn
        tables.append(table_from_arrays(columns | measured))
    fresh = None
    if n_fresh:
        later = conditions(n_fresh, seed + 2, varied=True)
        later["run_order"] += n_field - n_fresh
        fresh = table_from_arrays(later)
    return Case(effect or "null", tables[0], tables[1], models, fresh)


def parameters(effect: str, size: Mapping[str, float]) -> np.ndarray:
    """Return an effect's parameters, shape (1, n): as given; the others in the prior's middle.

    Parameters that may be zero, because their prior is centred there, are zero.
    """
    names = EFFECTS[effect].parameters
    path = default_priors(f"effects/{effect}")
    priors = read_priors(path, effect, names, {"normal_load_kn": 5.0})
    middle = priors.to_natural(np.array([[p.loc for p in priors.free]]))[0]
    return np.array([[size.get(n, float(m)) for n, m in zip(names, middle, strict=True)]])


def simulate(
    draft: Case, effect: str | None, size: Mapping[str, float] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return noise-free lab and field outputs on the scale of the response."""
    view = campaigns(draft).view
    lab: dict[str, np.ndarray] = {}
    field: dict[str, np.ndarray] = {}
    bounds, thetas = {}, {}
    for o, model in draft.models.items():
        bound = build_problem(model, draft.lab).bound
        theta = np.array([[TRUTH[model][name] for name in bound.model.parameters]])
        lab[o] = bound.mean_response(theta, bound.model.select(draft.lab.columns))[0]
        field[o] = bound.mean_response(theta, bound.model.select(view.conditions))[0]
        bounds[o], thetas[o] = bound, theta
    if effect is None:
        return lab, field
    acting = EFFECTS[effect]
    phi = parameters(effect, LARGE[effect] if size is None else size)
    roles = {o: physical_role(o) for o in bounds}
    base = {roles[o]: bounds[o].from_response(v[None]) for o, v in field.items()}
    view = replace(view, base=base)
    for o, bound in bounds.items():
        columns = {role_of(c): c for c in bound.model.conditions}
        plain = {role: view.conditions[c] for role, c in columns.items()}
        true = acting.on_conditions(phi, roles[o], plain, view)
        location = bound.mean_response(thetas[o], {columns[role]: v for role, v in true.items()})
        field[o] = acting.on_output(phi, roles[o], location, view)[0]
    return lab, field


def write_case(case: Case, folder: Path) -> Path:
    """Write a case folder as the contract has it."""
    folder.mkdir(parents=True)
    lines = ['calibration = "lab.csv"', 'field = "field.csv"']
    write_table(folder / "lab.csv", dict(case.lab.columns))
    write_table(folder / "field.csv", dict(case.field.columns))
    if case.new_conditions is not None:
        lines.append('predict = "fresh.csv"')
        write_table(folder / "fresh.csv", dict(case.new_conditions.columns))
    lines += ["[models]", *(f'{o} = "{m}"' for o, m in case.models.items())]
    (folder / "case.toml").write_text("\n".join(lines) + "\n")
    return folder


def table_without(table: Table, *names: str) -> Table:
    """Return a table without some columns."""
    return table_from_arrays({k: v for k, v in table.columns.items() if k not in names})


@cache
def campaigns_of(effect: str | None, outputs: str = "both") -> Campaigns:
    """Return a case made ready; pull only, or both outputs."""
    models = {"both": MODELS, "pull": PULL_ONLY}[outputs]
    return campaigns(make_case(effect, models=models))


def ranking_of(effect: str | None) -> Ranking:
    """Rank the hypotheses of a case with both outputs, among a few effects."""
    return diagnosis_of(effect).ranking


@cache
def diagnosis_of(effect: str | None, n_fresh: int = 9) -> Diagnosis:
    """Diagnose a case with both outputs, among a few effects."""
    return diagnose(make_case(effect, n_fresh=n_fresh), 1, effects=CHOICE)


@cache
def pull_diagnosis(effect: str | None) -> Diagnosis:
    """Diagnose a case of drawbar pull alone, among three effects."""
    few: dict[str, Effect] = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "lug_thrust")}
    return diagnose(make_case(effect, models=PULL_ONLY), 1, effects=few)
