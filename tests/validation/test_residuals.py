"""Residuals over the noise, and what is tested of them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.validation.scores import normal_order


def test_sorted_normals_lie_where_they_are_expected() -> None:
    middle, low, high = normal_order(15)
    drawn = np.sort(np.random.default_rng(1).standard_normal((20_000, 15)), axis=1)
    assert middle == pytest.approx(drawn.mean(axis=0), abs=0.03)
    assert low == pytest.approx(np.quantile(drawn, 0.025, axis=0), abs=0.08)
    assert high == pytest.approx(np.quantile(drawn, 0.975, axis=0), abs=0.08)
