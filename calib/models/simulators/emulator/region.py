"""Where a posterior lies: the runs there matter most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array

__all__ = ["Region"]


@dataclass(frozen=True)
class Region:
    """A part of parameter space, with coordinates in which it is round.

    Parameters
    ----------
    centre : ndarray, shape (d,)
        In units of the prior's sds.
    root : ndarray, shape (d, d)
        Lower factor of the covariance there.
    reach : float
        In sds.
    """

    centre: Array
    root: Array
    reach: float

    def coordinates(self, z: Array) -> Array:
        """Return coordinates in which the region is round, (k, d) to (k, d)."""
        return np.asarray(np.linalg.solve(self.root, (z - self.centre).T).T)

    def inside(self, z: Array) -> NDArray[np.bool_]:
        """Whether points lie in it, (k, d) to (k,)."""
        return np.asarray(np.linalg.norm(self.coordinates(z), axis=1) <= self.reach)
