"""The slow reference agrees with a closed form, and the diagnosis with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from calib.gap.hypotheses import Hypothesis
from calib.gap.ranking import calibrate_lab
from calib.gap.screen import Screen
from tests.gap.cases import ranking_of
from tests.gap.fits import straight_line
from tests.gap.reference import ln_evidence, reference
from tests.gap.test_posterior import closed_form, noises


def test_its_evidence_is_that_of_the_closed_form() -> None:
    data = straight_line(1)
    forward = Screen(data, *calibrate_lab(data, 1), 1).forward(Hypothesis("none"))
    grid, each = noises(data)
    exact = logsumexp([closed_form(data, noise) for noise in grid]) + each
    found, psi = ln_evidence(forward, 2000, np.random.default_rng(1))
    # Of two thousand particles, over a dozen powers.
    assert found == pytest.approx(exact, abs=0.25)
    assert psi.shape == (2000, 2)


@pytest.mark.slow
@pytest.mark.parametrize("effect", [None, "force_offset", "lug_thrust"])
def test_the_diagnosis_agrees_with_it(effect: str | None) -> None:
    ranking = ranking_of(effect)
    there, _ = reference(ranking, 1000, 2, 1)
    whole = sum(ranking.probability[name] for name in there)
    for name, p in there.items():
        assert ranking.probability[name] / whole == pytest.approx(p, abs=0.1)
