from tests.commands import calib as run  # noqa: F401
