"""Named random streams: one seed, one independent stream for every purpose.

A stream depends on the seed and its labels only, never on what else was drawn before, so results
do not change with the order of the work or the number of processes it is spread over.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, *labels: str | int) -> np.random.SeedSequence:
    """Return the seed sequence of a purpose, such as ``stream(1, "drawbar_pull", "sample")``."""
    key = tuple(crc32(str(label).encode()) for label in labels)
    return np.random.SeedSequence(seed, spawn_key=key)


def generator(seed: int, *labels: str | int) -> np.random.Generator:
    """Return a generator on the stream of a purpose."""
    return np.random.default_rng(stream(seed, *labels))
