"""Named random streams: one seed, one independent stream for every purpose.

A stream depends on the seed and its labels only, never on what else was drawn before, so results
do not change with the order of the work or the number of processes it is spread over.

Points that fill a cube evenly: where a search begins, the same whatever the seed.
"""

from __future__ import annotations

from functools import lru_cache
from zlib import crc32

import numpy as np

from calib.models.base import Array


def stream(seed: int, *labels: str | int) -> np.random.SeedSequence:
    """Return the seed sequence of a purpose, such as ``stream(1, "drawbar_pull", "sample")``."""
    key = tuple(crc32(str(label).encode()) for label in labels)
    return np.random.SeedSequence(seed, spawn_key=key)


def generator(seed: int, *labels: str | int) -> np.random.Generator:
    """Return a generator on the stream of a purpose."""
    return np.random.default_rng(stream(seed, *labels))


@lru_cache(maxsize=64)
def even_points(size: int, dim: int) -> Array:
    """Spread points over the unit cube, shape (size, dim).

    Multiples of the powers of a generalised golden ratio, modulo one: a Kronecker sequence
    (H. Niederreiter, Random Number Generation and Quasi-Monte Carlo Methods, SIAM 1992, chapter 3).
    A search that begins at them finds what it finds for every seed; random ones, of which a few
    dozen leave holes in five dimensions, made what was found a matter of luck.
    """
    ratio = 2.0
    for _ in range(60):  # to the root of x^(dim + 1) = x + 1
        ratio = (1.0 + ratio) ** (1.0 / (dim + 1))
    steps = ratio ** -np.arange(1.0, dim + 1)
    points = (0.5 + np.arange(1.0, size + 1)[:, None] * steps) % 1.0
    points.setflags(write=False)  # every caller is given the same
    return np.asarray(points)


def latin(rng: np.random.Generator, size: int, dim: int) -> Array:
    """Draw from the unit cube by a Latin hypercube, shape (size, dim).

    One point in each of `size` slices of every coordinate, so that a mean over them hardly varies
    by what depends on one coordinate at a time (M. D. McKay, R. J. Beckman, W. J. Conover,
    Technometrics 21 (1979) 239-245, doi:10.1080/00401706.1979.10489755). `scipy.stats.qmc` has it
    as well, which takes longer to import than a diagnosis to start.
    """
    slices = rng.permuted(np.tile(np.arange(size)[:, None], (1, dim)), axis=0)
    return np.asarray((slices + rng.uniform(size=(size, dim))) / size)
