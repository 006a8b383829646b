"""Random parameter vectors and conditions of every model, over their physical ranges."""

from __future__ import annotations

import numpy as np

from calib.models import MODELS, Array, BoundModel

# Ranges of the sampled parameters. The density ones keep the implicit equation monotone (a root
# is then the only one): A2 exceeds the steepest the water term can be, w/sqrt(A3).
_RIGID_WHEEL = {
    "k1": (5.0, 60.0), "k2": (300.0, 3000.0), "n": (0.5, 1.3), "c": (0.1, 6.0),
    "phi": (20.0, 40.0), "K": (5.0, 30.0), "c1": (0.18, 0.43), "c2": (0.2, 0.4),
}  # fmt: skip
THETA = {
    "magic_formula": {
        "K": (0.02, 0.4), "C": (1.0, 2.0), "D": (0.2, 3.0), "G": (0.1, 20.0),
        "Sh": (-3.0, 3.0), "Sv": (-0.3, 0.3),
    },
    "magic_formula_pressure": {
        "K_lo": (0.05, 0.4), "K_hi": (0.05, 0.4), "K_bend": (-0.3, 0.2),
        "D_lo": (0.3, 3.0), "D_hi": (0.3, 3.0), "D_bend": (-0.3, 0.1),
        "G_lo": (1.0, 9.0), "G_hi": (1.0, 9.0), "G_bend": (-0.5, 0.1), "C": (1.0, 2.0),
    },
    "bekker": {"z_ref": (3.0, 200.0), "n": (0.4, 3.0)},
    "modified_bekker": {"z_ref": (3.0, 200.0), "n0": (0.8, 3.0), "n1": (-0.5, 3.0)},
    "bekker_plate": {"z_ref": (3.0, 200.0), "n": (0.4, 3.0), "share": (0.05, 0.95)},
    "reece": {"z_ref": (3.0, 200.0), "n": (0.4, 3.0), "share": (0.05, 0.95)},
    "reece_plate": {"k1": (1.0, 200.0), "k2": (100.0, 10_000.0), "n": (0.4, 2.0)},
    "lyasko": {"z_ref": (3.0, 200.0), "n": (0.4, 3.0), "a": (-0.5, 0.9)},
    "wismer_luth": {"c1": (0.4, 1.0), "c2": (0.1, 0.6), "c3": (0.5, 2.0), "c4": (0.0, 0.1)},
    "brixius": {
        "c1": (0.4, 1.0), "c2": (0.05, 0.2), "c3": (4.0, 11.0), "c4": (0.5, 2.0), "c5": (0.2, 1.0),
    },
    "upadhyaya": {"p20": (0.1, 0.8), "r": (-0.05, 0.2), "c": (2.0, 20.0)},
    "elliptic_contact": {
        "mu": (0.2, 1.2), "share": (0.0, 0.9), "K": (1.0, 40.0), "rho": (0.01, 0.3),
    },
    "maclaurin_rut": {"z_ref": (3.0, 200.0), "m": (0.5, 2.0), "q": (0.0, 1.0)},
    "janosi_hanamoto": {"c": (0.0, 10.0), "phi": (10.0, 40.0), "K": (3.0, 30.0)},
    **{f"wong_reece_{part}": _RIGID_WHEEL for part in ("pull", "torque", "sinkage")},
    "ayers_perumpral": {
        "gamma_ref": (1.0, 2.0), "C2": (1e-3, 0.05), "C3": (0.02, 0.7), "C4": (5.0, 45.0),
    },
    "ayers_perumpral_volumetric": {
        "gamma_ref": (1.0, 2.0), "A2": (8.0, 45.0), "A3": (3e-3, 0.05), "A4": (0.02, 0.7),
    },
}  # fmt: skip
CONDITIONS = {
    "slip_ratio": (-0.05, 0.8),
    "inflation_pressure_psi": (18.0, 42.0),
    "average_ground_pressure_kpa": (40.0, 250.0),
    "cone_index_kpa": (200.0, 2500.0),
    "gravimetric_water_content": (0.0, 0.3),
    "volumetric_water_content": (0.0, 0.4),
    "normal_load_kn": (1.0, 6.0),
    "tyre_width_m": (0.2, 0.4),
    "tyre_diameter_m": (0.8, 1.4),
    "tyre_deflection_mm": (10.0, 60.0),
    "section_height_mm": (150.0, 300.0),
    "contact_length_mm": (120.0, 350.0),
    "contact_width_mm": (100.0, 300.0),
    "plate_width_mm": (50.0, 300.0),
    "normal_stress_kpa": (5.0, 100.0),
    "shear_displacement_mm": (0.0, 60.0),
}
REFERENCES = {
    "p_mid_psi": 30.0, "p_half_psi": 12.0, "p_ref_kpa": 120.0, "ci_ref_kpa": 700.0,
    "water_ref": 0.08, "b_ref_mm": 120.0, "contact_pressure_ref_kpa": 90.0, "numeric_ref": 80.0,
    "flattened_ref": 0.06, "diameter_ref": 1.1,
}  # fmt: skip


def draw(
    seed: int, name: str, k: int = 3, n: int = 5
) -> tuple[BoundModel, Array, dict[str, Array]]:
    """Random parameter vectors, conditions and references of a model, bound."""
    rng = np.random.default_rng(seed)
    model = MODELS[name]
    theta = np.stack([rng.uniform(*THETA[name][p], k) for p in model.parameters], axis=1)
    conditions = {c: rng.uniform(*CONDITIONS[c], n) for c in model.conditions}
    if "wong_reece" in name:  # of driven wheels only
        conditions["slip_ratio"] = np.abs(conditions["slip_ratio"])
    needed = model.bind_references(conditions)
    references = {r: REFERENCES[r] for r in needed}
    return BoundModel(model, references), theta, conditions
