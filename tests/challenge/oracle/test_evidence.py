"""Evidence against closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from calib.challenge.build import (
    LARGEST_GAP,
    OWN_GAP,
    PAIR_FLOOR,
    PAIR_SPAN,
    PAIR_SPREAD,
    SINGLE_FLOOR,
    SMALLEST_GAP,
    scale_to,
)
from calib.challenge.effects import kind_of
from calib.challenge.oracle.causes import causes_of
from calib.challenge.oracle.climb import Coordinates, climb
from calib.challenge.oracle.finding import mixed
from calib.challenge.oracle.pairs import place_shares
from calib.challenge.oracle.proposal import Proposal, log_prior
from calib.challenge.stage import Stage, rms
from tests.challenge.oracle.stages import search, stage_with

PULL, WHEEL = ("drawbar_pull",), ("drawbar_pull", "rut_depth")


def unit(values: np.ndarray) -> np.ndarray:
    """Return values over their rms."""
    return values / rms(values)


def offset_shape(stage: Stage) -> np.ndarray:
    """Return what a force offset adds, in noise sd, over its rms."""
    return unit(1.0 / stage.field_sd["drawbar_pull"])


def test_an_offset_has_its_closed_form() -> None:
    """A constant of either sign, evenly drawn in the logarithm: one integral by quadrature."""
    stage = stage_with(PULL)
    shape = offset_shape(stage)
    rng = np.random.default_rng(5)
    low, high = np.log(SINGLE_FLOOR), np.log(LARGEST_GAP)
    for size in (0.0, 1.5, -2.6, 4.0):
        residual = size * shape + rng.standard_normal(shape.size)
        along, own = float(residual @ shape), float(shape @ shape)

        def likelihood(log_size: float, sign: float, a: float = along, b: float = own) -> float:
            return float(np.exp(sign * np.exp(log_size) * a - 0.5 * np.exp(2.0 * log_size) * b))

        want = sum(
            0.5 * quad(likelihood, low, high, args=(s,), epsrel=1e-9)[0] / (high - low)
            for s in (-1.0, 1.0)
        )
        prior = {"none": 0.5, "force_offset": 0.5}
        found = search(stage, residual, prior).findings()["force_offset"]
        # Far from every gap the sum over sizes is coarser at its edge, where nothing hangs on it.
        close = 0.05 if np.log(want) > -20.0 else 0.3
        assert found.log_evidence == pytest.approx(np.log(want), abs=close)
        assert found.known_soil == pytest.approx(found.log_evidence)
        assert found.kept == pytest.approx(1.0)


def drift_shapes(stage: Stage, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return what random drifts of the load cell add, in noise sd, over their rms."""
    time, sd = stage.field.elapsed(), stage.field_sd["drawbar_pull"]
    shapes = []
    for _ in range(count):
        variant = rng.integers(3)
        if variant == 0:
            shape = time
        elif variant == 1:
            shape = 1.0 - np.exp(-time / rng.uniform(0.15, 0.5))
        else:
            shape = np.clip((time - rng.uniform(0.1, 0.5)) / rng.uniform(0.3, 0.9), 0.0, 1.0)
        shapes.append(unit(shape / sd) * rng.choice([-1.0, 1.0]))
    return np.array(shapes)


def test_a_drift_agrees_with_brute_force() -> None:
    """Dials are averaged over: 40,000 draws of the drift, each with its strengths."""
    stage, rng = stage_with(PULL), np.random.default_rng(6)
    shapes = drift_shapes(stage, rng, 40_000)
    residual = 2.4 * shapes[0] + rng.standard_normal(shapes.shape[1])
    sizes = np.exp(np.linspace(np.log(SINGLE_FLOOR), np.log(LARGEST_GAP), 81))
    ratio = np.outer(shapes @ residual, sizes) - 0.5 * shapes.shape[1] * sizes**2
    top = ratio.max()
    want = top + np.log(np.mean(np.exp(ratio - top)))
    prior = {"none": 0.5, "sensor_drift": 0.5}
    for seed in (0, 1):
        found = search(stage, residual, prior, seed).findings()["sensor_drift"]
        assert found.log_evidence == pytest.approx(want, abs=0.15)
        assert found.error < 0.2


