"""Sets of causes: what is shared is kept, what promises most comes first, small parts are found."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import partial
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import calib.gap.search as module
from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS, physical_role
from calib.gap.campaigns import campaigns
from calib.gap.case import Case, Context
from calib.gap.effects import EFFECTS
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, joined, resized, shifts, singles, wider, with_remainder
from calib.gap.mixture import inclusion_probability
from calib.gap.odds import Odds, with_prior
from calib.gap.ranking import calibrate_lab, rank
from calib.gap.search import (
    Guesses,
    Promise,
    _as_sized,
    _as_usual,
    _begun_again,
    _best_of_each,
    _enlarged,
    _exchanged,
    _expected,
    _finished,
    _fitted,
    _leading,
    _led,
    _pairs,
    _places,
    _promise,
    _stepwise,
    far_out,
)
from calib.inference.priors import Priors
from tests.gap.cases import CHOICE, LARGE, make_case, parameters

CAUSES = ("rate_effect", "rut_rebound", "sensor_drift")


def mixed_case() -> Case:
    """Return a campaign in which three effects act, one on both outputs."""
    case = make_case("rate_effect")
    view = campaigns(case).view
    columns = dict(case.field.columns)
    for name in ("rut_rebound", "sensor_drift"):
        for output in case.models:
            if physical_role(output) in EFFECTS[name].outputs:
                column = OUTPUTS[output]
                phi = parameters(name, LARGE[name])
                log = output == "rut_depth"
                reading = np.log(columns[column]) if log else columns[column]
                read = EFFECTS[name].on_output(phi, physical_role(output), reading[None], view)[0]
                columns[column] = np.exp(read) if log else read
    return replace(case, name="mixed", field=table_from_arrays(columns))


@pytest.fixture(scope="module")
def guesses() -> Guesses:
    return guesses_of(mixed_case())


def guesses_of(case: Case) -> Guesses:
    data = campaigns(case)
    mode, noise = calibrate_lab(data, 1)
    return Guesses(data, mode, noise, Odds.of(len(CHOICE), Context()))


@pytest.fixture(scope="module")
def alone(guesses):
    return {h.name: h for h in singles(guesses.data, CHOICE)}


def fitted(guesses, *causes):
    (found,) = guesses.fit([joined(*causes)]).values()
    return found[0]


def test_what_two_sets_share_begins_where_it_was_led(guesses, alone):
    pair = fitted(guesses, alone["rate_effect"], alone["sensor_drift"])
    (promise,) = guesses.beside(pair.forward.hypothesis, pair, [alone["force_offset"]])
    assert promise.hypothesis.name == "force_offset+rate_effect+sensor_drift"
    forward, candidates = promise.start.forward, promise.start.guesses
    # With the new effect at rest and the others where they were, it predicts what the pair did.
    led = _led(forward, candidates[0], pair)
    led[forward.phi_slices[0]] = 0.0
    was = pair.forward.field(pair.psi[None], guesses.data.view)
    now = forward.field(led[None], guesses.data.view)
    for name in guesses.data.names:
        np.testing.assert_allclose(now[name], was[name], rtol=1e-9)


def test_of_one_effect_more_that_which_acts_promises_most(guesses, alone):
    pair = fitted(guesses, alone["rate_effect"], alone["sensor_drift"])
    promises = _enlarged(guesses, [pair], list(alone.values()))
    assert len(promises) == len(alone) - 2
    best = max(promises, key=lambda p: p.expected)
    assert best.hypothesis.name == "+".join(CAUSES)


def test_an_effect_that_does_not_act_is_exchanged_for_one_that_does(guesses, alone):
    wrong = fitted(guesses, alone["rate_effect"], alone["lug_thrust"])
    promises = _exchanged(guesses, [wrong], list(alone.values()))
    names = [p.hypothesis.name for p in sorted(promises, key=lambda p: -p.expected)]
    assert set(names[0].split("+")) <= set(CAUSES)
    assert "lug_thrust+rate_effect" not in names


def test_a_set_has_usual_priors_where_its_effects_are_not_large(guesses, alone):
    # Alone each may have had to be large, to make up for the other.
    usual = {h.name: h.effect_priors[0] for h in alone.values()}
    pair = joined(alone["rate_effect"], alone["force_offset"])
    (wide,) = guesses.fit([resized(pair, usual, ["force_offset", "rate_effect"])]).values()
    assert not any(far_out(wide[0], i, p) for i, p in enumerate(pair.effect_priors))
    found = _as_sized(guesses, usual, wide, with_prior(wide[0], guesses.odds))
    assert [f.forward.hypothesis for f in found] == [wide[0].forward.hypothesis, pair]
    # The data are no worse met, with priors that spread the same mass less widely.
    assert with_prior(found[1], guesses.odds) > with_prior(wide[0], guesses.odds) + np.log(100.0)


def test_of_an_effect_that_is_large_in_a_set_both_priors_count_as_they_should(alone):
    guesses = guesses_of(make_case("force_offset"))
    usual = {h.name: h.effect_priors[0] for h in alone.values()}
    (entry,) = usual["force_offset"].free
    narrow = Priors((replace(entry, scale=0.04),))  # the offset is three sds of it
    usual["force_offset"] = narrow
    single = replace(alone["force_offset"], effect_priors=(narrow,))
    (pair,) = guesses.fit([joined(single, alone["rate_effect"])]).values()
    assert far_out(pair[0], 0, narrow)
    found = _as_sized(guesses, usual, pair, with_prior(pair[0], guesses.odds))
    assert [f.forward.hypothesis.share for f in found] == pytest.approx([1.0, 0.1])
    # What the usual prior's evidence is of the wider one's: the mean, over the posterior with the
    # wider one, of the ratio of the priors.
    offset = found[1].forward.phi_slices[0].start
    middle, sd = found[1].psi[offset], np.sqrt(found[1].covariance[offset, offset])
    x = middle + sd * np.linspace(-8.0, 8.0, 4001)
    ratio = np.exp(norm.logpdf(x, scale=0.04) - norm.logpdf(x, scale=0.16))
    expected = np.average(ratio, weights=norm.pdf(x, middle, sd))
    gained = found[1].log_evidence - found[0].log_evidence
    assert gained == pytest.approx(-np.log(expected), abs=0.1)


def test_three_causes_are_found_whatever_comes_first_alone():
    ranking = rank(campaigns(mixed_case()), 1, effects=CHOICE)
    found = inclusion_probability(ranking.probability)
    assert [name for name in sorted(found) if found[name] >= 0.5] == list(CAUSES)
    # A set once, whatever it was made of: a second fit would count its evidence twice.
    assert len(ranking.fits["+".join(CAUSES)]) == 1


def test_a_shift_with_something_besides_begins_where_it_was_led_by_itself(guesses):
    """And with something besides, a listed effect; of neither the other's is taken over."""
    data = guesses.data
    (offset,) = singles(data, {"force_offset": EFFECTS["force_offset"]})

    def names(hypothesis):
        forward = Forward(data, hypothesis, {"drawbar_pull": 0.03, "rut_depth": 0.05})
        return forward, [p.name for p in forward.priors.free]

    for alone in (shifts(data)[0], offset):
        old, known = names(alone)
        new, all_of_them = names(with_remainder(data, alone)[0])
        theirs, ours = _places(old, new)
        assert theirs.tolist() == list(range(old.n_dim))
        assert [all_of_them[i] for i in ours] == known
        assert len(set(ours.tolist())) == old.n_dim < new.n_dim
    other, _ = names(shifts(data)[0])
    theirs, ours = _places(old, other)
    assert theirs.tolist() == ours.tolist() == list(range(old.n_shared))


