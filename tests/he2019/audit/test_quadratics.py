"""The linear programme against brute force over the box."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from calib.he2019.audit.bounds import NAMES
from calib.he2019.audit.pull import nearest, nearest_by_signs, targets
from calib.he2019.published import PUBLISHED


@pytest.mark.parametrize("what", NAMES)
@pytest.mark.parametrize("signs", [(1, -1, 1), (1, 1, -1), (-1, -1, -1)])
def test_no_coefficients_of_the_box_come_nearer(what, signs):
    figures = [PUBLISHED.pressure.estimates[name] for name in NAMES[what]]
    pressures, wanted = targets(PUBLISHED, what)
    axes = [
        np.linspace(s * abs(f.value) - f.half_unit, s * abs(f.value) + f.half_unit, 61)
        for s, f in zip(signs, figures, strict=True)
    ]
    c = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = c @ np.vander(pressures, 3, increasing=True).T
    deviation = np.abs(values / np.abs(wanted) - np.sign(wanted)).max(axis=1)
    found = nearest(PUBLISHED, what, signs=signs)
    assert found.deviation <= deviation.min() + 1e-12
    # It is attained: by its own coefficients, which lie in the box.
    own = np.abs(found.values / np.abs(wanted) - np.sign(wanted)).max()
    assert own == pytest.approx(found.deviation, rel=1e-9, abs=1e-12)
    for x, axis in zip(found.coefficients, axes, strict=True):
        assert axis[0] - 1e-12 <= x <= axis[-1] + 1e-12


def test_targets_are_table_4():
    pressures, D = targets(PUBLISHED, "D")
    assert pressures.tolist() == [18.0, 30.0, 42.0]
    assert D.tolist() == [1.6480, 1.0071, 0.5954]
    assert targets(PUBLISHED, "BCD")[1][0] == pytest.approx(0.0794 * 1.5619 * 1.6480)


def test_all_eight_readings():
    found = nearest_by_signs(PUBLISHED, "D")
    assert set(found) == set(product((1, -1), repeat=3))
    assert min(found, key=lambda s: found[s].deviation) == (1, -1, 1)
