"""Which causes act, whatever acts besides: sums over explanations, and shares that sum to one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import calib.gap.mixture as module
from calib.gap.diagnose import verdict
from calib.gap.hypotheses import Hypothesis, joined, singles
from calib.gap.mixture import (
    Included,
    Inclusion,
    Mixture,
    _mean_and_interval,
    _shares,
    _sizes,
    _where,
    inclusion,
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
    parts = [*found.inclusion.causes.values(), found.inclusion.remainder]
    # Without any gap there is nothing to share out.
    total = sum(p.share for p in parts)
    assert total == pytest.approx(1.0) or (name is None and total == 0.0)
    sums = inclusion_probability(found.ranking.probability)
    for cause in CHOICE:
        assert found.inclusion.causes[cause].probability == pytest.approx(sums[cause])
    if name is not None:
        assert found.inclusion.acting == [name]
        assert found.inclusion.causes[name].share > 0.5


def test_a_draw_weighs_what_its_explanation_does():
    """However many draws an explanation has, they weigh together what it is probable."""
    found = diagnosis_of("force_offset")
    names = ["force_offset", "lug_thrust", "sensor_drift"]
    fits = tuple(found.ranking.best(name) for name in names)
    mixed = replace(found.corrected.mixture, fits=fits, probability=(0.7, 0.25, 0.05))
    shares, weight = _shares(mixed, names)
    for i, probability in enumerate(mixed.probability):
        its = shares[:, i] == 1.0
        assert its.sum() >= 50
        assert weight[its].sum() == pytest.approx(probability)


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


def test_where_the_unlisted_lies_is_asked_of_the_explanations_that_have_it():
    """A listed cause beside it, however probable, has no say; without any there is nowhere."""
    found = diagnosis_of("lug_thrust")
    unknown, listed = (found.ranking.best(name) for name in ("unknown", "lug_thrust"))
    mixed = replace(found.corrected.mixture, fits=(unknown,), probability=(1.0,))
    alone = _where(found.data, mixed)
    assert alone
    both = replace(mixed, fits=(unknown, listed), probability=(0.3, 0.7))
    assert _where(found.data, both) == alone
    assert _where(found.data, replace(mixed, fits=(listed,))) == ()


def test_what_acts_is_at_least_as_probable_as_not_the_largest_share_first():
    causes = {
        name: Included(p, share, (0.0, 1.0))
        for name, p, share in (("a", 0.5, 0.2), ("b", 0.9, 0.7), ("c", 0.49, 0.9))
    }
    assert Inclusion(causes, Included(0.6, 0.1, (0.0, 1.0)), ()).acting == ["b", "a"]


def test_a_sum_of_probabilities_is_none_above_one():
    found = inclusion_probability({"a": 0.7, "a+b": 0.3 + 1e-15, "none": 0.2})
    assert found == {"a": 1.0, "b": 0.3 + 1e-15}


def test_a_mean_share_lies_within_its_interval():
    share, weight = np.array([0.9, 0.1, 0.5]), np.array([0.46, 0.04, 0.50])
    mean, interval = _mean_and_interval(share, weight)
    assert mean == pytest.approx(0.9 * 0.46 + 0.1 * 0.04 + 0.5 * 0.5)
    assert interval == pytest.approx((0.5, 0.9))
    mean, interval = _mean_and_interval(share, np.array([0.03, 0.96, 0.01]))
    assert mean == pytest.approx(0.03 * 0.9 + 0.96 * 0.1 + 0.005)
    assert interval == pytest.approx((0.1, mean))
    assert _mean_and_interval(np.zeros(0), np.zeros(0)) == (0.0, (0.0, 0.0))


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


def test_shares_are_of_sizes_that_are_each_wrong_by_some_part():
    data, found = pair_of(0.06, 0.2)
    still = replace(found, covariance=np.zeros_like(found.covariance))
    none = fit_at(data, Hypothesis("none"))
    mixed = Mixture(data, (none, still), (0.5, 0.5), 1)
    shares, weight = _shares(mixed, ["sensor_drift", "force_offset", "unknown"])
    # What has no cause has no shares; a mixture's half of 800 draws has.
    assert shares.shape == (400, 3)
    np.testing.assert_allclose(weight, 1.0 / 400)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    np.testing.assert_array_equal(shares[:, 2], 0.0)
    offset, drift = _sizes(data, still, still.psi[None])[0]
    ratio = np.log(shares[:, 0] / shares[:, 1])
    sd = np.sqrt(2.0) * 0.35
    assert ratio.mean() == pytest.approx(np.log(drift / offset), abs=4.0 * sd / 20.0)
    assert ratio.std() == pytest.approx(sd, rel=4.0 / np.sqrt(800.0))


def test_without_any_gap_nothing_is_shared_out():
    data, found = pair_of(0.0, 0.0)
    idle = replace(found, covariance=np.zeros_like(found.covariance))
    shares, weight = _shares(Mixture(data, (idle,), (1.0,), 1), ["force_offset", "sensor_drift"])
    assert shares.shape == (0, 2)
    assert weight.size == 0


@pytest.mark.parametrize(("unlisted", "there"), [(0.1, True), (0.099, False)])
def test_causes_come_by_probability_and_the_rest_lies_somewhere_from_a_tenth_on(
    unlisted, there, monkeypatch
):
    p = {"none": 0.6 - unlisted, "a": 0.1, "a+b": 0.05, "b": 0.25, "unknown": unlisted}
    asked = []

    def shares(mixed, names):
        asked.extend(names)
        return np.array([[0.5, 0.3, 0.2]]), np.ones(1)

    monkeypatch.setattr(module, "_shares", shares)
    monkeypatch.setattr(module, "_where", lambda data, mixed: ("there",))
    found = inclusion(SimpleNamespace(data=None), SimpleNamespace(probability=p))
    assert asked == list(found.causes) + ["unknown"] == ["b", "a", "unknown"]
    assert [c.probability for c in found.causes.values()] == pytest.approx([0.3, 0.15])
    assert [c.share for c in found.causes.values()] == [0.5, 0.3]
    assert found.remainder.share == 0.2
    assert found.remainder.probability == unlisted
    assert found.where == (("there",) if there else ())
    del p["unknown"]
    assert inclusion(SimpleNamespace(data=None), SimpleNamespace(probability=p)).where == ()


def test_where_the_rest_lies_is_asked_with_what_its_explanations_are_among_themselves(monkeypatch):
    class Stub:
        data = SimpleNamespace(view="view")

        def fit(self, *causes):
            return SimpleNamespace(forward=SimpleNamespace(causes=causes))

    with_it = [Stub().fit("a", "unknown"), Stub().fit("unknown")]
    fits = (with_it[0], Stub().fit("a"), with_it[1])
    mixed = Mixture(Stub.data, fits, (0.2, 0.7, 0.1), 1)
    asked = []

    def at(self, view, without=None, left_out=()):
        asked.append((self.fits, self.probability, view, without))
        return "truth"

    monkeypatch.setattr(Mixture, "at", at)
    monkeypatch.setattr(module, "row_gaps", lambda data, truth: f"gaps of {truth}")
    monkeypatch.setattr(module, "regions", lambda data, truth, gaps: (truth, gaps))
    assert _where(Stub.data, mixed) == ("truth", "gaps of truth")
    ((of, probability, view, without),) = asked
    assert of == tuple(with_it)
    assert probability == pytest.approx((2 / 3, 1 / 3))
    assert (view, without) == ("view", "unknown")
    assert _where(Stub.data, replace(mixed, fits=fits[1:2], probability=(1.0,))) == ()
