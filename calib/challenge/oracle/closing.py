"""The rule that recalibration has to close the gap of a parameter shift, at drawn shifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.challenge.build import recalibration_closes
from calib.challenge.oracle.bank import Bank
from calib.challenge.oracle.evidence import Singles, strength_at
from calib.challenge.oracle.lab import View
from calib.challenge.stage import Stage


def closed_share(
    stage: Stage,
    banks: Sequence[Bank],
    posterior: tuple[View, Sequence[Singles]] | None,
    count: int,
    rng: np.random.Generator,
) -> float:
    """Return the share of shifts that recalibration closes, half a hit and half a miss added.

    Parameters
    ----------
    stage : Stage
        Where.
    banks : sequence of Bank
        Of the shift's variants.
    posterior : (View, sequence of Singles), optional
        The field and what it says of the banks; without it shifts are drawn as the generator
        draws them.
    count : int
        How many shifts are drawn.
    rng : numpy.random.Generator
        Source of randomness.
    """
    if posterior is None:
        weights = [bank.cause.share * bank.weight for bank in banks]
    else:
        scale = max(one.scale for one in posterior[1])
        weights = [
            bank.cause.share * one.node * np.exp(one.scale - scale)
            for bank, one in zip(banks, posterior[1], strict=True)
        ]
    owners = np.repeat(np.arange(len(banks)), [weight.size for weight in weights])
    nodes = np.concatenate([np.arange(weight.size) for weight in weights])
    flat = np.concatenate(weights)
    closed = 0
    for pick in rng.choice(flat.size, count, p=flat / flat.sum()):
        bank, node = banks[int(owners[pick])], int(nodes[pick])
        strength = strength_at(bank, node, posterior[0] if posterior else None, rng)
        reality = bank.cause.reality(stage.reality, bank.dials[node], float(np.exp(strength)))
        closed += recalibration_closes(stage, stage.in_field(reality), stage.on_fresh(reality))
    return (closed + 0.5) / (count + 1.0)
