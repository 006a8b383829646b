"""What happens in the field of a twin: one draw from a hypothesis, of the size that was asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.gap.case import Campaigns
from calib.gap.forward import Forward
from calib.gap.hypotheses import pair, shifts, singles, split_testable, unknowns
from calib.gap.hypothesis import Hypothesis
from calib.gap.noise import Noise, noise_at
from calib.gap.relevance import RELEVANT_IN_PAIR, sizes
from calib.models.base import Array

__all__ = ["Twin", "draw_twin"]

# The gap of a twin is that of its case within this ratio.
SIZE_RATIO = 1.25
_DRAWS, _TRIES = 4000, 40


@dataclass(frozen=True)
class Twin:
    """A hypothesis and one value of its parameters.

    Parameters
    ----------
    forward : Forward
    psi : ndarray, shape (1, d)
    gap_over_noise : float
        Rms over field rows and outputs, in noise sds.
    """

    forward: Forward
    psi: Array
    gap_over_noise: float


def draw_twin(
    data: Campaigns,
    lab_mode: Mapping[str, Array],
    noise: Mapping[str, Noise],
    truth: str,
    gap_over_noise: float,
    rng: np.random.Generator,
) -> Twin:
    """Draw what happens in a twin's field from the prior of a kind of truth.

    Parameters
    ----------
    data : Campaigns
        The design, and the simulators at their lab calibration.
    lab_mode : mapping of str to ndarray
        Internal parameters of each simulator.
    noise : mapping of str to Noise
        Of each output, on the scale of the response.
    truth : str
        Contract name; pairs in alphabetical order.
    gap_over_noise : float
        The size wanted, rms in noise sds; met within a ratio of 1.25.
    rng : Generator

    Raises
    ------
    CalibError
        If the diagnosis does not test this truth on this design, or no draw has the size.
    """
    scale = {o: n.sigma for o, n in noise.items()}
    for _ in range(_TRIES):
        forward = Forward(data, _hypothesis(data, truth, rng), scale, lab_mode)
        psi = forward.priors.sample(rng, 1 if truth == "none" else _DRAWS)
        for o in data.outputs:
            psi[:, forward.theta_slices[o.name]] = lab_mode[o.name]
        if truth == "none":
            return Twin(forward, psi, 0.0)
        size = _gap(forward, psi, noise)
        fits = (size < gap_over_noise * SIZE_RATIO) & (size > gap_over_noise / SIZE_RATIO)
        if "+" in truth:
            fits &= (sizes(forward, noise, psi) >= RELEVANT_IN_PAIR).all(axis=1)
        if fits.any():
            first = int(np.argmax(fits))
            return Twin(forward, psi[[first]], float(size[first]))
    raise CalibError(
        f"no {truth} of {gap_over_noise:.1f} noise sds in {_DRAWS * _TRIES} draws of its prior",
        mend="leave this case out",
    )


def _hypothesis(data: Campaigns, truth: str, rng: np.random.Generator) -> Hypothesis:
    if truth == "none":
        return Hypothesis("none")
    if truth in ("parameter_shift", "unknown"):
        variants = shifts(data) if truth == "parameter_shift" else unknowns(data)
        share = np.array([h.share for h in variants])
        return variants[int(rng.choice(share.size, p=share / share.sum()))]
    able, unable = split_testable(data)
    known = {h.name: h for h in singles(data, able)}
    names = truth.split("+")
    for name in names:
        if name not in known:
            reason = unable.get(name, "no such effect")
            raise CalibError(f"{name} is not tested on this design: {reason}")
    return known[truth] if len(names) == 1 else pair(known[names[0]], known[names[1]])


def _gap(forward: Forward, psi: Array, noise: Mapping[str, Noise]) -> NDArray[np.float64]:
    data = forward.data
    at = noise_at(data.view)
    with np.errstate(all="ignore"):
        full, plain = forward.field(psi, data.view), forward.simulator(psi, data.view)
    each = [
        ((full[o.name] - plain[o.name])[:, o.rows] / noise[o.name].sd(at.rows(o.rows))) ** 2
        for o in data.outputs
    ]
    # Where the model has no value somewhere, it is NaN, which is of no size.
    return np.sqrt(np.concatenate(each, axis=1).mean(axis=1))
