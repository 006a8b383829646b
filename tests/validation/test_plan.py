"""Plans of tests against closed forms, quadrature and exhaustive search."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest
from scipy import stats

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.gap.plan import plan_tests
from calib.inference.calibration import Calibration
from calib.inference.likelihood import Noise
from calib.validation.plan import Beliefs, NextTests, chosen_tests

SLIPS, TARGETS, SIGMA = np.linspace(0.0, 1.0, 6), np.linspace(0.4, 1.2, 9), 0.3
EVEN = np.full(SLIPS.size, SIGMA)
COVARIANCE = np.array([[0.5, -0.3, 0.1], [-0.3, 0.9, -0.2], [0.1, -0.2, 0.4]])


def terms(x: np.ndarray) -> np.ndarray:
    """A parabola, shape (n, 3)."""
    return np.stack([np.ones_like(x), x, x**2], axis=1)


def parabola(draws: int, sigma: np.ndarray = EVEN) -> Beliefs:
    """Draws of exactly this covariance."""
    z = np.random.default_rng(1).standard_normal((draws, 3))
    z = (z - z.mean(axis=0)) @ np.linalg.inv(np.linalg.cholesky(np.cov(z.T, bias=True))).T
    b = z @ np.linalg.cholesky(COVARIANCE).T
    return Beliefs(
        ("line",), np.zeros(draws, dtype=np.intp), np.ones(draws), (b @ terms(SLIPS).T)[..., None],
        np.broadcast_to(sigma, (draws, SLIPS.size))[..., None], (b @ terms(TARGETS).T)[:, None],
        np.full((draws, 1, TARGETS.size), 1.6449 * SIGMA), np.ones((draws, 1)),
    )  # fmt: skip


def planned(
    beliefs: Beliefs, budget: float = 3.0, aim: str = "bands", over: float | None = None,
    cost: list[float] | None = None, output: int = 0,
) -> NextTests:  # fmt: skip
    m = beliefs.readings.shape[1]
    columns = {"slip_ratio": np.arange(m) / m} | ({} if cost is None else {"cost": cost})

    def make(rows: np.ndarray | None) -> Beliefs:
        if rows is None:
            return beliefs
        return replace(beliefs, readings=beliefs.readings[:, rows], scale=beliefs.scale[:, rows])

    return chosen_tests(
        make, table_from_arrays(columns), budget, aim, None if over is None else (output, over),
        ("drawbar_pull_kn",), ((),) * m, np.random.default_rng(2),
    )  # fmt: skip


def rows_of(found: NextTests, m: int = SLIPS.size) -> list[int]:
    return np.rint(found.table["slip_ratio"] * m).astype(int).tolist()


def left(rows: list[int], sigma: np.ndarray = EVEN) -> float:
    """The textbook's variance over the targets after readings, of that before."""
    x, t = terms(SLIPS[rows]), terms(TARGETS)
    after = np.linalg.inv(np.linalg.inv(COVARIANCE) + (x.T / sigma[rows] ** 2) @ x)
    return float(np.trace(t @ after @ t.T) / np.trace(t @ COVARIANCE @ t.T))


@pytest.mark.parametrize("sigma", [np.full(6, SIGMA), np.geomspace(0.1, 1.0, 6)])
def test_a_plan_of_a_linear_model_is_that_of_the_closed_form(sigma: np.ndarray) -> None:
    found = planned(parabola(500, sigma))
    chosen: list[int] = []
    for _ in range(3):
        chosen.append(min(range(6), key=lambda i: left([*chosen, i], sigma)))
    assert rows_of(found) == chosen
    exact = [left(chosen[:k], sigma) for k in range(4)]
    np.testing.assert_allclose(found.forecast["bands"] ** 2, exact, rtol=1e-6)
    t = terms(TARGETS)
    width = 2 * stats.norm.ppf(0.95) * np.sqrt(np.trace(t @ COVARIANCE @ t.T) / TARGETS.size)
    np.testing.assert_allclose(found.band, [width], rtol=1e-9)
    np.testing.assert_allclose(found.reading, [2 * 1.6449 * SIGMA], rtol=1e-9)


