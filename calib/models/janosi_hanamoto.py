"""Shear stress from normal stress and displacement: Janosi & Hanamoto (1961).

tau = (c + sigma tan phi)[1 - exp(-j/K)], with tau, c and sigma in kPa, phi in degrees, j and K in
mm. For soils without a peak of the shear stress.
"""

from __future__ import annotations

import numpy as np

from calib.models.base import Array, Conditions, Model


def _predict(theta: Array, conditions: Conditions) -> Array:
    c, phi, K = (theta[:, j, None] for j in range(3))
    strength = c + conditions["normal_stress_kpa"] * np.tan(np.radians(phi))
    return np.asarray(-strength * np.expm1(-conditions["shear_displacement_mm"] / K))


JANOSI_HANAMOTO = Model(
    name="janosi_hanamoto",
    title="Janosi-Hanamoto shear",
    output="shear_stress_kpa",
    conditions=("normal_stress_kpa", "shear_displacement_mm"),
    parameters=("c", "phi", "K"),
    reported={"c": "kPa", "phi": "degree", "K": "mm"},
    predict=_predict,
    latex=(r"$\tau = (c + \sigma_\mathrm{n} \tan \phi)[1 - \exp(-j/K)]$",),
    source="Janosi & Hanamoto (1961), 1st Int. Conf. Mechanics of Soil-Vehicle Systems, Turin",
    applies=(
        "Plastic soils whose shear stress rises to its strength and stays there: loose "
        "sand, saturated clay, most disturbed soils. Soils with a peak (firm, cemented or "
        "rooted) lose strength past it. At one normal stress cohesion and friction cannot "
        "be told apart."
    ),
    letters=(
        "[$tau] the shear stress, [$sigma_n] the normal stress (kPa), [$j] the displacement (mm)"
    ),
    example="""\
normal_stress_kpa,shear_displacement_mm,shear_stress_kpa
10,2,0.632
10,6,2.132
10,15,5.373
10,30,7.43
10,60,8.516
25,2,2.6
25,6,6.079
25,15,11.18
25,30,15.61
25,60,17.47
50,2,4.93
50,6,11.28
50,15,21.35
50,30,29.45
50,60,30.8
""",
)