EVEN = Odds(1, {})


def fit_of(hypothesis, score: float):
    """A fit of which evidence times prior has this logarithm."""
    prior = EVEN.ln_prior(hypothesis.name) + np.log(hypothesis.share)
    parts = [slice(0, 0)] * len(hypothesis.effects)
    return SimpleNamespace(
        forward=SimpleNamespace(hypothesis=hypothesis, phi_slices=parts), psi=np.empty(0),
        log_evidence=score - float(prior),
    )  # fmt: skip


def named(name: str, **options) -> Hypothesis:
    effects = tuple(SimpleNamespace(name=n) for n in name.split("+"))
    return Hypothesis(name, effects, (None,) * len(effects), **options)


# Of effects that have no other priors.
USUAL = defaultdict(lambda: None)
PROMISE = partial(_promise, USUAL, EVEN)


@pytest.mark.parametrize("sds", [0.0, 0.5, 1.7, 5.0])
@pytest.mark.parametrize("name", ["force_offset", "post_peak_softening"])
def test_a_set_promises_what_it_has_by_the_priors_that_suit_it(guesses, name, sds):
    """One in ten effects is several times as large: its wide prior costs density as well."""
    (single,) = singles(guesses.data, {name: EFFECTS[name]})
    (other,) = singles(guesses.data, {"lug_thrust": EFFECTS["lug_thrust"]})
    usual = {h.name: h.effect_priors[0] for h in (single, other)}
    forward, start = guesses._forward(joined(wider(single), other))
    part = forward.phi_slices[[e.name for e in forward.hypothesis.effects].index(name)]
    free = usual[name].free
    psi = start.copy()
    psi[part] = [p.loc + sds * p.scale for p in free]
    widths = [np.log(2.0 if p.log else 4.0) for p in free]
    less = [0.5 * sds**2 * (1.0 - np.exp(-2.0 * w)) for w in widths]
    gained = max(sum(widths) - sum(less) + np.log(10.0), 0.0)
    assert (gained == 0.0) == (sds == 5.0)
    assert _as_usual(usual, forward, psi) == pytest.approx(gained, abs=1e-6)
    found = SimpleNamespace(forward=forward, psi=psi, log_evidence=3.0)
    assert _promise(usual, EVEN, [found]) == pytest.approx(with_prior(found, EVEN) + gained)
    promise = Promise(forward, 2.0, np.stack([psi, start]), {})
    assert _expected(usual, promise) == pytest.approx(2.0 + gained)
    alone, begun = guesses._forward(single)
    assert _as_usual(usual, alone, begun) == 0.0


