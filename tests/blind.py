"""One small blind test, made once for the tests of cases and scores."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from challenge.make import make


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
