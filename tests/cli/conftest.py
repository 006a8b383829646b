from tests.commands import calib  # noqa: F401
