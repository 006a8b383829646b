"""How much a drawn gap tells: what recalibration leaves of it, and its nearest wrong answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from challenge.effects import LISTED, acts_on
from challenge.mechanism import RUT, SHIFT, EffectKind
from challenge.scenario import Scenario, rms
from challenge.surrogate import full_jacobian, recalibration_span

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class Identifiability:
    """What a gap allows to tell; gaps are rms in noise sd, nats are expected log-likelihoods.

    Attributes
    ----------
    isolable_nats : float
        Cost of explaining the gap by a recalibration of plausible size.
    rival : str
        The wrong single answer that comes nearest, ``parameter_shift`` among them; empty where
        there is none.
    rival_nats : float
        What the truth is ahead of that rival, the lab's parameter uncertainty allowed for;
        infinite without a rival.
    """

    isolable_nats: float
    rival: str
    rival_nats: float


def whitener(span: Array) -> Array:
    """Return the inverse covariance of unit noise plus unit-normal amounts of `span`, (M, M)."""
    return np.asarray(np.linalg.inv(np.eye(span.shape[1]) + span.T @ span), dtype=np.float64)


def lab_uncertainty(scenario: Scenario) -> Array:
    """Return what one sd of the lab's posterior does to the field, shape ``(K, M)``."""
    lab = full_jacobian(scenario.simulator, scenario.lab, scenario.lab_sd)
    field = full_jacobian(scenario.simulator, scenario.field, scenario.field_sd)
    values, vectors = np.linalg.eigh(lab @ lab.T)
    keep = values > 1e-10 * values[-1]
    return np.asarray((vectors[:, keep] / np.sqrt(values[keep])).T @ field, dtype=np.float64)


def _signature(
    rng: np.random.Generator, scenario: Scenario, kind: EffectKind, size: float
) -> Array:
    """Return an effect's gap in the scenario's field at about a size, shape ``(M,)``."""
    family = kind.draw(rng)
    strength, signature = float(np.sqrt(family.low * family.high)), np.zeros(1)
    for _ in range(2):
        trial = scenario.reality.with_mechanisms(family.at(strength))
        signature = scenario.gap(scenario.in_field(trial))
        grown = strength * size / max(rms(signature), 1e-6)
        strength = float(np.clip(grown, family.low, family.high))
    return signature


def can_rival(scenario: Scenario, kind: EffectKind, truth: str) -> bool:
    """Whether a listed effect could be taken for the truth in this scenario."""
    has_already = kind.name == "slip_sinkage" and scenario.design.models.get(RUT) != "bekker"
    able = acts_on(kind, scenario.design.outputs, scenario.design.varying)
    return able and not has_already and kind.name not in truth.split("+")


def identify(
    rng: np.random.Generator, scenario: Scenario, gap: Array, truth: str
) -> Identifiability:
    """Return what a gap allows to tell in a scenario.

    Every listed effect's signature is taken at about the gap's size in one of its variants and
    scaled freely; so the figures are close bounds, not exact ones.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness, for the rivals' variants.
    scenario : Scenario
        Design and undisturbed reality.
    gap : array
        In noise sd, shape ``(n_outputs * N,)``.
    truth : str
        The true hypothesis, which is no rival of itself.
    """
    span = recalibration_span(scenario.simulator, scenario.field, scenario.field_sd)
    isolable_nats = float(0.5 * gap @ whitener(span) @ gap)
    white = whitener(lab_uncertainty(scenario))
    rival, nats = ("", np.inf) if truth == SHIFT else (SHIFT, isolable_nats)
    for name, kind in LISTED.items():
        if not can_rival(scenario, kind, truth):
            continue
        signature = _signature(rng, scenario, kind, rms(gap))
        along, own = float(gap @ white @ signature), float(signature @ white @ signature)
        left = float(0.5 * (gap @ white @ gap)) - 0.5 * along**2 / max(own, 1e-12)
        rival, nats = (name, left) if left < nats else (rival, nats)
    return Identifiability(isolable_nats, rival, nats)


def isolable_nats(scenario: Scenario, gap: Array) -> float:
    """Return the cost of explaining a gap by a recalibration of plausible size, in nats."""
    span = recalibration_span(scenario.simulator, scenario.field, scenario.field_sd)
    return float(0.5 * gap @ whitener(span) @ gap)
