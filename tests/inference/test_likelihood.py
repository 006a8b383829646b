"""Sums of squares against the plain sum over rows, and what they must not depend on."""

from __future__ import annotations

import pickle
import tracemalloc

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import calib.inference.likelihood as module
from calib.inference.likelihood import Squares
from calib.models import MODELS, BoundModel
from tests.models.ranges import draw

SEEDS = st.integers(0, 2**32 - 1)
LENGTHS = (2, 40, 256, 257, 3000)


def data(name: str, seed: int, n: int, *, levels: int | None = None):
    """A bound model, vectors, and n rows with conditions all distinct or of some levels each."""
    bound, theta, conditions = draw(seed, name, k=7, n=n)
    rng = np.random.default_rng(seed)
    if levels is not None:
        conditions = {c: rng.choice(v[:levels], n) for c, v in conditions.items()}
    location = bound.mean_response(theta[:1], conditions)[0]
    return bound, theta, conditions, location + 0.1 * rng.standard_normal(n)


def plain(bound: BoundModel, theta, conditions, response) -> np.ndarray:
    return np.square(response - bound.mean_response(theta, conditions)).sum(axis=1)


# Without the rigid wheel, whose integrals cost a thousand times the others.
FAST = [name for name in MODELS if not name.startswith("wong_reece")]


@pytest.mark.parametrize("name", FAST)
@settings(max_examples=10, deadline=None)
@given(seed=SEEDS, n=st.sampled_from(LENGTHS), levels=st.sampled_from([None, 1, 3]))
@example(seed=8199, n=257, levels=3)
def test_sums_are_those_over_all_rows(name: str, seed: int, n: int, levels: int | None) -> None:
    bound, theta, conditions, response = data(name, seed, n, levels=levels)
    found = Squares.of(bound, conditions, response)
    expected, largest = plain(bound, theta, conditions, response), np.abs(response).max()
    # Of 3000 terms, each with a relative rounding error of some 1e-13 (Newton's tolerance) and that
    # of a response, and of a mean of them, which may be large beside its residual.
    rounding = 4.0 * np.finfo(float).eps * largest * np.sqrt(n * expected)
    there = np.isfinite(expected)
    np.testing.assert_array_equal(found(theta)[~there], expected[~there])
    apart = np.abs(found(theta) - expected)[there]
    assert (apart <= (1e-9 * expected + rounding)[there]).all()


def test_a_condition_is_evaluated_once_however_often_it_was_measured() -> None:
    bound, _, conditions, response = data("magic_formula_pressure", 1, 5000, levels=6)
    squares = Squares.of(bound, conditions, response)
    assert squares.n_distinct == len(set(zip(*conditions.values(), strict=True)))
    assert sum(tile.response.size for tile in squares.tiles) == squares.n_distinct <= 36
    assert sum(float(tile.repeats.sum()) for tile in squares.tiles) == 5000


@pytest.mark.parametrize("column", ["inflation_pressure_psi", "slip_ratio"])
def test_a_tile_has_one_value_of_the_condition_of_fewest(column: str) -> None:
    """What the equation does with it is then done once for the tile."""
    bound, _, conditions, response = data("magic_formula_pressure", 7, 3000)
    few = np.random.default_rng(7).choice(conditions[column][:5], 3000)
    squares = Squares.of(bound, {**conditions, column: few}, response)
    assert [t.response.size for t in squares.tiles] == np.unique(few, return_counts=True)[
        1
    ].tolist()
    for tile in squares.tiles:
        assert min(np.ptp(v) for v in tile.conditions.values()) == 0.0


def test_repeats_that_agree_leave_nothing_within() -> None:
    bound, theta, conditions, _ = data("modified_bekker", 2, 300, levels=4)
    exact = bound.mean_response(theta[:1], conditions)[0]
    squares = Squares.of(bound, conditions, exact)
    assert squares.within < 1e-24 * exact.size
    assert squares(theta[:1])[0] < 1e-24 * exact.size


@pytest.mark.parametrize("name", FAST)
@pytest.mark.parametrize("n", LENGTHS)
def test_a_sum_does_not_depend_on_what_it_is_evaluated_with(
    name: str, n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    bound, theta, conditions, response = data(name, 3, n)
    many = np.tile(theta, (40 if n > 1000 else 300, 1))
    monkeypatch.setattr(module, "TILE_CELLS", max(4096, n))
    squares = Squares.of(bound, conditions, response)
    together = squares(many)
    # Other vectors may change the order of a sum, or Newton's last step of the implicit model.
    for i in (0, 3, 6):
        np.testing.assert_allclose(squares(theta[i : i + 1])[0], together[i::7], rtol=1e-9)


def test_threads_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    bound, theta, conditions, response = data("magic_formula_pressure", 4, 200_000)
    one, two = (Squares.of(bound, conditions, response, threads=t) for t in (1, 2))
    assert len(one.tiles) > 2
    monkeypatch.setattr(module, "PARALLEL_CELLS", 1)
    np.testing.assert_array_equal(one(theta), two(theta))


def test_memory_is_bounded_by_the_tile() -> None:
    """Some arrays of the cells a tile holds, whatever the rows and vectors."""
    bound, theta, conditions, response = data("magic_formula_pressure", 5, 100_000)
    squares = Squares.of(bound, conditions, response, threads=1)
    many = np.tile(theta, (10, 1))
    tracemalloc.start()
    squares(many)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * 8 * module.TILE_CELLS < many.shape[0] * response.size * 8


def test_a_vector_without_a_value_does_not_touch_the_others() -> None:
    bound, theta, conditions, response = data("magic_formula_pressure", 6, 42)
    squares = Squares.of(bound, conditions, response)
    before = squares(theta)
    theta[2] = -1.0
    after = squares(theta)
    assert np.isnan(after[2])
    np.testing.assert_array_equal(np.delete(after, 2), np.delete(before, 2))


def test_in_another_process_it_is_the_same() -> None:
    bound, theta, conditions, response = data("magic_formula", 3, 3000)
    squares = Squares.of(bound, conditions, response)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(squares))(theta), squares(theta))