def test_the_best_of_all_plans_is_hardly_better() -> None:
    found = planned(parabola(500))
    best = min(left([*rows]) for rows in combinations_with_replacement(range(6), 3))
    reached = 1.0 - found.forecast["bands"][-1] ** 2
    assert (1.0 - 1.0 / np.e) * (1.0 - best) <= reached <= 1.0 - best + 1e-9
    assert reached > 0.98 * (1.0 - best)


def test_the_simulation_agrees_where_all_is_normal() -> None:
    found = planned(parabola(4000))
    (mean, error), forecast = found.simulated["bands"], found.forecast["bands"][-1]
    assert 0.0 < error < 0.03
    assert abs(mean - forecast) < 4.0 * error
    assert found.unreliable < 0.1


@pytest.mark.parametrize("sigma", [1e-3, 1e-2, 0.1])
def test_readings_that_no_other_draw_explains_are_no_proof(sigma: float) -> None:
    """What the simulation finds is then too wide, and said to be unreliable."""
    found = planned(parabola(500, np.full(6, sigma)))
    assert found.unreliable > 0.5
    mean, error = found.simulated["bands"]
    assert mean - 3.0 * error > found.forecast["bands"][-1]


def test_a_student_reading_is_worth_its_information() -> None:
    """Normal noise of the variance (nu + 3)/(nu + 1) tells as much; the simulation knows better."""
    base, nu = parabola(4000), 4.0
    student = replace(
        base, own=np.column_stack([np.full(4000, nu), np.ones(4000)]), noise=Noise("student_t")
    )
    found = planned(student)
    normal = planned(replace(base, scale=base.scale * np.sqrt((nu + 3.0) / (nu + 1.0))))
    np.testing.assert_allclose(found.forecast["bands"], normal.forecast["bands"], rtol=1e-9)
    mean, error = found.simulated["bands"]
    assert abs(mean - found.forecast["bands"][-1]) < 4.0 * error + 0.02


def test_the_number_until_the_band_halves() -> None:
    found, chosen = planned(parabola(500), 1.0), list[int]()
    while left(chosen) > 0.25:
        chosen.append(min(range(6), key=lambda i: left([*chosen, i])))
    assert found.halved == len(chosen)
    np.testing.assert_allclose(found.left**2, left(chosen), rtol=1e-6)
    vague = planned(parabola(500, np.full(6, 50.0)), 1.0)
    assert vague.halved is None
    assert vague.left > 0.9


def by_cost(cost: np.ndarray, sigma: np.ndarray, by: np.ndarray) -> float:
    """What is left by the closed form of a budget of three, spent on gain over `by`."""
    chosen: list[int] = []
    while (fits := np.flatnonzero(cost <= 3.0 - cost[chosen].sum())).size:
        gain = [(left(chosen, sigma) - left([*chosen, i], sigma)) / by[i] for i in fits]
        chosen.append(int(fits[np.argmax(gain)]))
    return left(chosen, sigma)


def test_costs_are_kept_to_and_weighed() -> None:
    """The better of what counts costs and what does not: either may be."""
    ends = np.array([0.3, 9.0, 9.0, 9.0, 9.0, 0.3])
    better = []
    for sigma, cost in (
        (ends, [0.5, 1.0, 1.0, 1.0, 1.0, 3.0]), (np.full(6, SIGMA), [1.0, 1.0, 1.0, 1.0, 1.0, 3.0])
    ):  # fmt: skip
        found = planned(parabola(500, sigma), 3.0, cost=cost)
        assert found.cost.tolist() == [cost[i] for i in rows_of(found)]
        assert 3.0 - min(cost) < found.cost.sum() <= 3.0
        ways = [by_cost(np.array(cost), sigma, by) for by in (np.array(cost), np.ones(6))]
        np.testing.assert_allclose(found.forecast["bands"][-1] ** 2, min(ways), rtol=1e-6)
        better.append(int(np.argmin(ways)))
    assert better == [1, 0]


