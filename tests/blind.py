"""Small blind tests, made once for the tests of cases and scores."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from calib.batch.environment import sha256
from calib.gap.well_specified import well_specified_case
from challenge.make import make
from challenge.redraw import redraw


@dataclass(frozen=True)
class BlindTest:
    """Where a small blind test was written, and the hash of its key."""

    cases: Path
    key: Path
    digest: str


@pytest.fixture(scope="session")
def blind_test(tmp_path_factory: pytest.TempPathFactory) -> BlindTest:
    """Return six cases of both tiers."""
    root = tmp_path_factory.mktemp("blind")
    digest = make(root / "cases", root / "sealed" / "key.json", seed=5, n_cases=6)
    return BlindTest(root / "cases", root / "sealed" / "key.json", digest)


@pytest.fixture(scope="session")
def believed_test(blind_test: BlindTest, tmp_path_factory: pytest.TempPathFactory) -> BlindTest:
    """Return the same cases, drawn again as the diagnosis believes."""
    cases, key = (tmp_path_factory.mktemp("believed") / name for name in ("cases", "key.json"))
    draw = partial(well_specified_case, 1)
    assert redraw(blind_test.cases, blind_test.key, cases, key, draw, seed=1) == {}
    return BlindTest(cases, key, sha256(key.read_bytes()))