@pytest.mark.parametrize(("off", "far"), [(1.99, False), (2.01, True)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_an_effect_is_far_out_from_two_sds_of_its_prior_on(off, far, sign):
    entries = [SimpleNamespace(loc=-3.0, scale=0.5), SimpleNamespace(loc=1.0, scale=0.2)]
    forward = SimpleNamespace(phi_slices=[slice(0, 1), slice(1, 3)])
    psi = np.array([99.0, -3.0, 1.0 + sign * off * 0.2])
    found = SimpleNamespace(psi=psi, forward=forward)
    assert far_out(found, 1, SimpleNamespace(free=entries)) is far


def test_the_best_fit_of_each_hypothesis_counts():
    a, b = Hypothesis("a"), Hypothesis("b")
    fits = [fit_of(a, 1.0), fit_of(b, 2.0), fit_of(a, 3.0), fit_of(replace(a, share=0.5), -9.0)]
    assert _best_of_each(fits) == [fits[2], fits[1], fits[3]]


def forward_of(hypothesis):
    return fit_of(hypothesis, 0.0).forward


def test_pairs_hold_one_of_the_four_best_and_are_guessed_at_from_each_that_is():
    names = [f"e{i}" for i in range(9)]
    best = {n: fit_of(named(n), 10.0 - i) for i, n in enumerate(names)}
    for n in names:
        best[n].forward.hypothesis = replace(named(n), effect_priors=(None,))
    mixed = [names[i] for i in (4, 8, 0, 6, 2, 7, 1, 3, 5)]

    class Guessed(Stub):
        def beside(self, kept, found, added, size):
            """Guesses are told by the place of the effect that they were made from."""
            assert found is best[kept.name]
            place = float(names.index(kept.name))
            starts = np.array([[place, 0.0], [place, 1.0]])
            assert size == 32
            return [Promise(forward_of(joined(kept, h)), place, starts, {}) for h in added]

    found = _pairs(Guessed(), USUAL, mixed, best, -1.0)
    expected = {"+".join(p) for p in combinations(names, 2) if set(p) & set(names[:4])}
    assert sorted(p.hypothesis.name for p in found) == sorted(expected)
    for p in found:
        # The best guess from either first, that of the side that promises more before the other's.
        sides = sorted({int(n[1]) for n in p.hypothesis.name.split("+")} & set(range(4)))[::-1]
        first, others = p.parted()
        assert first.starts.tolist() == [[float(side), 0.0] for side in sides]
        assert others.starts.tolist() == [[float(side), 1.0] for side in sides]
        assert p.expected == sides[0]
    # Those that promise too little are left out.
    less = _pairs(Guessed(), USUAL, mixed, best, 1.5)
    assert {p.hypothesis.name for p in less} == {
        p.hypothesis.name for p in found if p.expected > 1.5
    }


def test_the_best_fit_of_each_of_the_best_sets_leads():
    fits = [fit_of(named(n), s) for n, s in (("a", 1.0), ("b", 5.0), ("a", 4.0), ("c", 2.0),
            ("d", 3.0), ("e", 0.0))]  # fmt: skip
    assert _leading(fits, -9.0, EVEN, 3) == [fits[1], fits[2], fits[4]]
    assert _leading(fits, 3.5, EVEN, 3) == [fits[1], fits[2]]
    assert _leading(fits, 5.5, EVEN, 3) == []


class Stub:
    """Guesses that nothing is asked of but their odds."""

    def __init__(self, odds=EVEN) -> None:
        self.odds = odds


class Promised:
    """A promise whose start is noted when it is begun from, as one fit."""

    def __init__(self, name: str, expected: float, asked: list[str]) -> None:
        self.hypothesis, self.expected, self.asked = named(name), expected, asked
        self.forward, self.starts = forward_of(self.hypothesis), np.empty((1, 0))

    @property
    def start(self):
        self.asked.append(self.hypothesis.name)
        return [fit_of(self.hypothesis, self.expected)]


@pytest.fixture
def at_once(monkeypatch):
    """Starts that are their truncated fits; finishing gains a tenth."""
    monkeypatch.setattr(module, "truncated_fits", list)

    def finished(begun):
        best = [max(group, key=lambda f: f.log_evidence) for group in begun]
        return [SimpleNamespace(**{**vars(f), "log_evidence": f.log_evidence + 0.1}) for f in best]

    monkeypatch.setattr(module, "finished", finished)


def test_what_is_hopeless_is_not_fitted_further(at_once):
    a, b = named("a"), named("b")
    begun = [[fit_of(a, 1.0), fit_of(a, 2.0)], [fit_of(b, 0.5), fit_of(b, 0.4)]]
    found = _finished(PROMISE, begun, 0.6)
    assert [with_prior(f, EVEN) for f in found] == pytest.approx([2.1, 0.5])
    assert found[1] is begun[1][0]


def test_pairs_in_play_are_begun_again_from_the_guesses_after_the_first(at_once):
    """Those within eight nats of the best."""
    asked: list[str] = []

    def pair(name: str, others: int):
        left = Promised(name, 0.5, asked)
        left.starts = np.zeros((others, 1))
        return SimpleNamespace(hypothesis=named(name), parted=lambda: (None, left))

    # Of the last all guesses are begun from already.
    pairs = [pair("a+b", 1), pair("a+c", 1), pair("b+c", 1), pair("c+d", 0)]
    begun = [[fit_of(p.hypothesis, s)] for p, s in zip(pairs, (2.1, 1.9, 9.0, 9.0), strict=True)]
    found = _begun_again(PROMISE, pairs, begun, 10.0)
    assert asked == ["a+b", "b+c"]
    assert [len(f) for f in found] == [2, 1, 2, 1]
    assert [len(f) for f in begun] == [1, 1, 1, 1]
    assert [f[0] for f in found] == [f[0] for f in begun]


def test_the_sets_that_promise_most_are_fitted_once_each(at_once):
    asked: list[str] = []
    promises = [
        Promised(f"s{i}+t", j, asked)
        for i, j in ((1, 5.0), (2, 6.0), (1, 7.0), *((i, 7.0 - i / 2) for i in range(3, 40)))
    ]
    found = _fitted(USUAL, EVEN, promises, {}, 2.0)
    assert asked == [f"s{i}+t" for i in range(1, 25)]
    # Within six and a half nats of the best that is listed they are fitted fully.
    assert [with_prior(f, EVEN) for f in found] == pytest.approx(
        [7.1, 6.1, *(7.1 - i / 2 for i in range(3, 23)), -4.5, -5.0]
    )
    # One that is expected sixty nats behind is not fitted at all.
    assert len(_fitted(USUAL, EVEN, promises, {}, 62.0)) == 9


def test_a_set_is_fitted_again_where_it_promises_about_what_it_has_reached(at_once):
    """A mode that was found from one set may be worse than that found from another."""
    asked: list[str] = []
    promises = [Promised(n, 5.0, asked) for n in ("a+b", "a+c", "a+d", "b+c")]
    promises.append(Promised("b+d", -5.5, asked))
    reached = {"a+b": 4.0, "a+c": 7.9, "a+d": 8.1, "b+d": -9.0}
    before = dict(reached)
    _fitted(USUAL, EVEN, promises, reached, 5.0)
    # A set that is new, and those that are no more than three nats above; none out of play.
    assert asked[0] == "b+c"
    assert sorted(asked[1:]) == ["a+b", "a+c"]
    assert reached == before


def test_every_other_effect_takes_ones_place_or_is_added():
    class Noted(Stub):
        def beside(self, kept, found, added):
            return [(kept.name, found, h.name) for h in added]

    alone = [replace(named(n), effect_priors=(None,)) for n in ("a", "b", "c", "d")]
    found = fit_of(joined(*alone[:2]), 0.0)
    assert _exchanged(Noted(), [found], alone) == [
        ("b", found, "c"), ("b", found, "d"), ("a", found, "c"), ("a", found, "d"),
    ]  # fmt: skip
    assert _enlarged(Noted(), [found], alone) == [("a+b", found, "c"), ("a+b", found, "d")]
    assert _enlarged(Noted(), [fit_of(joined(*alone), 0.0)], alone) == []


def test_sets_grow_step_by_step_up_to_four_causes_as_long_as_they_are_in_play(monkeypatch):
    """Each effect more gains a nat; nothing is gained by exchange."""
    tried = []

    def enlarged(guesses, grown, alone):
        names = [f.forward.hypothesis.name for f in grown]
        tried.append(names)
        return [f"{n}+{chr(ord(n[-1]) + 1)}" for n in names if n.count("+") < 3]

    monkeypatch.setattr(module, "_exchanged", lambda *a: [])
    monkeypatch.setattr(module, "_enlarged", enlarged)
    monkeypatch.setattr(
        module, "_fitted",
        lambda usual, odds, promises, reached, listed: [
            fit_of(named(n), float(n.count("+"))) for n in promises
        ],
    )  # fmt: skip
    monkeypatch.setattr(module, "_as_sized", lambda guesses, usual, fits, leading: list(fits))
    pairs = [fit_of(named("a+b"), 1.0), fit_of(named("k+l"), -4.5)]
    made = _stepwise(Stub(), [fit_of(named("a"), 0.0)], USUAL, pairs, 1.0)
    assert [f.forward.hypothesis.name for f in made] == ["a+b+c", "a+b+c+d"]
    assert tried == [["a+b"], ["a+b+c"], ["a+b+c+d"]]
    # Five nats behind the best listed no pair is in play.
    tried.clear()
    assert _stepwise(Stub(), [], USUAL, pairs, 6.5) == []
    assert tried == []


def test_whatever_is_among_the_best_of_its_size_is_changed_once(monkeypatch):
    """What an exchange finds as well; the third of a size, or what is out of play, never."""
    scores = {"a+b": 1.0, "a+c": 0.9, "a+d": 0.8, "a+b+c": 3.0, "b+c": 3.5, "b+c+d": 4.0, "k+l": -9}
    moves = {"a+b": ["a+b+c"], "a+b+c": ["b+c"], "b+c": ["b+c+d"], "a+d": ["nothing"]}
    changed = []

    def exchanged(guesses, best, alone):
        names = [f.forward.hypothesis.name for f in best]
        changed.extend(names)
        return [made for n in names for made in moves.get(n, [])]

    monkeypatch.setattr(module, "_enlarged", lambda *a: [])
    monkeypatch.setattr(module, "_exchanged", exchanged)
    monkeypatch.setattr(
        module, "_fitted", lambda usual, odds, made, *a: [fit_of(named(n), scores[n]) for n in made]
    )
    monkeypatch.setattr(module, "_as_sized", lambda guesses, usual, fits, leading: list(fits))
    pairs = [fit_of(named(n), scores[n]) for n in ("a+d", "a+b", "k+l", "a+c")]
    made = _stepwise(Stub(), [], USUAL, pairs, 1.0)
    assert [f.forward.hypothesis.name for f in made] == ["a+b+c", "b+c", "b+c+d"]
    assert changed == ["a+b", "a+c", "a+b+c", "b+c", "b+c+d"]


def test_what_was_changed_is_changed_again_where_it_was_found_to_be_better(monkeypatch):
    """By more than a nat: a better mode of a set is one for the sets that are made of it."""
    scores = iter([2.0, 4.0, 4.5, 0.0])
    changed = []

    def exchanged(guesses, best, alone):
        changed.extend(f.forward.hypothesis.name for f in best)
        return ["a+b"]

    monkeypatch.setattr(module, "_enlarged", lambda *a: [])
    monkeypatch.setattr(module, "_exchanged", exchanged)
    reached_by_then = []

    def fitted(usual, odds, made, reached, listed):
        reached_by_then.append(dict(reached))
        return [fit_of(named(n), next(scores)) for n in made]

    monkeypatch.setattr(module, "_fitted", fitted)
    monkeypatch.setattr(module, "_as_sized", lambda guesses, usual, fits, leading: list(fits))
    _stepwise(Stub(), [], USUAL, [fit_of(named("a+b"), 1.0)], 1.0)
    # From 1 to 2 is no more than a nat, and nothing is left to be changed.
    assert changed == ["a+b"]
    assert reached_by_then == [{"a+b": 1.0}]
    scores = iter([2.5, 4.0, 4.5, 0.0])
    changed.clear()
    reached_by_then.clear()
    _stepwise(Stub(), [], USUAL, [fit_of(named("a+b"), 1.0)], 1.0)
    assert changed == ["a+b", "a+b", "a+b"]
    assert reached_by_then == [{"a+b": 1.0}, {"a+b": 2.5}, {"a+b": 4.0}]
