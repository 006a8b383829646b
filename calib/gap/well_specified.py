"""Well-specified cases: readings drawn from the diagnosis's own formulas and priors.

Such a case has the design of another one, its kind of truth and its size of gap; only its readings
are drawn as the diagnosis believes that effects act. What the diagnosis still gets wrong there no
better formula would mend: it is what the design cannot show. What it gets right there and wrong on
the other case is what its formulas lack of the reality behind that one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.files import read_text
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import read_case
from calib.gap.constants import MIN_EFFECT_SIZE_IN_PAIR
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, joined, shifts, singles, split_testable, unknowns
from calib.gap.noise import Noise, noise_conditions
from calib.gap.odds import sizes
from calib.gap.ranking import calibrate_lab
from calib.inference.random import generator
from calib.models.base import Array

# The gap that is drawn is the one asked for within this ratio.
SIZE_RATIO = 1.25


def well_specified_case(
    seed: int, folder: Path, truth: str, gap_over_noise: float
) -> tuple[dict[str, str], dict[str, Any]]:
    """Return a case with the design of another one and readings as the diagnosis believes.

    Parameters
    ----------
    folder : Path
        The other case, with a ``fresh.csv``; its name is part of the seed.
    truth : str
        What happens in the field: a contract name, sets of effects in alphabetical order.
    gap_over_noise : float
        The size wanted, rms in noise sds; met within a ratio of 1.25.

    Returns
    -------
    files : dict of str to str
        Name to text.
    key : dict
        Noise-free values with and without what happens, noise, sizes and hypothesis.

    Raises
    ------
    CalibError
        If the diagnosis does not test this truth on this design, or no draw has the size.
    """
    case = read_case(folder)
    if case.new_conditions is None:
        raise CalibError("there is no fresh.csv", where=str(folder))
    data = campaigns(case)
    lab_mode, noise = calibrate_lab(data, seed)
    # The label is that of the first such cases: the same seed gives the same readings as then.
    rng = generator(seed, "twin", folder.name)
    draw = draw_from_hypothesis(data, lab_mode, noise, truth, gap_over_noise, rng)
    forward, psi, view, new = draw.forward, draw.psi, data.view, data.at(case.new_conditions)
    lab, in_field = forward.lab(psi), forward.field(psi, view)
    said = {
        "field_truth": in_field,
        "field_without": forward.simulator(psi, view),
        "fresh_truth": forward.field(psi, new),
        "fresh_without": forward.simulator(psi, new),
    }
    key: dict[str, Any] = {
        "gap_over_noise": draw.gap_over_noise,
        "mechanism": f"as the diagnosis believes: {forward.hypothesis.name}",
        "contributions": {
            effect.name: float(_gap(forward, psi, noise, effect.name)[0])
            for effect in forward.hypothesis.effects
        },
        "noise_sd": {},
    }
    lab_readings, field_readings = {}, {}
    for o in data.outputs:
        back, sd_of = o.problem.bound.from_response, noise[o.name].sd
        for name, values in said.items():
            key.setdefault(name, {})[o.name] = back(values[o.name][0]).tolist()
        sd = np.broadcast_to(sd_of(noise_conditions(view)), in_field[o.name][0].shape)
        # On a logarithm the noise is relative; the key states it in the output's own unit.
        log = o.problem.bound.model.response == "log"
        unit = back(in_field[o.name][0]) if log else np.ones_like(sd)
        key["noise_sd"][o.name] = (sd * unit).tolist()
        lab_sd = np.broadcast_to(sd_of(data.lab_at[o.name]), lab[o.name][0].shape)
        lab_readings[o.name] = back(lab[o.name][0] + lab_sd * rng.standard_normal(lab_sd.size))
        field_readings[o.name] = back(in_field[o.name][0] + sd * rng.standard_normal(sd.size))
    files = {
        "case.toml": read_text(folder / "case.toml"),
        "lab.csv": _table(case.lab, lab_readings),
        "field.csv": _table(case.field, field_readings),
        "fresh.csv": _table(case.new_conditions, {}),
    }
    return files, key


def _table(table: Table, outputs: dict[str, Array]) -> str:
    """The table as it was written, with other readings."""
    cells = dict(zip(table.header, zip(*table.text, strict=True), strict=True))
    for name, values in outputs.items():
        cells[OUTPUTS[name]] = tuple(f"{value:.6g}" for value in values)
    rows = zip(*cells.values(), strict=True)
    return "\n".join(",".join(row) for row in (tuple(cells), *rows)) + "\n"


@dataclass(frozen=True)
class Draw:
    """A hypothesis and one value of its parameters.

    Parameters
    ----------
    psi : ndarray, shape (1, d)
    gap_over_noise : float
        Rms over field rows and outputs, in noise sds.
    """

    forward: Forward
    psi: Array
    gap_over_noise: float


def draw_from_hypothesis(
    data: Campaigns,
    lab_mode: Mapping[str, Array],
    noise: Mapping[str, Noise],
    truth: str,
    gap_over_noise: float,
    rng: np.random.Generator,
) -> Draw:
    """Draw what happens in the field from the prior of a kind of truth."""
    scale = {o: n.sigma for o, n in noise.items()}
    for _ in range(40):
        forward = Forward(data, _hypothesis(data, truth, rng), scale, lab_mode)
        psi = forward.priors.sample(rng, 1 if truth == "none" else 4000)
        for o in data.outputs:
            psi[:, forward.theta_slices[o.name]] = lab_mode[o.name]
        if truth == "none":
            return Draw(forward, psi, 0.0)
        size = _gap(forward, psi, noise)
        fits = (size < gap_over_noise * SIZE_RATIO) & (size > gap_over_noise / SIZE_RATIO)
        if "+" in truth:
            fits &= (sizes(forward, noise, psi) >= MIN_EFFECT_SIZE_IN_PAIR).all(axis=1)
        if fits.any():
            first = int(np.argmax(fits))
            return Draw(forward, psi[[first]], float(size[first]))
    raise CalibError(
        f"no {truth} of {gap_over_noise:.1f} noise sds in 160000 draws of its prior",
        hint="leave this case out",
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
    return joined(*(known[name] for name in names))


def _gap(
    forward: Forward, psi: Array, noise: Mapping[str, Noise], cause: str = ""
) -> NDArray[np.float64]:
    """Size of what happens in the field, or of what goes with one of its causes, shape (k,)."""
    view = forward.data.view
    with np.errstate(all="ignore"):
        full = forward.field(psi, view)
        rest = forward.without(psi, view, cause) if cause else forward.simulator(psi, view)
    each = forward.data.in_noise({name: full[name] - rest[name] for name in full}, noise)
    # Where the model has no value somewhere, it is NaN, which is of no size.
    return np.sqrt(np.square(np.hstack([*each.values()])).mean(axis=1))
