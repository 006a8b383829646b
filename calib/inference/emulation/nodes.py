"""The conditions at which every run is evaluated: those of the data, and others between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calib.data.quantities import QUANTITIES
from calib.models.base import Array

# Nodes by the number of conditions that vary: a curve is smooth, a surface needs more.
_ENOUGH = {0: 1, 1: 24, 2: 56}
_MANY, _MOST, _CORNERS = 90, 160, 3
# The box of the nodes is wider than the recorded conditions by so much of their range on each
# side: an effect on a gauge takes the simulator there.
_MARGIN = 0.1


def choose_nodes(
    recorded: Sequence[Mapping[str, Array]],
    ranges: Mapping[str, tuple[float, float]],
    count: int | None = None,
    *,
    across_zero: bool = False,
) -> dict[str, Array]:
    """Choose the conditions of every run: the distinct recorded ones, then others between them.

    Parameters
    ----------
    recorded : sequence of mapping of str to ndarray, shape (n,)
        The conditions of every table that will be predicted, in canonical columns.
    ranges : mapping of str to (float, float)
        Bounds that the user gave, which the nodes then span.
    count : int, optional
        How many, of whole numbers fewer if there are no more; by default as many as the number of
        varying conditions asks for. Of more rows so many are taken, and spread evenly.
    across_zero : bool
        Whether the margin may change a condition's sign, as a slip's does with another rolling
        radius: many formulas and some simulators end there.
    """
    columns = tuple(recorded[0])
    rows = np.concatenate([np.stack([r[c] for c in columns], axis=1) for r in recorded])
    rows = np.unique(rows, axis=0)
    low, high = _box(columns, rows, ranges, across_zero)
    varying = high > low
    unit = np.where(varying, high - low, 1.0)
    inside = (rows - low) / unit
    most = count or _MOST
    if len(inside) > most:
        inside = inside[_spread(inside, np.zeros((0, len(columns))), most)]
    wanted = count or _ENOUGH.get(int(varying.sum()), _MANY)
    more = max(wanted - len(inside), 0)
    if more:
        inside = np.concatenate([inside, *_between(inside, varying, more)])
    found = np.where(varying, low + inside * unit, low)
    for i, column in enumerate(columns):
        if QUANTITIES[column].range.integer:
            found[:, i] = np.round(found[:, i])
    found = found[np.sort(np.unique(found, axis=0, return_index=True)[1])]
    return {c: found[:, i].copy() for i, c in enumerate(columns)}


def across_zero(
    nodes: Mapping[str, Array], recorded: Sequence[Mapping[str, Array]] = ()
) -> NDArray[np.bool_]:
    """Whether each node has a condition below zero that no recorded row has below zero, (m,)."""
    found = np.zeros(next(iter(nodes.values())).size, dtype=bool)
    for column, values in nodes.items():
        if all((r[column] >= 0.0).all() for r in recorded):
            found |= values < 0.0
    return found


def _box(
    columns: Sequence[str],
    rows: Array,
    ranges: Mapping[str, tuple[float, float]],
    across_zero: bool,
) -> tuple[Array, Array]:
    low, high = rows.min(axis=0), rows.max(axis=0)
    wide = _MARGIN * (high - low)
    for i, column in enumerate(columns):
        if column in ranges:
            low[i], high[i] = min(low[i], ranges[column][0]), max(high[i], ranges[column][1])
            continue
        span = QUANTITIES[column].range
        least = max(span.low, 0.0 if low[i] >= 0.0 and not across_zero else -np.inf)
        low[i] = max(
            low[i] - wide[i], min(least, low[i]), 0.5 * low[i] if span.low_open else -np.inf
        )
        high[i] = min(high[i] + wide[i], span.high)
    return low, high


def _between(inside: Array, varying: NDArray[np.bool_], more: int) -> tuple[Array, Array]:
    """Corners of the box, and points far from all nodes, as dense as the data are.

    Far is measured half by the conditions and half by their ranks: where readings were taken
    close together the output changes fast.
    """
    from scipy.stats import qmc  # late: half a second, and few commands emulate

    d = int(varying.sum())
    corners = np.zeros((2**d if d <= _CORNERS else 0, inside.shape[1]))
    if len(corners):
        corners[:, varying] = np.stack(np.meshgrid(*[[0.0, 1.0]] * d), axis=-1).reshape(-1, d)
    candidates = np.zeros((512, inside.shape[1]))
    candidates[:, varying] = qmc.Sobol(d, scramble=False).random_base2(9)
    apart = np.abs(corners[:, None] - inside).max(axis=2).min(axis=1, initial=np.inf)
    corners = corners[apart > 1e-9][:more]
    there = np.concatenate([inside, corners])
    rest = more - len(corners)
    picked = _spread(_ranked(candidates, inside), _ranked(there, inside), rest)
    return corners, np.asarray(candidates[picked])


def _ranked(points: Array, inside: Array) -> Array:
    found = points.copy()
    for i, column in enumerate(inside.T):
        known = np.unique(np.concatenate([[0.0], column, [1.0]]))
        rank = np.interp(points[:, i], known, np.linspace(0.0, 1.0, known.size))
        found[:, i] = 0.5 * (points[:, i] + rank)
    return found


def _spread(candidates: Array, there: Array, count: int) -> list[int]:
    """Pick candidates, each as far as can be from those that are there and those picked."""
    far = np.full(len(candidates), np.inf)
    for point in there:
        far = np.minimum(far, np.square(candidates - point).sum(axis=1))
    picked: list[int] = []
    for _ in range(count):
        i = int(np.argmax(far))
        picked.append(i)
        far = np.minimum(far, np.square(candidates - candidates[i]).sum(axis=1))
    return picked
