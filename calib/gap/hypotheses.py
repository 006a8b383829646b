"""Which hypotheses a case is tested against, and how probable each is before the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from calib.gap.case import Campaigns
from calib.gap.effects import EFFECTS, Effect
from calib.gap.forward import Hypothesis
from calib.prior_files import default_prior_path, read_priors
from calib.priors import Priors

__all__ = [
    "LN_PAIR_TO_SINGLE",
    "LN_PRIOR",
    "effect_priors",
    "pair",
    "singles",
    "split_testable",
    "unknowns",
]

# Prior probabilities of the kinds; singles share theirs equally, and a given pair is a twentieth
# as probable as a given single effect.
PRIOR = {"none": 0.40, "unknown": 0.10, "parameter_shift": 0.10, "single": 0.40}
LN_PAIR_TO_SINGLE = float(np.log(0.05))
LN_PRIOR: Mapping[str, float] = {k: float(np.log(v)) for k, v in PRIOR.items()}
SHIFTS = (0.1, 0.25, 0.6)
SMOOTHS = (1.5, 5.0)


def split_testable(
    data: Campaigns, effects: Mapping[str, Effect] = EFFECTS
) -> tuple[dict[str, Effect], dict[str, str]]:
    """Split the effects into those the data can show and those they cannot, with the reason."""
    able, unable = {}, {}
    for name, effect in effects.items():
        reason = effect.not_testable(data.view, data.names)
        if reason is None:
            able[name] = effect
        else:
            unable[name] = reason
    return able, unable


def effect_priors(data: Campaigns, effect: Effect) -> Priors:
    """Read an effect's priors, forces relative to the case's load."""
    path = effect.prior_file or default_prior_path(f"effects/{effect.name}")
    loads = {"normal_load_kn": data.view.load_kn}
    return read_priors(path, effect.name, effect.parameters, loads)


def singles(data: Campaigns, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """One hypothesis for each effect."""
    return [Hypothesis(name, (e,), (effect_priors(data, e),)) for name, e in effects.items()]


def unknowns(data: Campaigns) -> list[Hypothesis]:
    """Free smooth discrepancies: of one output or all, over slip or everything, small or large."""
    names = data.names
    touched = [(name,) for name in names] + ([names] if len(names) > 1 else [])
    overs: tuple[Literal["slip", "level", "all"], ...] = ("slip", "level", "all")
    if "slip_ratio" not in data.view.conditions:
        overs = ("level", "all")
    return [
        Hypothesis("unknown", smooth=size, smooth_outputs=outputs, smooth_over=over)
        for outputs in touched
        for over in overs
        for size in SMOOTHS
        # The level is that of one output.
        if over != "level" or len(outputs) == 1
    ]


def pair(a: Hypothesis, b: Hypothesis) -> Hypothesis:
    """Two effects at once, named in alphabetical order."""
    first, second = sorted((a, b), key=lambda h: h.name)
    return Hypothesis(
        f"{first.name}+{second.name}",
        first.effects + second.effects,
        first.effect_priors + second.effect_priors,
    )


def pairs_of(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """All pairs of different effects."""
    return [pair(a, b) for i, a in enumerate(hypotheses) for b in hypotheses[i + 1 :]]