def test_a_decision_is_as_often_wrong_as_by_quadrature() -> None:
    beliefs, level = parabola(500), 0.4
    found = planned(beliefs, 1.0, "decision", over=level)
    x, t = terms(SLIPS), terms(TARGETS)
    before, every = np.einsum("ti,ij,tj->t", t, COVARIANCE, t), []
    for i in range(6):
        c = t @ COVARIANCE @ x[i]
        moved = c**2 / (x[i] @ COVARIANCE @ x[i] + SIGMA**2)
        z = stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)[:, None]
        p = stats.norm.sf((level - np.sqrt(moved) * z) / np.sqrt(before - moved))
        every.append(np.minimum(p, 1.0 - p).mean())
    p = stats.norm.sf(level / np.sqrt(before))
    assert rows_of(found) == [int(np.argmin(every))]
    expected = [np.minimum(p, 1.0 - p).mean(), min(every)]
    np.testing.assert_allclose(found.forecast["decision"], expected, rtol=2e-4)
    mean, error = found.simulated["decision"]
    assert abs(mean - expected[1]) < 4.0 * error + 0.01
    with pytest.raises(CalibError, match="as good as certain"):
        planned(beliefs, 1.0, "decision", over=50.0)


def two_causes(draws: int, apart: float) -> Beliefs:
    """Means that differ at the third of four conditions only, and the target with them."""
    rng, half = np.random.default_rng(3), draws // 2
    cause = np.repeat([0, 1], half).astype(np.intp)
    level = rng.standard_normal(draws) * 0.2
    read = np.tile(level[:, None, None], (1, 4, 1))
    read[:, 2, 0] += apart * cause
    target = level + apart * cause
    scale = np.where(cause, 0.9, 0.5)[:, None, None] * np.ones_like(read)
    return Beliefs(
        ("one", "other"), cause, np.repeat([0.7, 0.3], half) / half, read, scale,
        target[:, None, None], np.full((draws, 1, 1), 0.8), np.ones((draws, 1)),
    )  # fmt: skip


def test_causes_are_told_apart_where_they_differ() -> None:
    beliefs, apart = two_causes(8000, 1.5), 1.5
    p, s2, v = np.array([0.7, 0.3]), np.array([0.5, 0.9]) ** 2, 0.2**2
    y = np.linspace(-4.0, 6.0, 4001)[:, None]
    joint = p * stats.norm.pdf(y, np.array([0.0, apart]), np.sqrt(v + s2))
    total = joint.sum(axis=1)
    w = joint / total[:, None]
    step = y[1, 0] - y[0, 0]
    wrong = 1.0 - (np.square(w).sum(axis=1) * total).sum() * step
    mean = np.array([0.0, apart]) + v / (v + s2) * (y - np.array([0.0, apart]))
    between = (w * mean**2).sum(axis=1) - (w * mean).sum(axis=1) ** 2
    variance = p @ (v * s2 / (v + s2)) + (between * total).sum() * step
    now = v + apart**2 * 0.7 * 0.3
    # Of what is forecast from 256 truths and simulated from 400, four standard errors.
    for aim in ("causes", "bands"):
        found = planned(beliefs, 1.0, aim)
        assert rows_of(found, 4) == [2]
        assert found.forecast["causes"] == pytest.approx([1 - 0.7**2 - 0.3**2, wrong], abs=0.05)
        assert found.forecast["bands"] ** 2 == pytest.approx([1.0, variance / now], rel=0.15)
        for name, exact in (("causes", wrong), ("bands", np.sqrt(variance / now))):
            value, error = found.simulated[name]
            assert abs(value - exact) < 4.0 * error
    decided = planned(beliefs, 1.0, "decision", over=0.75)
    assert rows_of(decided, 4) == [2]
    value, error = decided.simulated["decision"]
    assert abs(value - decided.forecast["decision"][-1]) < 5.0 * error


