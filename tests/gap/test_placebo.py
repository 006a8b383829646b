"""What wrong hypotheses leave of a gap."""

from __future__ import annotations

import numpy as np
import pytest

from calib.gap.diagnose import placebos
from tests.gap.cases import diagnosis_of


def test_placebos_are_on_one_noise():
    found = diagnosis_of("sensor_drift")
    placebo = placebos(found)
    best = found.ranking.order[0]
    residual = np.concatenate(list(found.ranking.best(best).field_residuals.values()))
    assert placebo.left[best] == pytest.approx(np.sqrt(np.mean(np.square(residual))))
    # A wrong hypothesis inflates its own noise: on its own scale it would look as good.
    assert placebo.left["none"] > 1.3 * placebo.left[best]
    assert placebo.before > placebo.left["none"] - 1e-9
    assert placebo.shrink(best) == pytest.approx(1.0 - placebo.left[best] / placebo.before)
    assert "unknown" in placebo.left
    assert not any("+" in n for n in placebo.left if n != best)
