from collections.abc import Iterator

import pytest

from calib.data.quantities import QUANTITIES
from calib.gap.effects import EFFECTS
from calib.models import MODELS
from calib.models.simulators.files import load_files
from challenge.measured.cases import SIMULATORS
from tests.commands import calib as run  # noqa: F401
from tests.registered import forgotten


@pytest.fixture(scope="module")
def simulators() -> Iterator[None]:
    """Register the bench's own simulators, and take them back."""
    with forgotten(QUANTITIES, MODELS, EFFECTS):
        load_files(SIMULATORS)
        yield
