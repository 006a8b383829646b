"""The signs of c7 to c9 by the least possible cost, and the search behind it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.he2019.audit.bounds import (
    ASSUMED_SLIPS,
    COEFFICIENTS,
    joint_bounds,
    printed_coefficients,
    references,
)
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.searches import curvature_signs, least_cost, study_curvature_signs
from calib.he2019.published import PUBLISHED
from tests.he2019.audit.altered import flipped

SEED = 2019


@pytest.fixture(scope="module")
def study():
    return study_curvature_signs(PUBLISHED, SEED)


def verdicts(published, study) -> tuple[Verdict, Verdict]:
    first, last = curvature_signs(published, study)
    return first.verdict, last.verdict


def test_c7_and_c8_are_confirmed_and_c9_corrected(study):
    assert verdicts(PUBLISHED, study) == (Verdict.CONFIRMED, Verdict.CORRECTED)
    assert study.order[0] == (1, -1, 1)
    # The figures read as the audit proposes pass; with c7 or c8 read otherwise they do not.
    assert verdicts(flipped("Table 5: c9"), study) == (Verdict.CONFIRMED, Verdict.CONFIRMED)
    for name in ("c7", "c8"):
        assert verdicts(flipped(f"Table 5: {name}"), study)[0] is Verdict.CORRECTED


def test_c9_stays_open_where_the_order_depends_on_the_slips(study):
    mixed = {s: tuple(reversed(v)) if i else v for i, (s, v) in enumerate(study.by_shift.items())}
    best, second = study.order[:2]
    mixed[second] = (mixed[best][0] - 1e-4, *mixed[second][1:])
    assert verdicts(PUBLISHED, replace(study, by_shift=mixed))[1] is Verdict.UNTESTABLE


def test_no_random_coefficients_beat_the_search(study):
    rng = np.random.default_rng(3)
    known = references(PUBLISHED)
    half = np.array([PUBLISHED.pressure.estimates[n].half_unit for n in COEFFICIENTS])
    for signs in study.order[:4]:
        middle = printed_coefficients(PUBLISHED)
        middle[6:9] = np.abs(middle[6:9]) * signs
        drawn = middle + half * rng.uniform(-1.0, 1.0, (20_000, 10))
        least, _ = joint_bounds(drawn, known, ASSUMED_SLIPS, optimal=True)
        assert study.least[signs] <= least.min()


def test_the_search_does_not_depend_on_its_seed(study):
    for signs in study.order[:2]:
        again = least_cost(PUBLISHED, signs, ASSUMED_SLIPS, 7)
        assert again == pytest.approx(study.least[signs], rel=1e-5)


def test_dropping_the_optimum_can_only_lower_the_bound(study):
    for signs in study.least:
        assert study.least_free[signs] <= study.least[signs] * (1.0 + 1e-6)
