"""Draw one case: a scenario, and a truth at a strength that its field campaign can show."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from challenge.design import Tier
from challenge.effects import ABSORBABLE, UNLISTED, kind_of, needs_of
from challenge.identify import Identifiability, identify, isolable_nats
from challenge.mechanics import Reality
from challenge.mechanism import DENSITY, NONE, SHIFT, UNKNOWN, EffectKind, Readings
from challenge.scenario import LACK_OF_FIT, Scenario, draw_scenario, rms
from challenge.shift import LARGEST_AMOUNT, SMALLEST_AMOUNT, draw_shift, shifted
from challenge.surrogate import misfit, recalibrate

type Array = NDArray[np.float64]
type AtStrength = Callable[[float], Reality]
type Kinds = tuple[EffectKind, ...]

# Noise sds, by tier.
SMALLEST_GAP: Mapping[Tier, float] = {"easy": 2.0, "hard": 2.0, "large": 5.0}
LARGEST_GAP: Mapping[Tier, float] = {"easy": 6.0, "hard": 6.0, "large": 30.0}
# Of each of several effects, beside the others.
OWN_GAP = 1.0
# One effect alone is drawn with a little more than the smallest gap, each of two with less and
# over a part of the range, the second's place in it near the first's.
SINGLE_FLOOR, PAIR_FLOOR = 1.06, 1.3 * OWN_GAP
PAIR_SPAN, PAIR_SPREAD = 0.85, 0.3
ISOLABLE_NATS, ABSORBABLE_NATS, RIVAL_NATS = 6.0, 2.0, 2.0
UNLISTED_NATS = {"easy": 12.0, "hard": 8.0, "large": 8.0}
DENSITY_ODDITY = 0.4
CLOSE = 0.04


@dataclass(frozen=True)
class DrawnCase:
    """A finished case, noise-free, with what the key says about it.

    Attributes
    ----------
    scenario : Scenario
        Design, conditions and readings without mechanisms.
    truth, mechanism : str
        The name of the contract and one sentence.
    field_truth, test_truth : dict
        Noise-free readings as the field really was.
    gap_over_noise : float
        Rms of the gap in noise sd.
    told : Identifiability
        What the gap allows to tell.
    contributions : dict
        Listed effect to the rms of what goes from the gap without it, in noise sd.
    """

    scenario: Scenario
    truth: str
    mechanism: str
    field_truth: Readings
    test_truth: Readings
    gap_over_noise: float
    told: Identifiability
    contributions: dict[str, float]


def scale_to(
    scenario: Scenario,
    at: AtStrength,
    bounds: tuple[float, float],
    low: float,
    high: float,
    place: float,
) -> Reality | None:
    """Return the reality whose gap is the wanted one.

    Parameters
    ----------
    scenario : Scenario
        Where the gap is measured.
    at : callable
        Reality at a strength.
    bounds : tuple of float
        Smallest and largest sensible strength.
    low, high : float
        Smallest and largest gap wanted, in noise sd.
    place : float
        In [0, 1]: how far between the two on a logarithmic scale; where the largest strength
        gives less than `high`, between `low` and that.

    Returns
    -------
    Reality or None
        None where no sensible strength gives such a gap. Within 4 % of the wanted gap.
    """

    def log_gap(log_strength: float) -> float:
        return float(
            np.log(max(rms(scenario.gap(scenario.in_field(at(np.exp(log_strength))))), 1e-9))
        )

    x0, x1 = float(np.log(bounds[0])), float(np.log(bounds[1]))
    y0, y1 = log_gap(x0), log_gap(x1)
    floor, ceiling = float(np.log(low)), min(float(np.log(high)), y1 - CLOSE)
    goal = floor + place * (ceiling - floor)
    if ceiling < floor or y0 > goal:
        return None
    for step in range(14):
        share = 0.5 if step % 3 == 2 else float(np.clip((goal - y0) / (y1 - y0), 0.05, 0.95))
        x = x0 + share * (x1 - x0)
        y = log_gap(x)
        if abs(y - goal) < CLOSE:
            return at(float(np.exp(x)))
        x0, y0, x1, y1 = (x, y, x1, y1) if y < goal else (x0, y0, x, y)
    return None


def _effect(
    rng: np.random.Generator, scenario: Scenario, kind: EffectKind, low: float, place: float
) -> Reality | None:
    """Draw a variant and a sign of an effect, at the strength whose gap is wanted."""
    family = kind.draw(rng)
    sign = float(rng.choice(np.array(family.signs)))

    def at(strength: float) -> Reality:
        return scenario.reality.with_mechanisms(family.at(sign * strength))

    largest = LARGEST_GAP[scenario.design.tier]
    return scale_to(scenario, at, (family.low, family.high), low, largest, place)


def _shift(
    rng: np.random.Generator, scenario: Scenario, place: float
) -> tuple[Reality, str] | None:
    change, sentence = draw_shift(rng)

    def at(amount: float) -> Reality:
        return shifted(scenario.reality, change, amount)

    amounts = SMALLEST_AMOUNT, LARGEST_AMOUNT
    tier = scenario.design.tier
    low, high = SINGLE_FLOOR * SMALLEST_GAP[tier], LARGEST_GAP[tier]
    reality = scale_to(scenario, at, amounts, low, high, place)
    return None if reality is None else (reality, sentence)


def _several(
    rng: np.random.Generator, scenario: Scenario, kinds: Kinds, place: float
) -> tuple[Reality, str] | None:
    """Draw effects that all matter: none vanishes on its own nor beside the others."""
    others = [place + rng.uniform(-PAIR_SPREAD, PAIR_SPREAD) for _ in kinds[1:]]
    places = (place, *(float(np.clip(other, 0.0, 1.0)) for other in others))
    singles = []
    for kind, each in zip(kinds, places, strict=True):
        single = _effect(rng, scenario, kind, PAIR_FLOOR, PAIR_SPAN * each)
        if single is None:
            return None
        singles.append(single)
    mechanisms = tuple(single.mechanisms[0] for single in singles)
    both = scenario.reality.with_mechanisms(*mechanisms)
    gap = rms(scenario.gap(scenario.in_field(both)))
    if gap < SMALLEST_GAP[scenario.design.tier] or min(_beside(scenario, both)) < OWN_GAP:
        return None
    return both, "; ".join(mechanism.sentence for mechanism in mechanisms)


def _beside(scenario: Scenario, reality: Reality) -> list[float]:
    """Rms of what goes from the gap without each mechanism, in noise sd."""
    got, all_of_them = scenario.in_field(reality), reality.mechanisms
    return [
        rms(
            scenario.gap(
                got,
                scenario.in_field(
                    scenario.reality.with_mechanisms(*(m for m in all_of_them if m is not gone))
                ),
            )
        )
        for gone in all_of_them
    ]


def _reality(
    rng: np.random.Generator, scenario: Scenario, truth: str, kinds: Kinds
) -> tuple[Reality, str] | None:
    """Draw what the field really is."""
    place = float(rng.uniform())
    if truth == NONE:
        return scenario.reality, "nothing acts in the field that did not act in the lab"
    if truth == SHIFT:
        return _shift(rng, scenario, place)
    if len(kinds) > 1:
        return _several(rng, scenario, kinds, place)
    floor = SINGLE_FLOOR * SMALLEST_GAP[scenario.design.tier]
    reality = _effect(rng, scenario, kinds[0], floor, place)
    return None if reality is None else (reality, reality.mechanisms[0].sentence)


def _recalibration_closes(scenario: Scenario, field: Readings, test: Readings) -> bool:
    """Whether the same models with other parameters describe field and test."""
    noise = scenario.design.noise
    test_sd = {name: noise.sd(name, value, scenario.test.slip) for name, value in test.items()}
    refit = recalibrate(scenario.simulator, scenario.field, field, scenario.field_sd)
    return (
        misfit(refit, scenario.field, field, scenario.field_sd) < LACK_OF_FIT
        and misfit(refit, scenario.test, test, test_sd) < 2.0 * LACK_OF_FIT
    )


def _telling(
    rng: np.random.Generator, scenario: Scenario, gap: Array, truth: str, kinds: Kinds
) -> Identifiability | None:
    """Return what the gap tells; None where it tells less than the tier promises.

    In the easy tier a listed effect has to beat recalibration and its nearest rival by some
    nats; in the hard tier this is only recorded. What is not listed has to be told from
    recalibration and from every listed effect in both.
    """
    tier, named = scenario.design.tier, truth not in (NONE, SHIFT, UNKNOWN)
    if truth == NONE:
        return Identifiability(0.0, "", 0.0)
    absorbable = any(kind.name in ABSORBABLE for kind in kinds)
    needed = ABSORBABLE_NATS if absorbable else ISOLABLE_NATS
    if tier == "easy" and named and isolable_nats(scenario, gap) < needed:
        return None
    told = identify(rng, scenario, gap, truth)
    if tier == "easy" and named and told.rival_nats < RIVAL_NATS:
        return None
    return None if truth == UNKNOWN and told.rival_nats < UNLISTED_NATS[tier] else told


def unlisted_order(rng: np.random.Generator) -> list[EffectKind]:
    """Return the unlisted mechanisms in random order, those of wheels mostly first.

    A density gauge is one instrument among many: its oddities are the rarer ones.
    """
    weights = np.array([DENSITY_ODDITY if k.outputs == (DENSITY,) else 1.0 for k in UNLISTED])
    order = rng.choice(len(UNLISTED), len(UNLISTED), replace=False, p=weights / weights.sum())
    return [UNLISTED[int(i)] for i in order]


def _kinds(rng: np.random.Generator, truth: str) -> Kinds:
    if truth == UNKNOWN:
        return (unlisted_order(rng)[0],)
    return () if truth in (NONE, SHIFT) else tuple(kind_of(name) for name in truth.split("+"))


def try_case(
    rng: np.random.Generator, tier: Tier, truth: str, unlisted: EffectKind | None = None
) -> DrawnCase | None:
    """Draw a case once.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    tier : str
        ``easy``, ``hard`` or ``large``.
    truth : str
        ``none``, ``unknown``, ``parameter_shift``, a listed effect or several joined by ``+``.
    unlisted : EffectKind, optional
        Which unlisted mechanism acts where the truth is ``unknown``; any by default.

    Returns
    -------
    DrawnCase or None
        None where the draw is not fair or cannot show its truth.

    Raises
    ------
    CalibError
        If the truth has no such name.
    """
    kinds = (unlisted,) if truth == UNKNOWN and unlisted else _kinds(rng, truth)
    scenario = draw_scenario(rng, tier, needs_of(kinds))
    made = None if scenario is None else _reality(rng, scenario, truth, kinds)
    if scenario is None or made is None:
        return None
    reality, sentence = made
    field, test = scenario.in_field(reality), scenario.on_test(reality)
    gap = scenario.gap(field)
    if not all(np.isfinite(part).all() for part in (*field.values(), *test.values())):
        return None
    if truth == SHIFT and not _recalibration_closes(scenario, field, test):
        return None
    told = _telling(rng, scenario, gap, truth, kinds)
    if told is None:
        return None
    named = [kind.name for kind in kinds] if truth != UNKNOWN else []
    each = _beside(scenario, reality) if named else []
    contributions = dict(zip(named, each, strict=True))
    return DrawnCase(scenario, truth, sentence, field, test, rms(gap), told, contributions)
