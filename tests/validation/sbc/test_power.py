"""The method on a conjugate problem, with exact draws: no false alarms, and wrong ones found."""

from __future__ import annotations

import numpy as np
import pytest

from calib.validation.sbc import holm, p_value, pit

SIMULATIONS, DRAWS, ROWS, EXPERIMENTS = 300, 400, 5, 10


def least_p(rng: np.random.Generator, *, scale: float, shift: float) -> float:
    """Adjusted p value of a run whose posterior is wrong by a factor of its sd and a shift.

    A level theta ~ N(0, 1) seen in `ROWS` readings of unit noise; the posterior is normal.
    """
    theta = rng.standard_normal((SIMULATIONS, 1))
    y = theta + rng.standard_normal((SIMULATIONS, ROWS))
    sd = (1.0 + ROWS) ** -0.5
    mean = y.sum(axis=1, keepdims=True) * sd**2
    drawn = mean + sd * (shift + scale * rng.standard_normal((SIMULATIONS, DRAWS)))

    def log_likelihood(level: np.ndarray) -> np.ndarray:
        return -0.5 * np.square(y[:, :, None] - level[:, None]).sum(axis=1)

    quantities = {
        "theta": (drawn, theta),
        "log_likelihood": (log_likelihood(drawn), log_likelihood(theta)),
        "reading": (
            drawn + rng.standard_normal(drawn.shape), theta + rng.standard_normal(theta.shape)
        ),
    }  # fmt: skip
    p = [
        p_value(pit([[int(b), DRAWS] for b in (d < t).sum(axis=1)], rng))
        for d, t in quantities.values()
    ]
    return min(holm(p))


@pytest.mark.parametrize(
    ("scale", "shift", "found"),
    [
        (0.8, 0.0, True),
        pytest.param(1.25, 0.0, True, marks=pytest.mark.slow),
        (1.0, 0.3, True),
        (1.0, 0.0, False),
    ],
)
def test_wrong_posteriors_are_found_and_right_ones_pass(
    scale: float, shift: float, found: bool
) -> None:
    rng = np.random.default_rng(6)
    alarms = sum(least_p(rng, scale=scale, shift=shift) < 0.05 for _ in range(EXPERIMENTS))
    if found:
        assert alarms >= 0.9 * EXPERIMENTS
    else:
        # A twentieth by chance: five of ten would happen once in sixteen thousand times.
        assert alarms < 5
