"""Net traction of a tyre whose contact with the ground is an ellipse.

    P = (A c + W tan phi) G(s l/K) - rho W,   A = pi l w/4,   p = W/A

The load presses evenly on an ellipse of the length l and the width w. A part of the tread that has
come a distance x into the contact has sheared the soil by j = s x, and Janosi and Hanamoto's stress
(c + p tan phi)[1 - exp(-j/K)], averaged over the ellipse, is its strength times

    G(q) = 1 - (4/pi) int_0^(pi/2) exp(-q sin t) cos^2 t dt = 1 - (2/q)[I1(q) - L1(q)]

with the modified Bessel and Struve functions of order one. G(q) is 4q/(3 pi) for small q and
1 - 4/(pi q) for large. That is the form of the models with an elliptic contact of Upadhyaya &
Wulfsohn (1993) and of Rosca, Carlescu and others (2006-2022), of whose papers summaries and
symbols could be seen, not how they find the contact from the deflection and the sinkage: its
length and width are measured here, and the motion resistance coefficient rho is free.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.models.base import Array, Columns, Conditions, Model, References, Rows

_MM_PER_M = 1000.0
# Where 20 nodes and the series are off by 2e-13 at most.
_FAR = 34.0


def _rule(size: int) -> tuple[Array, Array]:
    t, weight = np.polynomial.legendre.leggauss(size)
    t = 0.25 * np.pi * (t + 1.0)
    return np.sin(t), np.asarray(weight * np.cos(t) ** 2)


_NODES, _WEIGHTS = _rule(20)


def mobilised(q: Array) -> Array:
    """Return G(q), the part of the strength that is mobilised on average over the ellipse.

    Parameters
    ----------
    q : ndarray
        Slip times length of the contact over the shear deformation modulus; G is odd in it.

    Returns
    -------
    ndarray
        Dimensionless, of the shape of q.
    """
    size = np.abs(q)
    near = np.minimum(size, _FAR)
    rest = np.zeros_like(near)
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        rest += weight * np.exp(-node * near)
    # Of the integral, with the root of 1 - u^2 in powers of u = sin t.
    x = np.maximum(size, _FAR) ** -2.0
    series = 1.0 - x * (1.0 + x * (3.0 + x * (45.0 + x * (1575.0 + x * 99225.0))))
    far = 4.0 / np.pi * np.sqrt(x) * series
    return np.asarray(np.sign(q) * (1.0 - np.where(size > _FAR, far, rest)))


def _area(conditions: Conditions) -> Array:
    """Return the area of the contact, m2."""
    length, width = conditions["contact_length_mm"], conditions["contact_width_mm"]
    return np.asarray(0.25 * np.pi * length * width / _MM_PER_M**2)


def _references(conditions: Conditions) -> dict[str, float]:
    pressure = conditions["normal_load_kn"] / _area(conditions)
    return {"contact_pressure_ref_kpa": float(np.exp(np.log(pressure).mean()))}


def _prepare(conditions: Conditions, references: References) -> Rows:
    load = conditions["normal_load_kn"]
    return {
        "load": load,
        "held": references["contact_pressure_ref_kpa"] * _area(conditions),
        "slid": conditions["slip_ratio"] * conditions["contact_length_mm"],
    }


def _pull(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    mu, share, K, rho = columns
    strength = mu * ((1.0 - share) * rows["load"] + share * rows["held"])
    return np.asarray(strength * mobilised(rows["slid"] / K) - rho * rows["load"])


def _report(theta: Array, references: References) -> dict[str, Array]:
    mu, share, K, rho = theta.T
    cohesion = mu * share * references["contact_pressure_ref_kpa"]
    return {"c": cohesion, "phi": np.degrees(np.arctan(mu * (1.0 - share))), "K": K, "rho": rho}


def _theta(reported: Mapping[str, float], references: References) -> Array:
    cohesion = reported["c"] / references["contact_pressure_ref_kpa"]
    mu = cohesion + float(np.tan(np.radians(reported["phi"])))
    return np.array([mu, cohesion / mu, reported["K"], reported["rho"]])


ELLIPTIC_CONTACT = Model(
    name="elliptic_contact",
    title="Net traction of an elliptic contact",
    output="drawbar_pull_kn",
    conditions=("slip_ratio", "normal_load_kn", "contact_length_mm", "contact_width_mm"),
    parameters=("mu", "share", "K", "rho"),
    reported={"c": "kPa", "phi": "degree", "K": "mm", "rho": "1"},
    location=_pull,
    report_theta=_report,
    theta_from_reported=_theta,
    bind_references=_references,
    prepare=_prepare,
    latex=(
        r"$P = (A c + W \tan\phi) G(s l/K) - \rho W$",
        r"$A = \pi l w/4$",
        r"$G(q) = 1 - \frac{4}{\pi} \int_0^{\pi/2} \exp(-q \sin t) \cos^2 t dt$",
    ),
    source=(
        "Janosi & Hanamoto (1961) over the elliptic contact of Upadhyaya & Wulfsohn (1993), "
        "J. Terramechanics 30(2), 85-100, and Rosca et al. (2020), HAICTA: the form"
    ),
    applies=(
        "Tyres that flatten so much that they press about evenly on plastic soil: not rigid "
        "wheels, and not firm soil with a peak of the shear stress. Length and width of the "
        "contact are measured, as prints on hard ground or in the rut. At one mean pressure "
        "cohesion and friction cannot be told apart; where no slip is low, neither can strength "
        "and motion resistance."
    ),
    letters=(
        "[$P] the pull (kN), [$W] the load (kN), [$s] the slip, [$A] the area of the contact (m2), "
        "[$l] and [$w] its length and width (m), [$K] the shear deformation modulus (m)"
    ),
    parametrisation=(
        "The strength over load mu at a mean pressure of {contact_pressure_ref_kpa:.4g} kPa (mean "
        "of the data) is sampled, and the part of it that is due to cohesion: c and phi are almost "
        "collinear where pressures differ little. The published constants follow."
    ),
    example="""\
slip_ratio,normal_load_kn,contact_length_mm,contact_width_mm,drawbar_pull_kn
0.02,5,270,180,-0.2634
0.06,5,270,180,0.5856
0.12,5,270,180,1.18
0.2,5,270,180,1.425
0.35,5,270,180,1.617
0.02,5,160,175,-0.2377
0.06,5,160,175,-0.07257
0.12,5,160,175,0.6448
0.2,5,160,175,1.108
0.35,5,160,175,1.402
0.02,9,250,190,-0.651
0.06,9,250,190,0.7071
0.12,9,250,190,1.614
0.2,9,250,190,2.181
0.35,9,250,190,3.012
""",
)
