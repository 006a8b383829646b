"""Simulators of a tyre on a hard belt: the Magic Formula with a load, and without one.

Models of one's own, as `calib --models FILE` takes them. The pull of a driven and braked wheel over
its slip, or the side force of a rolling one over its slip angle x, each under the load W, is

    Y = W Sv + D sin{C arctan[B X - E (B X - arctan B X)]},    X = x - Sh,
    D = mu W (W/W0)^-a,    B C D = k W (W/W0)^-b,
    1 - E = G (W/W0)^-c exp(d sgn X),    W0 = 2 kN

after Pacejka (2012), Tire and Vehicle Dynamics, section 4.3: a tyre's friction and its stiffness
over the load fall as the load grows, and the curve may bend more on one side than on the other. The
simulator without a load has W = W0 throughout.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.data.quantities import Quantity
from calib.data.registry import register
from calib.models.base import Array, Conditions, Model
from calib.models.magic_formula import sine_of

USUAL_LOAD_KN = 2.0

QUANTITIES = (
    Quantity(
        stem="lateral_force",
        canonical="lateral_force_kn",
        kind="force",
        unit="kN",
        role="output",
        description="force of the ground on the tyre, across the wheel's plane",
    ),
)


def _curve(x: Array, load: Array | float, p: dict[str, Array]) -> Array:
    relative = load / USUAL_LOAD_KN
    peak = p["mu"] * load * relative ** -p.get("mu_falls", 0.0)
    slope = p["k"] * load * relative ** -p.get("k_falls", 0.0)
    shifted = x - p["Sh"]
    bend = p["G"] * relative ** -p.get("G_falls", 0.0) * np.exp(p["G_sides"] * np.sign(shifted))
    shape = sine_of(slope / (p["C"] * peak) * shifted, p["C"], bend)
    return np.asarray(peak * shape + p["Sv"] * load)


def _prediction(
    parameters: tuple[str, ...], column: str, scale: float
) -> Callable[[Array, Conditions], Array]:
    def predict(theta: Array, conditions: Conditions) -> Array:
        """Return the force (kN), shape (k, n)."""
        p = dict(zip(parameters, theta.T[:, :, None], strict=True))
        load = conditions.get("normal_load_kn", USUAL_LOAD_KN)
        return _curve(scale * conditions[column], load, p)

    return predict


_SOURCE = "Pacejka (2012), Tire and Vehicle Dynamics, chapters 1 and 4"


def _prior(name: str, dist: str, unit: str, reason: str) -> str:
    told = f'unit = "{unit}"\nreason = "{reason}"\nsource = "{_SOURCE}"\n'
    return f"\n[parameters.{name}]\n{dist}\n{told}"


def _priors(model: str, parameters: tuple[str, ...], unit: str, stiffness: float) -> str:
    known = {
        "mu": ('dist = "lognormal"\nmedian = 1.3\nsd_log = 0.3', "1",
               "Peak force over load of dry tyres: 0.8 of a car's to 2 of a racing tyre's"),
        "mu_falls": ('dist = "normal"\nmean = 0.1\nsd = 0.1', "1",
                     "Friction of rubber falls slowly with the load"),
        "k": (f'dist = "lognormal"\nmedian = {stiffness}\nsd_log = 0.5', f"1/{unit}",
              "Slip stiffness over load: 10 to 40 for each unit of slip, 0.1 to 0.4 a degree"),
        "k_falls": ('dist = "normal"\nmean = 0.2\nsd = 0.2', "1",
                    "Stiffness grows less than in proportion to the load"),
        "C": ('dist = "normal"\nmean = 1.5\nsd = 0.2\nlower = 1.0\nupper = 2.0', "1",
              "1.3 of side forces to 1.65 of longitudinal ones"),
        "G": ('dist = "lognormal"\nmedian = 1.5\nsd_log = 1.0', "1",
              "G = 1 - E > 0 keeps the curve single-peaked; E from 1 to -10"),
        "G_falls": ('dist = "normal"\nmean = 0.0\nsd = 1.0', "1",
                    "The curvature changes with the load, either way"),
        "G_sides": ('dist = "normal"\nmean = 0.0\nsd = 1.0', "1",
                    "Driven and braked, left and right may bend differently"),
        "Sh": ('dist = "normal"\nmean = 0.0\nsd = 1.0', unit,
               "Ply steer, conicity, lag and zeros of the rig: tenths of it"),
        "Sv": ('dist = "normal"\nmean = 0.0\nsd = 0.1', "1",
               "Ply steer and conicity, or the rolling resistance: up to a tenth of the load"),
        "sigma": ('dist = "lognormal"\nmedian = 0.05\nsd_log = 1.0', "kN",
                  "Ripple of a tyre in each of its revolutions: some hundredths of the load"),
    }  # fmt: skip
    return f'model = "{model}"\n' + "".join(_prior(p, *known[p]) for p in (*parameters, "sigma"))


def _model(name: str, title: str, output: str, column: str, *, with_load: bool = True) -> Model:
    falls = ("mu_falls", "k_falls", "G_falls") if with_load else ()
    parameters = ("mu", "k", *falls, "C", "G", "G_sides", "Sh", "Sv")
    unit, scale, stiffness = ("%", 100.0, 0.2) if column == "slip_ratio" else ("deg", 1.0, 0.25)
    predict = _prediction(parameters, column, scale)
    columns = (column, "normal_load_kn") if with_load else (column,)
    truth = {"mu": 1.4, "k": 0.25, "mu_falls": 0.1, "k_falls": 0.2, "C": 1.4, "G": 2.0}
    theta = np.array([[truth.get(p, 0.0) for p in parameters]])
    x = np.tile(np.array([-9.0, -6.0, -4.0, -2.5, -1.0, 0.0, 1.0, 2.5, 4.0, 6.0, 9.0]) / scale, 2)
    load = np.repeat([1.5, 2.5], x.size // 2)
    force = predict(theta, {column: x, **({"normal_load_kn": load} if with_load else {})})[0]
    force = force + 0.05 * np.random.default_rng(1).standard_normal(x.size)
    cells = zip(x, load, force, strict=True)
    rows = [f"{s:g},{w:g},{f:.3f}" if with_load else f"{s:g},{f:.3f}" for s, w, f in cells]
    return Model(
        name=name, title=title, output=output, conditions=columns, parameters=parameters,
        predict=predict,
        latex=(
            r"$Y = W S_\mathrm{v} + D \sin\{C \arctan[B X - E (B X - \arctan B X)]\}$",
            r"$D = \mu W (W/W_0)^{-a}$, $B C D = k W (W/W_0)^{-b}$",
            r"$E = 1 - G (W/W_0)^{-c} \exp(d\, \mathrm{sgn} X)$",
        ),
        letters="[$Y] the force (kN), [$X] the slip (%) or slip angle (deg) beyond Sh, "
        "[$W] the load (kN), [$W_0] 2 kN",
        source="after Pacejka (2012), section 4.3",
        example="\n".join([",".join((*columns, output)), *rows]) + "\n",
        priors=_priors(name, parameters, unit, stiffness),
    )  # fmt: skip


PULL, SIDE = "Pull of a tyre on a belt", "Side force of a tyre on a belt"
MODELS = (
    _model("belt_traction", PULL, "drawbar_pull_kn", "slip_ratio"),
    _model("belt_cornering", SIDE, "lateral_force_kn", "steering_angle_deg"),
    _model("belt_cornering_one_load", f"{SIDE}, at one load", "lateral_force_kn",
           "steering_angle_deg", with_load=False),
)  # fmt: skip

register(*QUANTITIES, *MODELS)
