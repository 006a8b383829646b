"""The test bench of the repository, `challenge`: used where it is, named where it is not."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from calib.errors import CalibError

_BENCH = "challenge"


@contextmanager
def from_the_bench(what: str) -> Iterator[None]:
    """Say of an import of `challenge` within the block that a wheel does not have it.

    Raises
    ------
    CalibError
        Naming the command or table that needs it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != _BENCH:
            raise
        raise CalibError(
            "the challenge is a test bench of the repository, not of the wheel",
            where=what, allowed="a checkout of the repository, with its folder `challenge`",
            mend="run from a checkout: `pip install -e .` in it",
        ) from None  # fmt: skip
