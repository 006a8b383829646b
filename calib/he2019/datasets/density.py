"""Bulk density against cone index and water content, reconstructed from Table 1.

What Table 1 implies about the samples that are not printed:

- *Cone index.* With C4 = 43, density goes with the 43rd root of cone index, and with C1 as
  printed a density of 1.5 g/cm^3 would need 0.07 kPa. Cone indices of a soil that carries a tyre
  (some 100 to 2000 kPa) give 1.77 to 1.91 g/cm^3, a compacted sandy loam. These are used here.
- *Spread.* R^2 and RMSE together fix the variance of the fitted densities, hence the spread of
  the cone indices: with the design below they run from 84 to 1890 kPa.
- *Extremes.* 2.94 % of such a density is 1.9 RMSE, so the errors have no tails.

The number of samples is not printed: 36 is assumed, six water contents by six cone indices, each
about its nominal value. Errors are orthogonal to the Jacobian at Table 1, which makes it a
least-squares optimum, and to the second derivatives as well, so that J'J is the whole Hessian and
the optimum is a strict one in spite of C1, C2 and C3 being all but collinear.
"""

from __future__ import annotations

import numpy as np

from calib.he2019.datasets.published import PUBLISHED
from calib.he2019.datasets.reconstruct import Array, nearest_errors, normalised_basis, read_only
from calib.models.ayers_perumpral import bulk_density as eq_1

# C2 has a standard error of 20 and is printed to 0.001; C1 is known to a factor of 10^30 and is
# printed to 1 in 10^4. So densities must be written to 1e-8 g/cm^3 for all printed digits to
# return; it is not a claim on any instrument. A fit that stops at a change of 1e-8 in the sum of
# squares, or that takes one-sided differences, ends elsewhere in the valley, whatever the data.
DECIMALS = 8

_SEED = 1982
_WATER_LEVELS, _INDEX_LEVELS = 6, 6
_WATER_RANGE = (0.012, 0.086)
_MID_CONE_INDEX_KPA = 400.0
# Samples sit about their nominal values, by this part of a step.
_SCATTER = 0.3
# All errors but the largest stay below this one, so that the extreme is attained once.
_SECOND_LARGEST = 0.028


def _design(rng: np.random.Generator, variance: float) -> tuple[Array, Array]:
    """Place the samples so that the densities of Table 1 have a given variance."""
    low, high = _WATER_RANGE
    step = (high - low) / (_WATER_LEVELS - 1)
    water = np.repeat(np.linspace(low, high, _WATER_LEVELS), _INDEX_LEVELS)
    water = water + step * _SCATTER * rng.uniform(-0.5, 0.5, water.size)
    water = np.round(np.minimum(water, PUBLISHED.setup.largest_water_content.value), 4)
    place = np.tile(np.linspace(-1.0, 1.0, _INDEX_LEVELS), _WATER_LEVELS)
    place = place + 2.0 / (_INDEX_LEVELS - 1) * _SCATTER * rng.uniform(-0.5, 0.5, place.size)

    from scipy.optimize import brentq  # late, as in `reconstruct`

    def index(spread: float) -> Array:
        return _MID_CONE_INDEX_KPA * np.exp(spread * place)

    def excess(spread: float) -> float:
        fitted = eq_1(index(spread), water, **PUBLISHED.bulk_density.values)
        return float(np.var(fitted)) - variance

    return np.round(index(brentq(excess, 0.2, 6.0)), 1), water


def _must_vanish(fitted: Array, water: Array) -> Array:
    """Return an orthonormal basis of what the errors must be orthogonal to.

    Derivatives of Eq 1 of the first order are spanned by the fitted density times 1, 1/q, d/q
    and ln(density), where d = theta_g - C3 and q = C2 + d^2; those of the second order by
    products of these. The constant makes the errors sum to zero.
    """
    offset = water - PUBLISHED.bulk_density.values["C3"]
    q = PUBLISHED.bulk_density.values["C2"] + offset**2
    log = np.log(fitted)
    first = [1.0 / fitted, np.ones_like(q), 1.0 / q, offset / q, log]
    second = [1.0 / q**2, offset / q**2, log / q, log * offset / q, log**2]
    return normalised_basis(fitted[:, None] * np.column_stack([*first, *second]))


def bulk_density() -> dict[str, Array]:
    """Return the reconstructed bulk densities of 36 samples.

    By cone_index_kpa, gravimetric_water_content and bulk_density_g_cm3.
    """
    table = PUBLISHED.bulk_density
    quality = {name: figure.value for name, figure in table.quality.items()}
    n = _WATER_LEVELS * _INDEX_LEVELS
    sse = quality["rmse"] ** 2 * (n - len(table.estimates))
    explained = sse * quality["r_squared"] / (1.0 - quality["r_squared"])
    rng = np.random.default_rng(_SEED)
    index, water = _design(rng, explained / n)
    fitted = eq_1(index, water, **table.values)
    basis = _must_vanish(fitted, water)

    def equal(errors: Array) -> tuple[Array, Array]:
        values = np.append(basis.T @ errors, errors @ errors - sse)
        return values, np.vstack([basis.T, 2.0 * errors])

    drawn = rng.standard_normal(n) * np.sqrt(sse / n)
    # Relative to the observed density, observed = fitted/(1 - relative).
    lower = fitted / (1.0 + _SECOND_LARGEST) - fitted
    upper = fitted / (1.0 - _SECOND_LARGEST) - fitted
    worst = int(np.argmax(np.abs(drawn)))
    extreme = np.sign(drawn[worst]) * quality["max_relative_error"]
    lower[worst] = upper[worst] = fitted[worst] / (1.0 - extreme) - fitted[worst]
    density = fitted + nearest_errors(drawn, equal, lower, upper)
    return read_only(
        cone_index_kpa=index,
        gravimetric_water_content=water,
        bulk_density_g_cm3=np.round(density, DECIMALS),
    )
