"""Which causes act, whatever acts besides: sums over explanations, and shares that sum to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.diagnose import verdict
from calib.gap.hypotheses import joined, singles
from calib.gap.mixture import (
    _sizes,
    inclusion_probability,
)
from tests.gap.cases import CHOICE, LARGE, campaigns_of, diagnosis_of
from tests.gap.fits import SIGMA, fit_at


def test_inclusion_is_the_sum_over_explanations():
    p = {"none": 0.1, "unknown": 0.1, "a": 0.3, "a+b": 0.2, "a+unknown": 0.2, "b+c+unknown": 0.1}
    assert inclusion_probability(p) == pytest.approx({"a": 0.7, "b": 0.3, "c": 0.1, "unknown": 0.4})


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        ({"none": 0.6, "a": 0.4}, "none"),
        ({"unknown": 0.6, "a": 0.4}, "unknown"),
        # A listed effect with something unlisted besides is that effect.
        ({"unknown": 0.3, "a+unknown": 0.4, "a": 0.2, "none": 0.1}, "effect"),
        ({"a+b": 0.3, "a+c": 0.3, "none": 0.4}, "effect"),
        ({"a": 0.4, "b": 0.4, "none": 0.2}, "ambiguous"),
    ],
)
def test_the_verdict_is_of_what_acts(probability, expected):
    assert verdict(probability) == expected


@pytest.mark.parametrize("name", [None, *LARGE])
def test_shares_sum_to_one_and_probabilities_are_those_of_the_ranking(name):
    found = diagnosis_of(name)
    parts = [*found.inclusion.causes.values(), found.inclusion.residual_discrepancy]
    # Without any gap there is nothing to share out.
    total = sum(p.share for p in parts)
    assert total == pytest.approx(1.0) or (name is None and total == 0.0)
    sums = inclusion_probability(found.ranking.probability)
    for cause in CHOICE:
        assert found.inclusion.causes[cause].probability == pytest.approx(sums[cause])
    if name is not None:
        assert found.inclusion.acting == [name]
        assert found.inclusion.causes[name].share > 0.5


def test_sets_do_not_depend_on_the_order_of_the_effects():
    from calib.gap.ranking import rank
    from tests.gap.cases import campaigns_of

    data = campaigns_of("sensor_drift", "pull")
    names = ["force_offset", "sensor_drift", "lug_thrust"]
    one, other = (
        rank(data, 3, effects={n: CHOICE[n] for n in order if n in CHOICE})
        for order in (names, names[::-1])
    )
    assert set(one.probability) == set(other.probability)
    for name, p in one.probability.items():
        assert other.probability[name] == pytest.approx(p, abs=0.02)
    assert np.isfinite(list(one.log_evidence.values())).any()


def pair_of(offset: float, drift: float):
    """An offset and a drift of known sizes, in ruts of which neither does anything."""
    data = campaigns_of(None)
    few = singles(data, {n: CHOICE[n] for n in ("force_offset", "sensor_drift")})
    found = fit_at(data, joined(*few))
    one, other = found.forward.phi_slices
    psi = found.psi.copy()
    psi[one], psi[other.start] = offset, drift
    for each in found.forward.form_slices.values():
        for part in each:
            psi[part] = 0.0
    return data, replace(found, psi=psi)


def test_the_size_of_a_cause_is_what_goes_with_it_over_all_field_rows():
    data, found = pair_of(0.06, 0.2)
    field = found.forward.field(found.psi[None], data.view)["drawbar_pull"][0]
    alone = found.psi.copy()
    alone[found.forward.phi_slices[0]] = 0.0
    only_drift = found.forward.field(alone[None], data.view)["drawbar_pull"][0]
    plain = found.forward.simulator(found.psi[None], data.view)["drawbar_pull"][0]
    sizes = _sizes(data, found, np.stack([found.psi, alone]))
    assert sizes.shape == (2, 2)
    n = 54  # of both outputs
    offset = np.sqrt(np.square((field - only_drift) / SIGMA["drawbar_pull"]).sum() / n)
    drift = np.sqrt(np.square((only_drift - plain) / SIGMA["drawbar_pull"]).sum() / n)
    np.testing.assert_allclose(sizes, [[offset, drift], [0.0, drift]], rtol=1e-6, atol=1e-9)
    assert offset == pytest.approx(2.0 * np.sqrt(0.5))
