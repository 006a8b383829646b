"""What a worker process on this machine does first; Dask loads it there."""

from __future__ import annotations

import signal

from calib.batch.plugins import inherit


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that owns the workers.

    What the user registered there is registered here too.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    inherit()
