"""Where fits begin: worked out again, step by step, in plain linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.campaigns import campaigns
from calib.gap.case import Context
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Start
from calib.gap.forward import Forward
from calib.gap.gauss_newton import Residuals
from calib.gap.hypotheses import Hypothesis, joined, singles, unknowns
from calib.gap.noise import Noise
from calib.gap.odds import Odds
from calib.gap.search import Guesses, _led, _places
from tests.gap.cases import CHOICE, campaigns_of, make_case
from tests.gap.fits import SIGMA, fit_at


def guesses_for(data) -> Guesses:
    """Guesses about parameters that are somewhat off the middle of the priors."""
    rng = np.random.default_rng(5)
    mode = {
        o.name: np.array([p.loc + 0.1 * p.scale * rng.standard_normal() for p in o.priors.free])
        for o in data.outputs
    }
    noise = {o: Noise(1.1 * s, 1.0) for o, s in SIGMA.items()}
    return Guesses(data, mode, noise, Odds.of(len(CHOICE), Context()))


@pytest.fixture(scope="module")
def guesses() -> Guesses:
    return guesses_for(campaigns_of("force_offset"))


@pytest.fixture(scope="module")
def alone(guesses) -> dict[str, Hypothesis]:
    return {h.name: h for h in singles(guesses.data, CHOICE)}


def candidates_of(start: Start) -> tuple[Forward, np.ndarray]:
    return start.forward, start.guesses


def lab(guesses: Guesses, forward: Forward, psi: np.ndarray) -> None:
    """Assert that guesses have the simulators where the laboratory calibrated them."""
    for name, part in forward.theta_slices.items():
        expected = np.tile(guesses.lab_mode[name], (len(psi), 1))
        np.testing.assert_allclose(psi[:, part], expected, atol=1e-5)


def test_a_hypothesis_begins_at_the_laboratorys_calibration(guesses, alone):
    forward, found = candidates_of(guesses.begun(Hypothesis("none")))
    assert len(found) == 1
    lab(guesses, forward, found)
    for name in ("force_offset", "lug_thrust"):
        forward, found = candidates_of(guesses.begun(alone[name]))
        lab(guesses, forward, found)
        # The middle of the prior, and draws of it.
        part = forward.phi_slices[0]
        middle = np.array([p.loc for p in forward.priors.free])[part]
        np.testing.assert_allclose(found[0, part], middle, atol=1e-5)
        assert len(np.unique(found[:, part], axis=0)) == len(found) > 50


def test_a_set_begins_where_its_parts_have_led_with_what_they_lack_drawn(guesses, alone):
    both = joined(alone["force_offset"], alone["lug_thrust"])
    psi, members = {}, []
    for name, off in (("force_offset", 0.07), ("lug_thrust", 0.3)):
        found = fit_at(guesses.data, alone[name])
        at = found.psi.copy()
        at[: found.forward.n_shared] += 0.05 * off
        at[found.forward.phi_slices[0]] += off
        members.append(replace(found, psi=at))
        psi[name] = at
    forward, found = candidates_of(guesses.begun_jointly(both, members, 2))
    problem = Residuals(guesses.data, forward)
    first, second = np.split(found[1:], 2)
    places = dict(zip(("force_offset", "lug_thrust"), forward.phi_slices, strict=True))
    lab(guesses, forward, found[:1])
    for part, name, lacking in (
        (first, "force_offset", "lug_thrust"), (second, "lug_thrust", "force_offset"),
    ):  # fmt: skip
        led = psi[name][members[0 if name == "force_offset" else 1].forward.phi_slices[0]]
        np.testing.assert_allclose(part[:, places[name]], np.tile(led, (len(part), 1)), atol=1e-5)
        shared = problem.clip(np.tile(found[0], (len(part), 1)))
        shared[:, : forward.n_shared] = psi[name][: forward.n_shared]
        np.testing.assert_allclose(
            part[:, : forward.n_shared], problem.clip(shared)[:, : forward.n_shared], atol=1e-5
        )
        assert len(np.unique(part[:, places[lacking]], axis=0)) == len(part) > 20
    # What lacks nothing has one guess; without parts it begins as any hypothesis.
    whole = fit_at(guesses.data, both)
    _, found = candidates_of(guesses.begun_jointly(both, [whole, whole], 2))
    assert len(found) == 3
    _, found = candidates_of(guesses.begun_jointly(both, [], 2))
    _, as_any = candidates_of(guesses.begun(both))
    np.testing.assert_array_equal(found, as_any)


def test_a_promise_is_what_a_step_of_all_other_parameters_makes_of_the_best_guesses(guesses, alone):
    """They take up what they can: Gauss and Newton's step or part of it, at the fit's noise."""
    data, kept, added = guesses.data, alone["lug_thrust"], alone["force_offset"]
    found = fit_at(data, kept)
    psi = found.psi.copy()
    psi[found.forward.phi_slices[0]] += 0.2
    found = replace(found, psi=psi, log_evidence=12.0)
    (promise,) = guesses.beside(kept, found, [added])
    forward = Forward(data, kept, {o: n.sigma for o, n in guesses.noise.items()}, guesses.lab_mode)
    problem = Residuals(data, forward)
    led = psi.copy()
    sds = problem.sds(found.noise)
    h = 1e-5 * problem.width
    slope = np.stack([
        (problem.raw((led + e)[None]) - problem.raw((led - e)[None]))[0] / (2.0 * e.sum()) / sds
        for e in np.diag(h)
    ])  # fmt: skip
    hessian = slope @ slope.T + np.diag(problem.precision**2)
    larger, start = guesses._forward(joined(kept, added))
    there = Residuals(data, larger)
    place = [e.name for e in larger.hypothesis.effects].index("force_offset")
    begun = there.clip(guesses._spread(larger, _led(larger, start, found), 64, [place]))
    raw = there.raw(begun)
    gradient = raw / sds @ slope.T + (led - problem.loc) * problem.precision**2
    step = -np.linalg.solve(hessian, gradient.T).T
    costs = there.costs(begun, raw, sds) - 0.5 * np.einsum("kd,de,ke->k", step, hessian, step)
    own, here = _places(forward, larger)
    tried = []
    for i in there.best(costs, begun, 4):
        for part in (1.0, 0.3, 0.0):
            moved = begun[i].copy()
            moved[here] += part * step[i, own]
            tried.append((there.clip(moved[None])[0], i))
    at = np.stack([moved for moved, _ in tried])
    costs = there.costs(at, there.raw(at), sds)
    best = [tried[i] for i in np.argsort(costs)]
    assert promise.hypothesis == joined(kept, added)
    assert promise.noise == found.noise
    # As much better a density as the one that was fitted has, at a prior of one effect more.
    was = problem.costs(psi[None], problem.raw(psi[None]), sds)[0]
    odds = guesses.odds
    prior = odds.ln_prior(promise.hypothesis.name)
    assert promise.expected == pytest.approx(12.0 + was - costs.min() + prior, abs=0.05)
    # It begins at the best of them, and at the best that lies apart.
    width = there.width
    np.testing.assert_allclose(promise.starts[0] / width, best[0][0] / width, rtol=0.02, atol=2e-3)
    apart = (np.abs(promise.starts[0] - promise.starts[1]) / width).max()
    assert len(promise.starts) == 2
    assert apart > 0.7
    # A size keeps what was drawn.
    part = larger.phi_slices[place]
    assert all(begin[part] in begun[:, part] for begin in promise.starts)
    # A fit from it begins with all of them, the best first.
    _, candidates = candidates_of(promise.start)
    np.testing.assert_array_equal(candidates, promise.starts)


def test_what_is_kept_of_a_larger_set_is_guessed_at_by_itself(guesses, alone):
    names = ("force_offset", "lug_thrust", "rut_rebound")
    found = fit_at(guesses.data, joined(*(alone[n] for n in names)))
    kept = joined(alone["force_offset"], alone["lug_thrust"])
    promises = guesses.beside(kept, found, [alone["rate_effect"]])
    assert [p.hypothesis.name for p in promises] == [
        "force_offset+lug_thrust+rate_effect", "force_offset+lug_thrust",
    ]  # fmt: skip
    assert promises[1].starts.shape[1] == guesses._forward(kept)[0].n_dim
    # One effect alone is a hypothesis that was fitted already.
    pair = fit_at(guesses.data, kept)
    assert len(guesses.beside(alone["lug_thrust"], pair, [alone["rate_effect"]])) == 1
    assert guesses.beside(alone["lug_thrust"], pair, []) == []


class Nowhere(Effect):
    """Has no value at any size."""

    name = "nowhere"
    parameters = ("size",)
    outputs = ("pull",)
    priors = 'model = "nowhere"\n[parameters.size]\ndist = "half_normal"\nsd = 1.0\nunit = "1"\n'
    priors += 'reason = "A test\'s"\nsource = "None"\n'

    def on_output(self, phi, output, location, view):
        return np.full_like(location, np.nan)


def test_a_set_of_which_no_guess_has_a_density_promises_nothing(guesses, alone):
    kept = alone["lug_thrust"]
    (nowhere,) = singles(guesses.data, {"nowhere": Nowhere()})
    found = fit_at(guesses.data, kept)
    one, other = guesses.beside(kept, found, [nowhere, alone["force_offset"]])
    assert one.expected == -np.inf
    assert np.isfinite(other.expected)
    for better, worse in ((other, one), (one, other)):
        assert better.with_starts_of(worse).expected == other.expected


def test_what_sets_in_begins_where_the_laboratorys_residuals_show_it_best(guesses):
    """Of thresholds along the prior that of the least penalised squares, by least squares."""
    data = guesses.data
    for hypothesis in [h for h in unknowns(data) if h.onset_over in ("level", "slip", "order")]:
        forward, start = guesses._forward(hypothesis)
        found = guesses._onset_start(forward, start)
        free = forward.priors.free
        plain = forward.simulator(start[None], data.view)

        def solved(threshold, forward=forward, plain=plain, free=free):
            total, amplitudes = 0.0, {}
            for o in data.outputs:
                if o.name not in forward.smooth_slices:
                    continue
                part, sigma = forward.smooth_slices[o.name], guesses.noise[o.name].sigma
                shapes = forward.discrepancy.onset(data.view, o.name, np.array([threshold]))
                basis = np.stack([s[0] for s in shapes], axis=1)[o.rows] / sigma
                ridge = np.diag([1.0 / p.scale for p in free[part]])
                residual = (o.field - plain[o.name][0, o.rows]) / sigma
                stacked, target = (
                    np.vstack([basis, ridge]),
                    np.append(residual, np.zeros(len(shapes))),
                )
                best = np.linalg.lstsq(stacked, target)[0]
                total += np.square(target - stacked @ best).sum()
                amplitudes[o.name] = best
            return total, amplitudes

        prior = free[forward.threshold]
        grid = np.linspace(prior.lower, prior.upper, 24)
        best = grid[int(np.argmin([solved(t)[0] for t in grid]))]
        assert found[forward.threshold] == pytest.approx(best)
        for name, amplitude in solved(best)[1].items():
            np.testing.assert_allclose(
                found[forward.smooth_slices[name]], amplitude, rtol=1e-6, atol=1e-9
            )
        lab(guesses, forward, found[None])
        _, candidates = candidates_of(guesses.begun(hypothesis))
        np.testing.assert_array_equal(candidates[0], found)
        assert len(candidates) == 1


def test_an_effect_may_begin_at_what_is_left_of_the_readings():
    """A step begins with the mean residuals on both sides; rows without a reading say nothing."""
    case = make_case("force_offset")
    pull = np.array(case.field["drawbar_pull_kn"])
    pull[[1, 6]] = np.nan
    field = replace(case.field, columns={**case.field.columns, "drawbar_pull_kn": pull})
    guesses = guesses_for(campaigns(replace(case, field=field)))
    (step,) = singles(guesses.data, {"sensor_step": EFFECTS["sensor_step"]})
    forward, start = guesses._forward(step)
    left = guesses._left(forward, start)
    predicted = forward.field(start[None], guesses.data.view)
    expected = pull - predicted["drawbar_pull"][0]
    np.testing.assert_allclose(left["pull"], expected)
    rut = np.log(case.field["rut_depth_mm"]) - predicted["rut_depth"][0]
    np.testing.assert_allclose(left["sinkage"], rut)
    found = guesses._spread(forward, start, 40, [0])
    (priors,) = step.effect_priors
    part = forward.phi_slices[0]
    natural = priors.to_natural(found[:, part])
    begun = EFFECTS["sensor_step"].begun(natural, left, guesses.data.view)
    np.testing.assert_allclose(priors.to_internal(begun), found[:, part], rtol=1e-9, atol=1e-12)
    rest = np.ones(start.size, dtype=bool)
    rest[part] = False
    np.testing.assert_array_equal(found[:, rest], np.tile(start[rest], (40, 1)))


def test_guesses_are_the_same_each_time(guesses, alone):
    """What is found must not be a matter of luck: with random guesses some seeds missed a mode."""
    other = Guesses(guesses.data, guesses.lab_mode, guesses.noise, guesses.odds)
    for h in (*alone.values(), joined(alone["force_offset"], alone["lug_thrust"])):
        np.testing.assert_array_equal(guesses.begun(h).guesses, other.begun(h).guesses)
