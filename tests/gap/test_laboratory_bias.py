"""What ignoring the causes of a gap would have done to the simulators' parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.describe import gap_document
from calib.gap.hypotheses import Hypothesis
from calib.gap.laboratory_bias import laboratory_bias
from calib.gap.mixture import Mixture
from tests.gap.cases import campaigns_of, diagnosis_of
from tests.gap.fits import fit_at, moved


@pytest.mark.filterwarnings("error")
def test_medians_spreads_and_shifts_are_those_of_weighted_draws():
    data = campaigns_of(None, "pull")
    middle = fit_at(data, Hypothesis("none"))
    part = middle.forward.theta_slices["drawbar_pull"]
    draws = np.tile(middle.psi, (100, 1))
    # One coordinate is even over 0..1 but for one draw far off, the next has no spread.
    draws[:, part.start] = np.append(np.linspace(0.0, 1.0, 99), 1e6)
    elsewhere = middle.psi.copy()
    elsewhere[part] = 5.0
    mixed = Mixture(data, (replace(middle, sample=draws),), (1.0,), 1)
    (o,) = data.outputs
    spread, narrow, *_ = laboratory_bias(mixed, moved(middle, elsewhere))
    t = np.tile(middle.psi[part], (4, 1))
    t[:, 0] = (0.16, 0.5, 0.84, 5.0)
    t[3] = 5.0
    low, median, high, ignoring = o.priors.to_natural(t)[:, :1].ravel()
    sd = 0.5 * (high - low)
    # Quantiles of 99 even draws.
    assert spread.median == pytest.approx(median, rel=0.05)
    assert spread.sd == pytest.approx(sd, rel=0.05)
    assert spread.ignoring == pytest.approx(ignoring)
    assert spread.shift_in_sds == pytest.approx((ignoring - median) / sd, rel=0.1)
    assert (narrow.sd, narrow.shift_in_sds) == (0.0, 0.0)


def test_every_free_parameter_is_there_and_a_cause_that_is_ignored_moves_some():
    for effect, shifted in ((None, False), ("rate_effect", True)):
        found = diagnosis_of(effect)
        d = gap_document(found)
        names = [(o.name, p.name) for o in found.data.outputs for p in o.priors.free]
        assert [(b.output, b.parameter) for b in d.laboratory_bias] == names
        # Where nothing acts the same posterior is summarised, at its median and its mode.
        assert (max(abs(b.shift_in_sds) for b in d.laboratory_bias) >= 1.0) == shifted
