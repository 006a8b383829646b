"""Soils of the independent reality: how they carry, shear and give way under a slipping wheel.

Nothing here is a calibrated model of the package: pressures come from depth, strength from
cohesion and friction, and slip sinkage from a soil that carries less while it is sheared.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from challenge.tyre import CONTACT_WIDTH_M

type Array = NDArray[np.float64]
type Scalar = float | Array

PressureLaw = Literal["reece", "mobilised"]
SlipLaw = Literal["flow", "remould"]


@dataclass(frozen=True)
class Soil:
    """Mechanical properties of one soil, one value per row of conditions where they vary.

    Every number is a float or an array of shape ``(N,)``; `columns` gives shape ``(N, 1)``.

    Attributes
    ----------
    cohesion_kpa, tan_friction : float or array
        Mohr-Coulomb strength.
    shear_modulus_m : float or array
        Shear displacement at which 63 % of the strength is mobilised.
    cohesive_bearing : float or array
        Factor of cohesion in the bearing pressure, k'c of Reece.
    frictional_bearing_kpa : float or array
        Frictional share of the bearing pressure (unit weight times width times k'phi).
    exponent : float or array
        Sinkage exponent (``reece``) or growth with surcharge (``mobilised``).
    mobilisation_m : float or array
        Depth over which the ``mobilised`` bearing pressure builds up.
    slip_flow, slip_dig : float or array
        Two strengths of the loss of support under shear: flow of the sheared soil to the
        sides and removal by the tread (``flow``), or rate and power of the remoulding.
    slip_scale : float or array
        Slip over which the sideways flow builds up.
    residual, softening_m : float or array
        Strength left after the peak, as a fraction, and the shear displacement beyond the peak
        over which it is lost.
    pan_depth_m, pan_stiffness : float or array
        Depth of a hard layer and its stiffness in kPa/m.
    unit_weight : float
        kN/m^3.
    """

    cohesion_kpa: Scalar
    tan_friction: Scalar
    shear_modulus_m: Scalar
    cohesive_bearing: Scalar
    frictional_bearing_kpa: Scalar
    exponent: Scalar
    mobilisation_m: Scalar = 0.03
    slip_flow: Scalar = 0.0
    slip_dig: Scalar = 0.0
    slip_scale: Scalar = 0.25
    residual: Scalar = 1.0
    softening_m: Scalar = 0.05
    pan_depth_m: Scalar = 1.0
    pan_stiffness: Scalar = 0.0
    unit_weight: float = 15.5
    extra_flow: Scalar = 1.0
    pressure_law: PressureLaw = "reece"
    slip_law: SlipLaw = "flow"

    def columns(self, n: int) -> Soil:
        """Return the soil with every number as an array of shape ``(n, 1)``."""
        changed: dict[str, Array] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, str):
                row = np.broadcast_to(np.asarray(value, dtype=np.float64), (n,))
                changed[field.name] = row[:, None]
        return replace(self, **changed)  # type: ignore[arg-type]

    def scaled(self, *, support: Scalar = 1.0, cohesion: Scalar = 1.0) -> Soil:
        """Return the soil with its bearing support and its cohesion multiplied.

        `support` multiplies the whole bearing pressure; `cohesion` the shear strength's
        cohesive part and, with it, the cohesive share of the bearing pressure.
        """
        return replace(
            self,
            cohesion_kpa=self.cohesion_kpa * cohesion,
            cohesive_bearing=self.cohesive_bearing * support,
            frictional_bearing_kpa=self.frictional_bearing_kpa * support,
        )

    def stronger(self, factor: Array, support: float, cohesion: float, friction: float) -> Soil:
        """Return the soil with its strength times a factor, to a power for each part of it."""
        soil = self.scaled(support=factor**support, cohesion=factor**cohesion)
        return replace(soil, tan_friction=soil.tan_friction * factor**friction)


def give(soil: Soil, slip: Array) -> Array:
    """Return how many times deeper the soil lets a slipping wheel sink (1 without slip).

    Two mechanisms are known [1]_ [2]_: sheared soil flows sideways from under the wheel, which
    is complete once the shear is mobilised, and the tread carries soil away, in proportion to
    ``slip / (1 - slip)``. The alternative is remoulding of the soil skeleton by shear.

    References
    ----------
    .. [1] A. R. Reece, Proc. Inst. Mech. Eng. 180(2A), 1965, doi 10.1243/PIME_AUTO_1965_180_009_02.
    .. [2] M. Lyasko, J. Terramechanics 47 (2010) 21-31, doi 10.1016/j.jterra.2009.05.001.
    """
    size = np.minimum(np.abs(slip), 0.95)
    if soil.slip_law == "remould":
        base = np.exp(soil.slip_flow * size ** (1.0 - 0.3 * np.tanh(soil.slip_dig)))
    else:
        flow = soil.slip_flow * -np.expm1(-size / soil.slip_scale)
        base = 1.0 + flow + soil.slip_dig * size / (1.0 - size)
    return np.asarray(base * soil.extra_flow, dtype=np.float64)


def bearing_pressure(soil: Soil, depth: Array, giving: Array) -> Array:
    """Return the normal pressure in kPa at a depth in m, shapes ``(N, 1)`` or ``(N, Q)``.

    Reece's dimensionless form ``(c k'c + gamma b k'phi)(z/b)^n`` [1]_, or a bearing capacity that
    is mobilised with depth and grows with surcharge. `giving` stretches the depths.

    References
    ----------
    .. [1] A. R. Reece, Proc. Inst. Mech. Eng. 180(2A), 1965, doi 10.1243/PIME_AUTO_1965_180_009_02.
    """
    felt = np.maximum(depth, 0.0) / giving
    strength = soil.cohesion_kpa * soil.cohesive_bearing + soil.frictional_bearing_kpa
    if soil.pressure_law == "reece":
        support = strength * (felt / CONTACT_WIDTH_M) ** soil.exponent
    else:
        grown = 1.0 + soil.exponent * felt / CONTACT_WIDTH_M
        support = strength * grown * -np.expm1(-felt / soil.mobilisation_m)
    pan = soil.pan_stiffness * np.maximum(depth - soil.pan_depth_m, 0.0)
    return np.asarray(support + pan, dtype=np.float64)


def shear_stress(soil: Soil, normal_kpa: Array, displacement_m: Array) -> Array:
    """Return the shear stress in kPa that soil under `normal_kpa` gives at a displacement.

    Janosi and Hanamoto's exponential mobilisation of the Mohr-Coulomb strength [1]_, odd in the
    displacement; beyond three shear moduli the strength falls to its residual [2]_.

    References
    ----------
    .. [1] Z. Janosi, B. Hanamoto, Proc. 1st Int. Conf. Mechanics of Soil-Vehicle Systems, 1961.
    .. [2] J. Y. Wong, J. Preston-Thomas, J. Terramechanics 20 (1983) 225-234,
       doi 10.1016/0022-4898(83)90029-7.
    """
    size = np.abs(displacement_m)
    mobilised = -np.expm1(-size / soil.shear_modulus_m)
    beyond = np.maximum(size - 3.0 * soil.shear_modulus_m, 0.0) / soil.softening_m
    left = soil.residual + (1.0 - soil.residual) * np.exp(-beyond)
    strength = soil.cohesion_kpa + normal_kpa * soil.tan_friction
    return np.asarray(np.sign(displacement_m) * strength * mobilised * left, dtype=np.float64)


def draw_soil(rng: np.random.Generator, *, slip_sinkage: bool) -> Soil:
    """Draw a sandy loam at random.

    Ranges: cohesion 1.5-9 kPa, rubber on soil 10-24 degrees, shear modulus 3-12 mm, 20 mm of
    sinkage at 60-200 kPa: sandy loams as tabulated by Wong [1]_, friction at the tread about
    two thirds of the soil's own, so that the pull is that of the tyre in the source paper.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    slip_sinkage : bool
        Whether the soil gives way under shear.

    References
    ----------
    .. [1] J. Y. Wong, Theory of Ground Vehicles, 4th ed., Wiley 2008, table 2.3.
    """
    law: PressureLaw = "reece" if rng.random() < 0.65 else "mobilised"
    cohesion = float(rng.uniform(1.5, 9.0))
    cohesive_share = float(rng.uniform(0.15, 0.5))
    at_20mm = float(np.exp(rng.uniform(np.log(60.0), np.log(200.0))))
    exponent = float(rng.uniform(0.7, 1.5)) if law == "reece" else float(rng.uniform(0.5, 3.0))
    mobilisation = float(rng.uniform(0.025, 0.07))
    if law == "reece":
        strength = at_20mm / (0.02 / CONTACT_WIDTH_M) ** exponent
    else:
        grown = 1.0 + exponent * 0.02 / CONTACT_WIDTH_M
        strength = at_20mm / (grown * -np.expm1(-0.02 / mobilisation))
    soil = Soil(
        cohesion_kpa=cohesion,
        tan_friction=float(np.tan(np.radians(rng.uniform(10.0, 24.0)))),
        shear_modulus_m=float(rng.uniform(0.003, 0.012)),
        cohesive_bearing=cohesive_share * strength / cohesion,
        frictional_bearing_kpa=(1.0 - cohesive_share) * strength,
        exponent=exponent,
        mobilisation_m=mobilisation,
        residual=float(rng.uniform(0.65, 1.0)),
        softening_m=float(rng.uniform(0.03, 0.1)),
        unit_weight=float(rng.uniform(14.0, 17.0)),
        pressure_law=law,
    )
    return _with_slip_sinkage(soil, rng) if slip_sinkage else soil


def _with_slip_sinkage(soil: Soil, rng: np.random.Generator) -> Soil:
    law: SlipLaw = "flow" if rng.random() < 0.6 else "remould"
    if law == "flow":
        flow, dig = float(rng.uniform(0.6, 2.4)), float(rng.uniform(0.0, 0.3))
    else:
        flow, dig = float(rng.uniform(0.7, 1.7)), float(rng.uniform(0.0, 1.5))
    scale = float(rng.uniform(0.3, 0.9))
    return replace(soil, slip_law=law, slip_flow=flow, slip_dig=dig, slip_scale=scale)
