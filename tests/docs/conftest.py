from tests.cli.conftest import _one_figure  # noqa: F401
from tests.commands import calib as run  # noqa: F401
from tests.extension.test_extension import as_before  # noqa: F401
