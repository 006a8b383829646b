from tests.commands import calib as run  # noqa: F401
from tests.extension.test_extension import as_before  # noqa: F401
