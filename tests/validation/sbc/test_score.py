"""Coverage of bands: the standard error that a verdict rests on."""

from __future__ import annotations

import numpy as np
import pytest

from calib.errors import CalibError
from calib.validation.sbc import _coverage, score


def records(covered: np.ndarray, rows: int) -> list[dict]:
    return [{"rows": rows, "covered": {"95": int(c)}} for c in covered]


def test_few_campaigns_that_all_cover_are_no_alarm():
    """Between ten campaigns of which nine cover wholly there is hardly any spread to see."""
    found = _coverage(0.95, records(np.array([9] * 9 + [8]), 9))
    assert found.se == pytest.approx(np.sqrt(0.95 * 0.05 / 90))
    assert found.p > 0.05


def test_rows_that_share_a_posterior_widen_the_error():
    """Campaigns that cover all or nothing have the spread of campaigns, not of rows."""
    covered = np.array([9] * 38 + [0] * 2)
    found = _coverage(0.95, records(covered, 9))
    assert found.se == pytest.approx((covered / 9).std(ddof=1) / np.sqrt(40))
    assert found.p == pytest.approx(1.0)


def test_right_bands_raise_alarms_as_often_as_they_should():
    """Of independent rows: p below 0.05 in a twentieth of the runs, and never much more."""
    rng = np.random.default_rng(3)
    runs = [_coverage(0.95, records(rng.binomial(9, 0.95, n), 9)) for n in (10, 300) * 500]
    for few in (0, 1):
        share = np.mean([run.p < 0.05 for run in runs[few::2]])
        assert share < 0.05 + 4.0 * np.sqrt(0.05 * 0.95 / 500)


def test_without_rows_there_is_nothing_to_judge():
    found = _coverage(0.95, records(np.zeros(3, dtype=int), 0))
    assert np.isnan(found.proportion)
    assert found.p == 1.0


def test_a_run_of_which_all_failed_says_why():
    with pytest.raises(CalibError, match="could be calibrated: no disk"):
        score([], 1, 10, {"bekker-0000": "no disk"})


def test_without_posteriors_that_converged_nothing_is_told() -> None:
    record = {"model": "bekker", "seed": 1, "converged": False, "ranks": {}}
    with pytest.raises(CalibError, match="0 of 3 posteriors of bekker converged") as caught:
        score([{**record, "index": i} for i in range(3)], 1, 3)
    assert "those that are done are kept" in str(caught.value)
