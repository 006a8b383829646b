"""Small blind tests, made once for the tests of cases and scores."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from calib.gap.well_specified import well_specified_case
from challenge.make import make
from challenge.redraw import redraw
from challenge.seal import open_answers


@dataclass(frozen=True)
class BlindTest:
    """Where the cases and answers of a small blind test were written."""

    cases: Path
    key: Path

    @property
    def answers(self) -> dict[str, dict[str, Any]]:
        """The answers by case."""
        found = open_answers(self.cases, self.key)
        return {name: answer.model_dump() for name, answer in found.items()}


@pytest.fixture(scope="session")
def blind_test(tmp_path_factory: pytest.TempPathFactory) -> BlindTest:
    """Return six cases of both tiers."""
    root = tmp_path_factory.mktemp("blind")
    make(root / "cases", root / "sealed", seed=5, n_cases=6)
    return BlindTest(root / "cases", root / "sealed")


@pytest.fixture(scope="session")
def believed_test(blind_test: BlindTest, tmp_path_factory: pytest.TempPathFactory) -> BlindTest:
    """Return the same cases, drawn again as the diagnosis believes."""
    cases, key = (tmp_path_factory.mktemp("believed") / name for name in ("cases", "answers"))
    draw = partial(well_specified_case, 1)
    assert redraw(blind_test.cases, blind_test.key, cases, key, draw, seed=1) == {}
    return BlindTest(cases, key)
