"""One campaign that is done, which many tests read."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.batch.campaign import read_plan, run_campaign
from tests.batch.campaign.sites import make_site


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the plan; not to be changed."""
    return make_site(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="session")
def serial(site: Path) -> Path:
    """Folder of the whole campaign, done in this process; not to be changed."""
    out = site.parent / "serial"
    run_campaign(read_plan(site), out)
    return out
