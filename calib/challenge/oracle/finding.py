"""What the oracle finds of one state, and how the evidence of its variants adds up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

NEVER = -1e6
type Part = tuple[float, float, float]


@dataclass(frozen=True)
class Finding:
    """What a field says of one state.

    Attributes
    ----------
    log_evidence : float
        Logarithm of the mean likelihood over the generator's draws, those that it throws away
        counted as nil, relative to that of no gap.
    known_soil : float
        The same for one who knows the soil.
    error : float
        Relative standard error of the evidence.
    kept : float
        Share of draws that the generator keeps on this stage.
    """

    log_evidence: float
    known_soil: float
    error: float
    kept: float


def mixed(parts: Sequence[Part]) -> tuple[float, float]:
    """Return logarithm and relative error of the evidence of a mixture.

    Parameters
    ----------
    parts : sequence of (float, float, float)
        Share, logarithm of the evidence and its relative error, of each part.
    """
    if not parts:
        return NEVER, 0.0
    share, log, error = np.array(parts).T
    logs = np.log(share) + log
    scale = float(logs.max())
    each = np.exp(logs - scale)
    total = float(each.sum())
    return scale + float(np.log(total)), float(np.sqrt(np.sum((each * error) ** 2))) / total
