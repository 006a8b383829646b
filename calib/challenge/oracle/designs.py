"""How probable every hypothesis is before its outcomes are seen, and what a design tells of it."""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np

from calib.challenge.build import unlisted_weight
from calib.challenge.design import Design, Needs, Tier, draw_columns, draw_models, draw_outputs
from calib.challenge.effects import LISTED, needs_of, wheel_effects
from calib.challenge.make import NULL_FRACTION, PAIR_FRACTION, SHIFT_FRACTION, UNKNOWN_FRACTION
from calib.challenge.mechanism import NONE, SHIFT, UNKNOWN
from calib.challenge.oracle.causes import kind_of_state, unlisted_states
from calib.challenge.oracle.script import branches


@cache
def plan_shares(tier: Tier) -> dict[str, float]:
    """Return how often each state is planned in a tier; pairs are named ``a+b``.

    Parameters
    ----------
    tier : str
        ``easy`` or ``hard``.
    """
    listed = 1.0 - NULL_FRACTION - UNKNOWN_FRACTION - SHIFT_FRACTION
    paired = PAIR_FRACTION * listed if tier == "hard" else 0.0
    odd = {state: unlisted_weight(kind) for state, kind in unlisted_states().items()}
    shares = {NONE: NULL_FRACTION, SHIFT: SHIFT_FRACTION}
    shares |= {state: UNKNOWN_FRACTION * w / sum(odd.values()) for state, w in odd.items()}
    shares |= {name: (listed - paired) / len(LISTED) for name in LISTED}
    pairs = ["+".join(pair) for pair in combinations(sorted(wheel_effects()), 2)]
    return shares | ({name: paired / len(pairs) for name in pairs} if paired else {})


def named(state: str) -> str:
    """Return the hypothesis of a state: the unlisted mechanisms are one."""
    return UNKNOWN if state.startswith(UNKNOWN) else state


def log_design(design: Design, state: str) -> float:
    """Return the logarithm of how probable a design's layout is where a state is to act.

    Outputs, models and recorded columns depend on what the generator wants to show; all else of
    a design does not. Minus infinity where the state cannot act on it.

    Parameters
    ----------
    design : Design
        The design.
    state : str
        As in `plan_shares`.
    """
    kinds = () if state in (NONE, SHIFT) else tuple(map(kind_of_state, state.split("+")))
    needs = needs_of(kinds)
    models = tuple(design.models.items())
    several = len(design.inflation_kpa) > 1
    shown = _models_share(models, needs) * _columns_share(
        design.outputs, design.columns, design.varying, needs.varies, several
    )
    return float(np.log(shown)) if shown > 0.0 else -np.inf


@cache
def _models_share(models: tuple[tuple[str, str], ...], needs: Needs) -> float:
    def draw(rng: np.random.Generator) -> tuple[tuple[str, str], ...]:
        drawn = draw_outputs(rng, needs)
        return tuple(draw_models(rng, drawn, needs).items())

    return sum(branch.probability for branch in branches(draw) if branch.at() == models)


@cache
def _columns_share(
    outputs: tuple[str, ...],
    columns: tuple[str, ...],
    varying: tuple[str, ...],
    wanted: tuple[str, ...],
    several: bool,
) -> float:
    needs = Needs(varies=wanted)

    def draw(rng: np.random.Generator) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return draw_columns(rng, outputs, needs, 2 if several else 1)

    return sum(b.probability for b in branches(draw) if b.at() == (columns, varying))
