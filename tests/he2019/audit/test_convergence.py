"""The genetic algorithm over seeds, and the verdict that follows from its costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import beta

from calib.batch.pool import HERE
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.searches import (
    Search,
    Seeds,
    begin_convergence,
    convergence_findings,
    printed_settings,
)
from calib.he2019.published import PUBLISHED


def searched(seed, seeds, tell=lambda what, done, planned: None):
    return begin_convergence(PUBLISHED, seed, seeds, HERE)(tell)


@pytest.fixture(scope="module")
def study():
    return searched(2019, Seeds(4, 2, 3))


def judged(study):
    return {f.key: f.verdict for f in convergence_findings(study)}


def search(*costs: float) -> Search:
    return Search("a search", 0.07, np.array(costs), "0.1050")


def test_settings_are_those_of_table_2():
    s = printed_settings(PUBLISHED)
    assert (s.F, s.CP, s.MP, s.NP, s.max_iterations) == (0.4, 0.6, 0.1, 50, 4000)
    assert (s.mutation_low, s.mutation_high) == (0.0, 1.0)
    assert printed_settings(altered_settings(NP="20")).NP == 20


def altered_settings(**changes: str):
    setup = PUBLISHED.setup
    settings = dict(setup.genetic_settings)
    settings |= {k: replace(settings[k], text=v) for k, v in changes.items()}
    return replace(PUBLISHED, setup=replace(setup, genetic_settings=settings))


def test_every_pressure_ends_at_table_4(study):
    for psi, found in study.by_pressure.items():
        assert found.optimum == pytest.approx(
            PUBLISHED.genetic[psi].quality["cost"].value, abs=5e-5
        )
        assert found.arrived == found.costs.size == 4
    assert study.joint.optimum == pytest.approx(0.0709, abs=5e-5)
    assert judged(study)["genetic_by_pressure"] is Verdict.CONFIRMED


def test_no_run_ends_below_the_optimum(study):
    for found in study.searches:
        assert np.all(found.costs >= found.optimum * (1.0 - 1e-9))


def test_runs_that_stop_short_change_the_verdict(study):
    short = {
        **study.by_pressure,
        30: replace(study.by_pressure[30], costs=np.array([0.0091, 0.02])),
    }
    assert judged(replace(study, by_pressure=short))["genetic_by_pressure"] is Verdict.CONTRADICTED
    always = replace(study, printed_coordinates=search(0.07, 0.0701))
    assert judged(always)["genetic_joint"] is Verdict.CONFIRMED
    never = replace(study, printed_coordinates=search(0.07, 0.105))
    assert judged(never)["genetic_joint"] is Verdict.CONTRADICTED


@pytest.mark.parametrize(("costs", "hits"), [((0.07, 0.0706, 0.08), 2), ((0.09, 0.1), 0)])
def test_shares_carry_jeffreys_intervals(costs, hits):
    share = search(*costs).share
    n = len(costs)
    assert share.value == hits / n
    low, high = beta.ppf([0.025, 0.975], hits + 0.5, n - hits + 0.5)
    assert share.upper == pytest.approx(high)
    assert share.lower == (0.0 if hits == 0 else pytest.approx(low))


def test_same_seed_same_costs(study):
    again = searched(2019, Seeds(1, 1, 1))
    for a, b in zip(again.searches, study.searches, strict=True):
        assert a.costs[0] == b.costs[0]


def test_progress_is_told(study):
    told = []
    searched(1, Seeds(1, 1, 1), lambda *args: told.append(args))
    assert told[-1][1:] == (5, 5)
    assert [t[1] for t in told] == [1, 2, 3, 4, 5]


@pytest.mark.slow
def test_through_the_printed_coefficients_some_runs_stop_short():
    found = searched(2019, Seeds(1, 1, 40)).printed_coordinates
    assert 0 < found.arrived < 40
    assert found.costs.max() > 1.5 * found.optimum
