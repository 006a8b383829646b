"""Rankings and diagnoses that several tests read, worked out once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.gap.cases import SHARED


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """Return the folder of the shared cases."""
    if not SHARED.is_dir():
        pytest.skip(f"there are no shared cases at {SHARED}")
    return SHARED
