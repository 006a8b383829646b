"""Small simulators of wheels, soils and falling bodies, and the drag that one of them lacks.

Models and quantities of one's own, as `calib --models FILE` takes them. Forms and priors are from
textbooks, not from the measured cases.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from calib.data.quantities import Quantity, Range
from calib.data.registry import register
from calib.gap.effects.base import Effect, Known, View
from calib.models.base import Array, Conditions, Model

_POSITIVE = Range(low=0.0)
_WONG = "Wong (2008), Theory of Ground Vehicles"

_QUANTITIES: tuple[tuple[str, str, str, Any, str, dict[str, Any]], ...] = (
    ("fall_distance", "fall_distance_m", "m", "output", "how far a body has fallen", {}),
    ("fall_time", "fall_time_s", "second", "condition", "time since a body was let fall",
     {"suffixes": {"s": "second"}}),
    ("mass_per_area", "mass_per_area_kg_m2", "kg/m**2", "condition",
     "mass of a body over its frontal area",
     {"suffixes": {"kg_m2": "kg/m**2"}, "of_factors": True}),
    ("deviator_stress", "deviator_stress_kpa", "kPa", "output",
     "axial less radial stress of a triaxial test", {"log_scale": True}),
    ("confining_pressure", "confining_pressure_kpa", "kPa", "condition",
     "radial stress less the pore pressure before shearing", {"of_factors": True}),
    ("axial_strain", "axial_strain_ratio", "dimensionless", "condition",
     "shortening over height of a triaxial test",
     {"suffixes": {"ratio": "dimensionless", "percent": "percent"}}),
    ("void_ratio", "void_ratio", "dimensionless", "condition", "pore volume over that of solids",
     {"suffixes": {}, "bare_unit": "dimensionless"}),
    ("pore_pressure_ratio", "pore_pressure_ratio", "dimensionless", "condition",
     "pore pressure that shearing adds, over the confining pressure",
     {"suffixes": {}, "bare_unit": "dimensionless", "range": Range()}),
    ("liquid_limit", "liquid_limit_ratio", "dimensionless", "condition",
     "water content at the liquid limit",
     {"suffixes": {"ratio": "dimensionless", "percent": "percent"}}),
    ("fines", "fines_ratio", "dimensionless", "condition", "mass of silt and clay over all",
     {"suffixes": {"ratio": "dimensionless", "percent": "percent"}}),
    ("compaction_effort", "compaction_effort_kj_m3", "kJ/m**3", "condition",
     "work of the hammer over the volume of soil",
     {"suffixes": {"kj_m3": "kJ/m**3"}, "of_factors": True}),
)  # fmt: skip
for _stem, _column, _unit, _role, _what, _more in _QUANTITIES:
    _kind = {"kPa": "pressure", "m": "length"}.get(_unit, _stem.replace("_", " "))
    register(Quantity(_stem, _column, _kind, _unit, _role, _what, **{"range": _POSITIVE, **_more}))


def _free_fall(theta: Array, conditions: Conditions) -> Array:
    return np.asarray(0.5 * theta[:, :1] * conditions["fall_time_s"] ** 2)


def _triaxial(theta: Array, conditions: Conditions) -> Array:
    modulus, exponent, ratio = (theta[:, j, None] for j in range(3))
    strain, pressure = conditions["axial_strain_ratio"], conditions["confining_pressure_kpa"]
    initial = 1000.0 * modulus * 101.3 * (pressure / 101.3) ** exponent
    return np.asarray(strain / (1.0 / initial + strain / (ratio * pressure)))


def _compacted(theta: Array, conditions: Conditions) -> Array:
    bound = conditions["fines_ratio"] * conditions["liquid_limit_ratio"]
    return np.asarray(1.0 / (1.0 / 2.7 + theta[:, :1] + theta[:, 1:2] * bound))


def _torque(theta: Array, conditions: Conditions) -> Array:
    mobilised = -np.expm1(-np.maximum(conditions["slip_ratio"], 0.0) / theta[:, 1:2])
    radius = 0.5 * conditions["tyre_diameter_m"]
    return np.asarray(conditions["normal_load_kn"] * radius * theta[:, :1] * mobilised)


def _sinkage(theta: Array, conditions: Conditions) -> Array:
    return np.asarray(theta[:, :1] * (1.0 + theta[:, 1:2] * conditions["slip_ratio"]))


def _model(
    name: str, title: str, output: str, conditions: str, predict: Any, latex: str,
    letters: str, source: str, example: str, priors: dict[str, tuple[float, float, str, str]],
    response: Literal["identity", "log"] = "identity",
) -> None:  # fmt: skip
    """Register a model; a prior is the median and sd of the logarithm, the unit and the reason."""
    text = f'model = "{name}"\n' + "".join(
        f'\n[parameters.{p}]\ndist = "lognormal"\nmedian = {median}\nsd_log = {sd}\n'
        f'unit = "{unit}"\nreason = "{reason}"\nsource = "{source}"\n'
        for p, (median, sd, unit, reason) in priors.items()
    )
    columns = tuple(conditions.split())
    rows = "\n".join(example.split())
    register(
        Model(
            name, title, output, columns, tuple(priors)[:-1], predict, latex=(latex,),
            letters=letters, source=source, response=response,
            example=f"{','.join((*columns, output))}\n{rows}\n", priors=text,
        )
    )  # fmt: skip


_model(
    "free_fall", "Fall without drag", "fall_distance_m", "fall_time_s", _free_fall,
    r"$d = g t^2/2$", "[$d] the distance (m), [$t] the time (s)", "Galilei (1638)",
    "0.5,1.2 1,4.8 1.5,11.1 2,19.7 2.5,30.6",
    {"g": (9.81, 0.04, "m/s**2", "Gravity, the scale of the pictures, some drag of a heavy ball"),
     "sigma": (0.1, 1.0, "m", "A body is located to a decimetre")},
)  # fmt: skip
_model(
    "hyperbolic_triaxial", "Hyperbolic stress and strain", "deviator_stress_kpa",
    "axial_strain_ratio confining_pressure_kpa", _triaxial,
    r"$q = \epsilon/[1/E + \epsilon/(R \sigma_3)]$, $E = 1000\, K p_a (\sigma_3/p_a)^n$",
    "[$q] the deviator stress, [$sigma_3] the confining pressure (kPa), [$epsilon] the strain",
    "Duncan & Chang (1970), J. Soil Mech. Found. Div. 96(5), 1629-1653",
    "0.01,50,60 0.02,50,83 0.05,50,103 0.01,200,200 0.02,200,290 0.05,200,390",
    {"K": (0.3, 0.7, "1", "Modulus numbers of sands are 100 to 1000"),
     "n": (0.5, 0.3, "1", "Moduli of sands grow as the root of the pressure"),
     "R": (2.7, 0.35, "1", "(1 + sin phi)/(1 - sin phi) - 1 of 30 to 42 degrees: 2 to 4"),
     "sigma": (0.1, 0.8, "1", "Stresses of like specimens differ by a tenth")},
    response="log",
)  # fmt: skip
_model(
    "liquid_limit_density", "Density at the optimum by the liquid limit", "bulk_density_g_cm3",
    "fines_ratio liquid_limit_ratio", _compacted, r"$1/\rho = 1/2.7 + v_0 + v_1 f w_L$",
    "[$rho] the density (g/cm3), [$f] the part of fines, [$w_L] the liquid limit",
    "after Seed, Woodward & Lundgren (1964), J. Soil Mech. Found. Div. 90(6), 75-105",
    "0.1,0.3,2.06 0.5,0.3,1.9 0.9,0.3,1.8 0.9,0.5,1.65 0.9,0.8,1.45",
    {"v0": (0.12, 0.5, "cm**3/g", "Sand and gravel at their densest have a void ratio of 0.3"),
     "v1": (0.2, 0.7, "cm**3/g", "The optimum is at a fifth to a half of the liquid limit"),
     "sigma": (0.05, 1.0, "g/cm**3", "Densities of like soils differ by some hundredths")},
)  # fmt: skip
_model(
    "janosi_torque", "Torque of a wheel by Janosi and Hanamoto's shear", "driving_torque_knm",
    "slip_ratio normal_load_kn tyre_diameter_m", _torque,
    r"$T = W r \mu [1 - \exp(-s/k)]$",
    "[$T] the torque (kN m), [$W] the load (kN), [$r] the radius (m), [$s] the slip",
    "Janosi & Hanamoto (1961); " + _WONG,
    "0.05,5,1,0.39 0.1,5,1,0.63 0.2,5,1,0.86 0.4,5,1,0.98 0.6,5,1,1.0",
    {"mu": (0.4, 0.5, "1", "Friction of wheel and ground, 15 to 40 degrees"),
     "k": (0.1, 0.8, "1", "Shear modulus over contact length: 10-30 mm over 50-500 mm"),
     "sigma": (0.0003, 1.5, "kN*m", "Some hundredths of the torque of a small wheel")},
)  # fmt: skip
_model(
    "linear_slip_sinkage", "Sinkage that grows with slip", "rut_depth_mm", "slip_ratio",
    _sinkage, r"$z = z_0 (1 + a s)$", "[$z] the sinkage (mm), [$s] the slip",
    "Lyasko (2010), J. Terramech. 47, 21-31, to first order; " + _WONG,
    "0,5 0.1,5.6 0.2,7.1 0.4,9.8 0.6,12.2",
    {"z0": (10.0, 1.0, "mm", "Small wheels sink by millimetres or centimetres"),
     "a": (2.0, 0.8, "1", "Sinkage doubles or trebles towards full slip"),
     "sigma": (0.1, 0.8, "1", "Sinkage scatters by a tenth")},
    response="log",
)  # fmt: skip


class AirDrag(Effect):
    """Drag of the air on a falling body, by the square of its speed.

    With m v' = m g - rho C A v^2/2 the distance is (v_t^2/g) ln cosh(g t/v_t); over that without
    drag, d = g t^2/2, it is ln cosh(sqrt(x))/(x/2), x = rho C d/(m/A).
    """

    name = "air_drag"
    title = "the air holds back what falls"
    latex = (r"$d_\mathrm{f} = d \ln\cosh(\sqrt{x})/(x/2)$, $x = \rho\, C d/(m/A)$",)
    parameters = ("drag_coefficient",)
    outputs = ("fall_distance",)
    covariates = ("mass_per_area",)
    varies = False
    form = ("size",)
    known = (Known("fall_distance", -1),)
    priors = """
model = "air_drag"

[parameters.drag_coefficient]
dist = "lognormal"
median = 0.47
sd_log = 0.35
unit = "1"
reason = "Spheres below the drag crisis 0.47, rough ones 0.25 and less beyond it"
source = "White (2011), Fluid Mechanics, section 7.6; Hoerner (1965), Fluid-Dynamic Drag"
"""

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Shorten the distance."""
        x = 1.2 * phi[:, :1] * np.maximum(mean_response, 1e-9) / view.of("mass_per_area")
        root = np.sqrt(x)
        log_cosh = root + np.log1p(np.exp(-2.0 * root)) - np.log(2.0)
        return np.asarray(mean_response * log_cosh / (0.5 * x))


register(AirDrag())
