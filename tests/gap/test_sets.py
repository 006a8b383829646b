"""Sets of causes: what is shared is kept, what promises most comes first, small parts are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS, physical_role
from calib.gap.case import Case, campaigns
from calib.gap.context import Context
from calib.gap.effects import EFFECTS
from calib.gap.forward import Forward
from calib.gap.guesses import Guesses, _led, _places
from calib.gap.hypotheses import joined, resized, shifts, singles, with_remainder
from calib.gap.inclusion import inclusion_probability
from calib.gap.odds import Odds, with_prior
from calib.gap.sets import _apart, _as_sized, _enlarged, _exchanged, far_out
from calib.gap.which import calibrate_lab, rank
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
    return Guesses(data, mode, noise, 1, Odds.of(len(CHOICE), Context()))


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
    problem, candidates = next(guesses.truncated_promise(promise))
    forward = problem.forward
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
    best = max(promises, key=lambda p: p.log_joint)
    assert best.hypothesis.name == "+".join(CAUSES)


def test_an_effect_that_does_not_act_is_exchanged_for_one_that_does(guesses, alone):
    wrong = fitted(guesses, alone["rate_effect"], alone["lug_thrust"])
    promises = _exchanged(guesses, [wrong], list(alone.values()))
    names = [p.hypothesis.name for p in sorted(promises, key=lambda p: -p.log_joint)]
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


def test_an_effect_that_holds_another_is_not_set_beside_it(guesses):
    """A step with the same error before and after it is an offset; the order does not matter."""
    names = ("sensor_step", "force_offset", "lug_thrust")
    step, offset, lugs = singles(guesses.data, {n: EFFECTS[n] for n in names})
    assert not _apart(step, offset)
    assert not _apart(offset, step)
    assert not _apart(joined(step, lugs), offset)
    assert _apart(step, lugs)
    assert _apart(offset, lugs)
