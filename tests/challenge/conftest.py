from tests.cli.test_cli import calib as run  # noqa: F401