def test_two_effects_agree_with_brute_force() -> None:
    """Offset and drift, drawn as the generator draws pairs, with its rules of fairness."""
    stage, rng = stage_with(PULL), np.random.default_rng(7)
    n = 400_000
    offset, drifts = offset_shape(stage), drift_shapes(stage, rng, 4000)
    which = rng.integers(len(drifts), size=n)
    place = rng.uniform(size=n)
    other = np.clip(place + rng.uniform(-PAIR_SPREAD, PAIR_SPREAD, n), 0.0, 1.0)
    low, span = np.log(PAIR_FLOOR), PAIR_SPAN * np.log(LARGEST_GAP / PAIR_FLOOR)
    first = np.exp(low + span * place) * rng.choice([-1.0, 1.0], n)
    second = np.exp(low + span * other)
    residual = 2.0 * offset - 1.8 * drifts[0] + rng.standard_normal(offset.size)
    along, cross = drifts @ residual, drifts @ offset / offset.size
    both = first**2 + second**2 + 2.0 * first * second * cross[which]
    ratio = first * (offset @ residual) + second * along[which] - 0.5 * offset.size * both
    kept = (both >= SMALLEST_GAP**2) & (np.minimum(np.abs(first), second) >= OWN_GAP)
    want = ratio.max() + np.log(np.mean(kept * np.exp(ratio - ratio.max())))
    name = "force_offset+sensor_drift"
    prior = {"none": 0.4, "force_offset": 0.2, "sensor_drift": 0.2, name: 0.2}
    found = search(stage, residual, prior).findings()[name]
    assert found.log_evidence == pytest.approx(want, abs=0.25)
    assert found.kept == pytest.approx(kept.mean(), abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rate_effect", "rut_rebound"])
def test_an_effect_agrees_with_the_generators_own_draws(name: str) -> None:
    """The mean likelihood over 2000 draws by `scale_to`, as the generator makes cases."""
    stage, rng = stage_with(WHEEL), np.random.default_rng(8)

    def draw() -> np.ndarray | None:
        family = kind_of(name).draw(rng)
        sign = float(rng.choice(np.array(family.signs)))
        made = scale_to(
            stage,
            lambda s: stage.reality.with_mechanisms(family.at(sign * s)),
            (family.low, family.high),
            SINGLE_FLOOR,
            LARGEST_GAP,
            float(rng.uniform()),
        )
        return None if made is None else stage.gap(stage.in_field(made))

    gaps = [draw() for _ in range(2000)]
    able = np.array([gap for gap in gaps if gap is not None])
    small = able[np.argsort([rms(gap) for gap in able])[len(able) // 10]]
    # Blurred, so that brute force meets the field often enough.
    residual, blur = small + 2.0 * rng.standard_normal(small.size), 0.5
    ratio = blur**2 * (able @ residual - 0.5 * np.sum(able**2, axis=1))
    want = ratio.max() + np.log(np.sum(np.exp(ratio - ratio.max())) / len(gaps))
    spread = np.exp(ratio - ratio.max())
    error = np.sqrt(np.sum(spread**2)) / np.sum(spread)
    view = search(stage, residual, {"none": 0.5, name: 0.5})
    blurred = type(view._view)(blur * residual, blur * np.eye(residual.size))
    view._view = view._known = blurred
    found = view.findings()[name]
    assert error < 0.3
    assert found.log_evidence == pytest.approx(want, abs=3.0 * error + 0.1)


def test_places_of_a_pair_are_drawn_as_the_generator_draws_them() -> None:
    """Shares of a grid of places against a million draws."""
    rng, n = np.random.default_rng(9), 1_000_000
    place = rng.uniform(size=n)
    other = np.clip(place + rng.uniform(-PAIR_SPREAD, PAIR_SPREAD, n), 0.0, 1.0 - 1e-12)
    drawn, _, _ = np.histogram2d(place, other, bins=12, range=[[0, 1], [0, 1]])
    shares = place_shares(48).reshape(12, 4, 12, 4).sum(axis=(1, 3))
    assert shares.sum() == pytest.approx(1.0)
    assert drawn / n == pytest.approx(shares, abs=1.5e-3)


def test_climbing_finds_the_top_of_a_linear_fit() -> None:
    """A ridge regression has its closed form; bounds hold it where it lies outside."""
    rng = np.random.default_rng(10)
    matrix, residual = rng.standard_normal((2, 30)), rng.standard_normal(30)
    coordinates = Coordinates.of_dials(np.array([True])).and_strength(-50.0, 50.0)
    want = np.linalg.solve(matrix @ matrix.T + np.diag([1.0, 0.0]), matrix @ residual)
    (peak, *_) = climb(lambda at: at @ matrix, residual, coordinates, np.zeros((2, 2)))
    assert peak.at == pytest.approx(want, abs=1e-3)
    kept = 0.5 * residual @ residual - 0.5 * np.sum((residual - want @ matrix) ** 2)
    assert peak.value == pytest.approx(kept - 0.5 * want[0] ** 2, abs=1e-4)
    narrow = Coordinates.of_dials(np.array([True])).and_strength(want[1] + 1.0, want[1] + 2.0)
    (held, *_) = climb(lambda at: at @ matrix, residual, narrow, np.zeros((1, 2)))
    assert held.at[1] == pytest.approx(want[1] + 1.0)


def test_a_proposal_is_a_density() -> None:
    """Its draws weighted by the prior over its density average to one."""
    rng = np.random.default_rng(11)
    proposal = Proposal(
        np.array([0.7, 0.3]), np.array([[0.0], [1.0]]), np.array([[[1.2]], [[2.0]]])
    )
    at = proposal.draw(40_000, rng)
    weight = np.exp(log_prior(at, np.array([True])) - proposal.log_density(at))
    assert weight.mean() == pytest.approx(1.0, abs=0.02)
    assert np.mean(weight * at[:, 0] ** 2) == pytest.approx(1.0, abs=0.03)


def test_evidence_of_a_mixture() -> None:
    """Shares weigh the parts, errors add in squares."""
    log, error = mixed([(0.25, np.log(2.0), 0.1), (0.75, np.log(4.0), 0.2)])
    assert np.exp(log) == pytest.approx(3.5)
    assert error == pytest.approx(np.hypot(0.5 * 0.1, 3.0 * 0.2) / 3.5)


def test_causes_of_pairs_exclude_nothing_by_mistake() -> None:
    """A state that cannot act on a stage has no finding, one that can has."""
    stage = stage_with(PULL)
    residual = np.zeros(stage.field.size)
    found = search(stage, residual, {"none": 0.9, "rut_rebound": 0.05, "force_offset": 0.05})
    assert set(found.findings()) == {"none", "force_offset"}
    assert causes_of("rut_rebound")
