"""The record of stated probabilities, against what was scored."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from scipy.stats import beta

from calib.gap.document import track_record

ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "calib" / "gap" / "track_record.toml"


@pytest.mark.parametrize("probability", [0.0, 0.3, 0.5, 0.65, 0.899, 0.9, 0.95, 1.0])
def test_every_probability_has_the_record_of_its_bin(probability: float) -> None:
    found = track_record(probability)
    assert found.low <= probability <= found.high
    low, high = beta.ppf([0.025, 0.975], found.right + 0.5, found.cases - found.right + 0.5)
    assert found.interval == pytest.approx((low, high), rel=1e-9)
    assert found.share == found.right / found.cases


def test_the_bins_join_and_rise() -> None:
    bins = [track_record(p) for p in (0.1, 0.55, 0.65, 0.75, 0.85, 0.95)]
    assert [b.low for b in bins[1:]] == [b.high for b in bins[:-1]]
    assert bins[-1].cases > 1000
    assert 0.97 < bins[-1].share < 0.99


def test_a_bin_is_the_sum_of_all_records() -> None:
    records = tomllib.loads(RECORDS.read_text(encoding="utf-8"))["record"]
    bins = [b for record in records for b in record["bins"] if b[0] == 0.9]
    assert track_record(0.93).cases == sum(b[2] for b in bins)
    assert track_record(0.93).right == sum(b[3] for b in bins)