def test_two_outputs_are_read_at_once() -> None:
    """One test of two outputs brings what a test of each would."""
    one = parabola(500)
    both = replace(
        one, readings=np.concatenate([one.readings[:, :3], one.readings[:, 3:]], axis=2),
        scale=np.full((500, 3, 2), SIGMA), targets=np.repeat(one.targets, 2, axis=1),
        half=np.repeat(one.half, 2, axis=1),
    )  # fmt: skip
    found = planned(both, 1.0)
    best = min(range(3), key=lambda i: left([i, i + 3]))
    assert rows_of(found, 3) == [best]
    np.testing.assert_allclose(found.forecast["bands"][-1] ** 2, left([best, best + 3]), rtol=1e-6)


def test_where_the_model_has_no_value_nothing_is_planned() -> None:
    base = parabola(500)
    read = base.readings.copy()
    read[:50, 0] = np.nan
    read[:10, 1] = np.nan
    found = planned(replace(base, readings=read))
    assert found.excluded == (1, 0)
    assert 0 not in rows_of(found)
    with pytest.raises(CalibError, match="no value at any of the conditions"):
        planned(replace(base, readings=np.full_like(read, np.nan)))
    scattered = np.where(np.arange(500)[:, None] % 25 == np.arange(20), np.nan, 1.0)[..., None]
    with pytest.raises(CalibError, match="for 20% of the posterior"):
        planned(replace(base, readings=scattered, scale=np.ones_like(scattered)))


def grid_of(slip: np.ndarray, **more: object) -> dict[str, object]:
    return {"slip_ratio": slip, "inflation_pressure_psi": np.full(slip.size, 30.0)} | more


def test_a_calibration_is_planned_for(pull_calibration: Calibration) -> None:
    slip = np.linspace(0.02, 0.9, 12)
    found = plan_tests(pull_calibration, grid_of(slip), 4)
    (mean, error), forecast = found.simulated["bands"], found.forecast["bands"]
    assert (np.diff(forecast) < 0.0).all()
    assert abs(mean - forecast[-1]) < 4.0 * error + 0.03
    calibrated = pull_calibration.problem.conditions["slip_ratio"].max()
    for at, flags in zip(found.table["slip_ratio"], found.outside, strict=True):
        assert flags == (("slip_ratio",) if at > calibrated else ())
    frame = found.to_dataframe()
    np.testing.assert_allclose(frame["bands_after"], forecast[1:])
    known = grid_of(np.array([0.1, 0.2]))
    decided = plan_tests(
        pull_calibration, grid_of(slip), 2, known, exceeds={"drawbar_pull_lbf": 180.0}
    )
    assert decided.aim == "decision"
    assert decided.targets == 2


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"budget": 0.5}, "a budget of 0.5"),
        ({"budget": 99.0}, "1 to 50 tests"),
        ({"aim": "causes"}, "causes are those of a diagnosis"),
        ({"aim": "decision"}, "needs a threshold"),
        ({"exceeds": {"rut_depth_mm": 1.0}}, "no decision can be made on rut_depth_mm"),
        ({"cost": [1.0, -2.0]}, "a test costs '-2.0'"),
        ({"cost": ["1", "dear"]}, "a test costs 'dear'"),
    ],
)
def test_what_cannot_be_planned(
    pull_calibration: Calibration, given: dict[str, object], said: str
) -> None:
    more = {"cost": given.pop("cost")} if "cost" in given else {}
    grid = grid_of(np.array([0.1, 0.3]), **more)
    with pytest.raises(CalibError, match=said):
        plan_tests(pull_calibration, grid, **({"budget": 2.0} | given))
