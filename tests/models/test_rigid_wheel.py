"""The rigid wheel against integrals by adaptive quadrature, and a published soil and wheel."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from calib.models.wong_reece import contact
from tests.models.ranges import draw

NAMES = ("k1", "k2", "n", "c", "phi", "K", "c1", "c2")
INCH, PSI, POUND = 0.0254, 6.894757, 4.4482216e-3  # m, kPa, kN


def contact_at(theta, conditions):
    return contact(conditions, **dict(zip(NAMES, theta.T[:, :, None], strict=True)))


def integrate(p, c):
    """Pull (kN), torque (kN m) and sinkage (m) of one wheel: forces balanced by bisection."""
    r, b, s = c["tyre_diameter_m"] / 2.0, c["tyre_width_m"], c["slip_ratio"]
    friction, K = math.tan(math.radians(p["phi"])), p["K"] / 1000.0

    def forces(entry):
        turn = (p["c1"] + p["c2"] * s) * entry

        def front(angle):
            height = max(math.cos(angle) - math.cos(entry), 0.0)
            return (p["k1"] + p["k2"] * b) * (r / b * height) ** p["n"]

        def rear(angle):
            return front(entry - angle * (entry - turn) / turn)

        def shear(angle, normal):
            j = r * (entry - angle - (1.0 - s) * (math.sin(entry) - math.sin(angle)))
            return (p["c"] + normal * friction) * (1.0 - math.exp(-j / K))

        def total(what):
            pieces = ((front, turn, entry), (rear, 0.0, turn))
            return sum(
                quad(lambda a, f=f: what(a, f(a), shear(a, f(a))), low, high, epsrel=1e-10)[0]
                for f, low, high in pieces
            )

        lift = r * b * total(lambda a, q, t: q * math.cos(a) + t * math.sin(a))
        pull = r * b * total(lambda a, q, t: t * math.cos(a) - q * math.sin(a))
        return lift, pull, r * r * b * total(lambda a, q, t: t)

    entry = brentq(lambda a: forces(a)[0] - c["normal_load_kn"], 1e-3, 1.5, xtol=1e-12)
    _, pull, torque = forces(entry)
    return pull, torque, r * (1.0 - math.cos(entry))


def test_quadrature_of_all_rows_is_adaptive_quadrature_of_each() -> None:
    _, theta, conditions = draw(3, "wong_reece_pull", k=3, n=3)
    found = contact_at(theta, conditions)
    for i in range(3):
        for j in range(3):
            expected = integrate(
                dict(zip(NAMES, theta[i], strict=True)),
                {name: float(v[j]) for name, v in conditions.items()},
            )
            got = (found.pull[i, j], found.torque[i, j], found.sinkage[i, j])
            # Loads are kilonewtons, and 8 nodes leave some 1e-6 of them.
            np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_a_wheel_is_the_same_alone_and_among_many() -> None:
    _, theta, conditions = draw(5, "wong_reece_pull", k=60, n=50)
    # One in fifty so heavy that few soils carry it: these take longer.
    conditions["normal_load_kn"][7] = 60.0
    among = contact_at(theta, conditions)
    assert 0 < np.isfinite(among.pull[:, 7]).sum() < 60
    assert np.all(np.delete(among.torque, 7, axis=1) > 0.0)
    for j in (3, 7):
        row = {name: v[j : j + 1] for name, v in conditions.items()}
        alone = contact_at(theta, row)
        for field in ("pull", "torque", "sinkage"):
            got, expected = getattr(alone, field)[:, 0], getattr(among, field)[:, j]
            np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


def test_braked_and_bottomless_wheels_have_no_value() -> None:
    _, theta, conditions = draw(6, "wong_reece_pull", k=2, n=2)
    braked = contact_at(theta, conditions | {"slip_ratio": np.array([-0.1, 0.1])})
    assert np.isnan(braked.pull).tolist() == [[True, False]] * 2
    heavy = contact_at(theta, conditions | {"normal_load_kn": np.array([1e6, 1.0])})
    assert np.isnan(heavy.pull).tolist() == [[True, False]] * 2


# Soils and wheels of Table 1 of the source in its units (psi, degrees, inches, pounds), as they
# stand in the public program jcmadsen/pyTerramechanics, with the entry angle (degrees), pull
# (pounds) and torque (pound inches) which that program finds by adaptive quadrature.
COMPACT = (20.0, 2.5, 0.47, 0.1, 33.3, 1.5, 0.43, 0.32)
LOOSE = (0.0, 2.0, 1.15, 0.12, 31.1, 1.5, 0.18, 0.32)
TABLE_1 = [
    (COMPACT, 6.0, 2006.0, 0.1, 36.446326, 151.46736, 19065.930),
    (COMPACT, 6.0, 2006.0, 0.5, 37.499082, 388.64572, 25773.064),
    (LOOSE, 6.0, 1986.0, 0.221, 56.070299, 236.14274, 25522.314),
    (LOOSE, 12.0, 2085.0, 0.5, 48.564828, 333.64494, 27163.118),
]


@pytest.mark.parametrize(("soil", "width", "load", "slip", "entry", "pull", "torque"), TABLE_1)
def test_soils_of_the_source_as_another_program_finds_them(
    soil: tuple[float, ...], width: float, load: float, slip: float, entry: float, pull: float,
    torque: float,
) -> None:  # fmt: skip
    k1, k2, n, c, phi, K, c1, c2 = soil
    theta = np.array([[k1 * PSI, k2 * PSI / INCH, n, c * PSI, phi, 1000.0 * K * INCH, c1, c2]])
    rows = {"slip_ratio": slip, "normal_load_kn": load * POUND, "tyre_width_m": width * INCH,
            "tyre_diameter_m": 2.0 * 24.7 * INCH}  # fmt: skip
    found = contact_at(theta, {name: np.array([v]) for name, v in rows.items()})
    sinkage = 24.7 * INCH * (1.0 - math.cos(math.radians(entry)))
    # Printed to seven or eight digits, from adaptive quadrature to 1e-7.
    np.testing.assert_allclose(found.sinkage[0, 0], sinkage, rtol=1e-6)
    np.testing.assert_allclose(found.pull[0, 0], pull * POUND, rtol=1e-6)
    np.testing.assert_allclose(found.torque[0, 0], torque * POUND * INCH, rtol=1e-6)
