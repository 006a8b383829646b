"""A bevameter's plates and shear ring, as Project Chrono's deformable terrain (SCM) models them.

A plate of radius b that is pressed in by z carries F = (Kc/b + Kphi) z^n pi b^2. A ring of radii
0.15 and 0.2 m and area A under a mass m, turned by an angle, has sheared the soil under it by j;
its torque is T = L (c A + m g tan phi) (1 - exp(-j/K)), with L the mean radius and j = L angle.
`ring_steady` is T at large j, `ring_mean` the mean of T at 1, 2 and 3 degrees, and `ring` is T.

Geometry and bounds of the uniform priors are those of uwsbel/sbel-reproducibility (README.md).
"""

import numpy as np

import calib

INNER_M, OUTER_M, GRAVITY = 0.15, 0.2, 9.81
ARM_M = (INNER_M + OUTER_M) / 2.0
AREA_M2 = np.pi * (OUTER_M**2 - INNER_M**2)

for stem, unit, role, description in (
    ("plate_force", "kN", "output", "force on a plate"),
    ("plate_sinkage", "mm", "condition", "depth to which a plate is pressed"),
    ("plate_radius", "mm", "condition", "radius of a round plate"),
    ("steady_torque", "N*m", "output", "torque of a shear ring when it no longer rises"),
    ("mean_torque", "N*m", "output", "mean torque of a shear ring at 1, 2 and 3 degrees"),
    ("ring_torque", "N*m", "output", "torque of a shear ring"),
    ("ring_mass", "kg", "condition", "mass that loads a shear ring"),
    ("ring_rotation", "degree", "condition", "angle by which a shear ring has turned"),
):
    suffix, kind = {
        "kN": ("kn", "force"), "mm": ("mm", "length"), "N*m": ("nm", "torque"),
        "kg": ("kg", "mass"), "degree": ("deg", "angle"),
    }[unit]  # fmt: skip
    suffixes = {suffix: unit} | ({"n": "N"} if unit == "kN" else {})
    calib.register(
        calib.Quantity(
            stem=stem, canonical=f"{stem}_{suffix}", kind=kind, unit=unit, role=role,
            description=description, suffixes=suffixes,
        )
    )  # fmt: skip


def plate(theta, conditions):
    """Return forces (kN), shape (k, n), of (Kc, Kphi, n) in kN and m."""
    kc, kphi, n = theta.T[:, :, None]
    b, z = conditions["plate_radius_mm"] / 1000.0, conditions["plate_sinkage_mm"] / 1000.0
    return (kc / b + kphi) * z**n * np.pi * b**2


def strength(theta, conditions):
    """Return the torque (N m) at large displacement, (k, n), of c in kPa and phi in degrees."""
    friction = GRAVITY * conditions["ring_mass_kg"] * np.tan(np.radians(theta[:, 1:2]))
    return ARM_M * (1000.0 * theta[:, :1] * AREA_M2 + friction)


def mobilised(theta, degrees):
    """Return the part of the strength that acts at an angle, K in mm."""
    return -np.expm1(-np.radians(degrees) * 1000.0 * ARM_M / theta[:, 2:3])


def ring(theta, conditions):
    """Return torques (N m), (k, n)."""
    return strength(theta, conditions) * mobilised(theta, conditions["ring_rotation_deg"])


def ring_mean(theta, conditions):
    """Return the means (N m) of the torques at 1, 2 and 3 degrees, (k, n)."""
    return strength(theta, conditions) * sum(mobilised(theta, d) for d in (1, 2, 3)) / 3.0


THEIRS = 'reason = "Bounds of the public calibration"\nsource = "uwsbel/sbel-reproducibility"'
BOUNDS = {
    "Kc": (-1e4, 1e4, "kN/m^(n+1)", "cohesive modulus of sinkage"),
    "Kphi": (0.0, 1e4, "kN/m^(n+2)", "frictional modulus of sinkage"),
    "n": (0.0, 3.0, "1", "exponent of sinkage"),
    "c": (0.0, 10.0, "kPa", "cohesion"),
    "phi": (0.0, 90.0, "degree", "angle of friction"),
    "K": (0.0, 100.0, "mm", "shear deformation modulus"),
}
SIGMA = 'reason = "The sd that the public calibration fixed, times or over 20"\nsource = "Assumed"'


def _priors(model, parameters, sigma, unit):
    tables = [
        f'[parameters.{p}]\ndist = "uniform"\nlower = {BOUNDS[p][0]}\nupper = {BOUNDS[p][1]}\n'
        f'unit = "{BOUNDS[p][2]}"\n{THEIRS}'
        for p in parameters
    ]
    noise = f'[parameters.sigma]\ndist = "lognormal"\nmedian = {sigma}\nsd_log = 1.5\n'
    return "\n\n".join([f'model = "{model}"', *tables, f'{noise}unit = "{unit}"\n{SIGMA}'])


for name, title, output, conditions, parameters, predict, sigma, unit in (
    ("scm_plate", "Force on a plate by Bekker", "plate_force_kn",
     ("plate_radius_mm", "plate_sinkage_mm"), ("Kc", "Kphi", "n"), plate, 0.1, "kN"),
    ("ring_steady", "Steady torque of a shear ring", "steady_torque_nm",
     ("ring_mass_kg",), ("c", "phi"), strength, 1.0, "N*m"),
    ("ring_mean", "Mean torque of a shear ring at 1, 2 and 3 degrees", "mean_torque_nm",
     ("ring_mass_kg",), ("c", "phi", "K"), ring_mean, 1.0, "N*m"),
    ("ring", "Torque of a shear ring", "ring_torque_nm",
     ("ring_mass_kg", "ring_rotation_deg"), ("c", "phi", "K"), ring, 1.0, "N*m"),
):  # fmt: skip
    calib.register(
        calib.Model(
            name=name, title=title, output=output, conditions=conditions, parameters=parameters,
            predict=predict, reported={p: BOUNDS[p][2] for p in parameters},
            meanings={p: BOUNDS[p][3] for p in parameters},
            source="Bekker (1956); Janosi & Hanamoto (1961); after Hu et al., Project Chrono",
            priors=_priors(name, parameters, sigma, unit),
        )
    )  # fmt: skip
