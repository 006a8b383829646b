"""Campaign designs: how lab and field were run, in the many ways that engineers run them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from challenge.mechanism import DENSITY, DRAWBAR, RUT
from challenge.tyre import PSI_KPA

type Array = NDArray[np.float64]

Tier = Literal["easy", "hard", "large"]
TIERS: tuple[Tier, ...] = ("easy", "hard", "large")

PAPER_SLIPS = (0.0, 2.5, 5.0, 7.5, 10.0, 12.5, 15.0, 17.5, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0)
PAPER_KPA = tuple(round(psi * PSI_KPA, 3) for psi in (18.0, 30.0, 42.0))
NOISES = ("normal", "heavy", "rounded", "autocorrelated")
_EASY_ROWS = 36
_HARD_ROWS = (14, 16, 20, 24, 28, 32, 36)


@dataclass(frozen=True)
class Needs:
    """What the effects of a case ask of its design.

    Attributes
    ----------
    outputs : tuple of tuple of str
        For each effect the outputs of which one has to be present.
    varies : tuple of str
        Conditions that have to be recorded and vary in the field.
    rut_model : str, optional
        The rut model it takes, if it takes a particular one.
    """

    outputs: tuple[tuple[str, ...], ...] = ()
    varies: tuple[str, ...] = ()
    rut_model: str | None = None

    def met_by(self, outputs: tuple[str, ...]) -> bool:
        """Whether a set of outputs shows every effect."""
        return all(set(wanted) & set(outputs) for wanted in self.outputs)


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the readings at zero slip and their growth with slip.

    Attributes
    ----------
    drawbar_kn, rut_fraction, density_g_cm3 : float
        Drawbar pull and density absolute, rut depth as a fraction of itself.
    growth : float
        Relative growth of the wheel's readings per unit of slip.
    kind : {"normal", "heavy", "rounded", "autocorrelated"}
        Of its law: normal; Student's t with four degrees of freedom, of the same sd; normal and
        rounded to two sds; or with a correlation of 0.5 between successive runs.
    """

    drawbar_kn: float
    rut_fraction: float
    density_g_cm3: float
    growth: float
    kind: str = "normal"

    def draw(self, rng: np.random.Generator, sd: Array) -> Array:
        """Draw the noise of successive readings, shape ``(N,)``."""
        if self.kind == "heavy":
            return np.asarray(sd * rng.standard_t(4.0, sd.size) / np.sqrt(2.0))
        z = rng.standard_normal(sd.size)
        if self.kind == "autocorrelated":
            for i in range(1, sd.size):
                z[i] = 0.5 * z[i - 1] + np.sqrt(0.75) * z[i]
        return np.asarray(sd * z)

    def step(self, sd: Array) -> float:
        """Return what readings are rounded to; zero where that is finer than the noise."""
        return 2.0 * float(np.median(sd)) if self.kind == "rounded" else 0.0

    def sd(self, output: str, reading: Array, slip: Array) -> Array:
        """Return the noise sd per row, shape ``(N,)``, for noise-free readings ``(N,)``."""
        grown = 1.0 + self.growth * np.clip(slip, 0.0, 1.0)
        if output == DRAWBAR:
            return np.asarray(self.drawbar_kn * grown, dtype=np.float64)
        if output == RUT:
            return np.asarray(self.rut_fraction * np.abs(reading) * grown, dtype=np.float64)
        return np.full(reading.shape, self.density_g_cm3)


@dataclass(frozen=True)
class Design:
    """One campaign pair.

    Attributes
    ----------
    tier : str
        ``easy``, ``hard`` or ``large``.
    models : dict
        Output to the model that was calibrated, in the order of the case file.
    inflation_kpa, lab_slips : tuple of float
        Levels in the lab.
    lab_rows : int
        Rows in the lab, of which a wheel's campaign runs every level.
    field_rows, test_rows : int
        Rows of the field and of the conditions to predict.
    columns : tuple of str
        Names of `Conditions` that are recorded.
    varying : tuple of str
        Those that vary in the field.
    ground_pressure : bool
        Whether the average ground pressure is recorded.
    psi : bool
        Whether the inflation pressure is recorded in psi.
    wobble : float
        Scatter of the lab's constant conditions, relative.
    load_span : float
        Relative range of the normal load.
    levels : bool
        Whether field slips and speeds come in levels.
    coupling : dict
        Rank correlation with slip, by condition.
    noise : Noise
        The instruments.
    """

    tier: Tier
    models: dict[str, str]
    inflation_kpa: tuple[float, ...]
    lab_slips: tuple[float, ...]
    lab_rows: int
    field_rows: int
    test_rows: int
    columns: tuple[str, ...]
    varying: tuple[str, ...]
    ground_pressure: bool
    psi: bool
    wobble: float
    load_span: float
    levels: bool
    coupling: dict[str, float]
    noise: Noise

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs that are measured."""
        return tuple(self.models)


def _draw_outputs(rng: np.random.Generator, needs: Needs) -> tuple[str, ...]:
    """Draw what is measured."""
    wheels = ((DRAWBAR, RUT), (DRAWBAR,), (RUT,))
    options = (*wheels, (DENSITY,), (DRAWBAR, RUT, DENSITY))
    weights = np.array([0.62, 0.18, 0.11, 0.065, 0.025])
    able = np.array([needs.met_by(option) for option in options])
    if "water_content" in needs.varies and needs.met_by((DRAWBAR, RUT)):
        # Density needs water that varies in the lab, where nothing may soften yet.
        able[-1] = False
    # Density is there for the effects that need it; elsewhere it stays the rare case.
    chosen = rng.choice(len(options), p=weights * able / np.sum(weights * able))
    return options[int(chosen)]


def _draw_models(
    rng: np.random.Generator, outputs: tuple[str, ...], needs: Needs
) -> dict[str, str]:
    """Draw the model of every output."""
    rut = needs.rut_model or ("modified_bekker" if rng.random() < 0.84 else "bekker")
    single = outputs == (DRAWBAR,) and "inflation_kpa" not in needs.varies and rng.random() < 0.25
    drawbar = "magic_formula" if single else "magic_formula_pressure"
    named = {DRAWBAR: drawbar, RUT: rut, DENSITY: "ayers_perumpral"}
    return {output: named[output] for output in outputs}


def _draw_pressures(rng: np.random.Generator, models: dict[str, str]) -> tuple[float, ...]:
    if models.get(DRAWBAR) == "magic_formula":
        return (float(np.round(rng.choice(PAPER_KPA), 3)),)
    if rng.random() < 0.65:
        return PAPER_KPA
    count = int(rng.integers(3, 6))
    even = np.linspace(rng.uniform(110.0, 140.0), rng.uniform(250.0, 320.0), count)
    return tuple(float(x) for x in np.round(even, 1))


def _draw_slips(rng: np.random.Generator, pressures: int) -> tuple[float, ...]:
    if rng.random() < 0.6:
        return tuple(slip / 100.0 for slip in PAPER_SLIPS)
    count = int(rng.integers(14, 19)) if pressures == 1 else int(rng.integers(8, 13))
    top = float(rng.choice([0.6, 0.7]))
    return tuple(float(x) for x in np.round(top * np.linspace(0.0, 1.0, count) ** 1.6, 3))


_COVARIATES = ("run_order", "speed_m_s", "pass_number", "water_content")


def _draw_columns(
    rng: np.random.Generator, outputs: tuple[str, ...], needs: Needs, pressures: int
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Draw which conditions are recorded and which of them vary."""
    if outputs == (DENSITY,):
        both = ("run_order", "water_content", "cone_index_kpa")
        return both, both
    full = rng.random() < 0.6
    present, varying = ["slip", "inflation_kpa"], ["slip"]
    varying += ["inflation_kpa"] if pressures > 1 else []
    for name in _COVARIATES:
        wanted = name in needs.varies or (name == "water_content" and DENSITY in outputs)
        if wanted or full or rng.random() < 0.65:
            present.append(name)
            if wanted or name == "run_order" or rng.random() < 0.92:
                varying.append(name)
    if full or rng.random() < 0.7:
        present.append("load_kn")
    if DENSITY in outputs:
        present.append("cone_index_kpa")
        varying.append("cone_index_kpa")
    return tuple(present), tuple(varying)


def _draw_coupling(rng: np.random.Generator, tier: Tier) -> dict[str, float]:
    if tier == "easy":
        return {}
    coupled = {}
    for name in ("speed_m_s", "pass_number", "water_content", "inflation_kpa"):
        limit = 0.5 if name == "inflation_kpa" else 0.9
        coupled[name] = float(rng.uniform(0.3, limit) * rng.choice([1.0, 1.0, -1.0]))
    if rng.random() < 0.3:
        coupled["run_order"] = float(rng.uniform(0.3, 0.8))
    return coupled


def _draw_noise(rng: np.random.Generator, tier: Tier) -> Noise:
    return Noise(
        drawbar_kn=float(rng.uniform(0.02, 0.045)),
        rut_fraction=float(rng.uniform(0.03, 0.055)),
        density_g_cm3=float(rng.uniform(0.008, 0.02)),
        growth=0.0 if tier == "easy" else float(rng.uniform(0.5, 3.0)),
        kind=str(rng.choice(NOISES)) if tier == "large" else "normal",
    )


def draw_design(rng: np.random.Generator, tier: Tier, needs: Needs) -> Design:
    """Draw a design on which the wanted effects can act.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    tier : str
        ``easy`` (36 field rows, independent covariates, even noise), ``hard`` (14-36 rows,
        covariates that move with slip, noise that grows with it) or ``large`` (as hard, and the
        noise need not be normal or independent).
    needs : Needs
        What the case's effects ask for.
    """
    outputs = _draw_outputs(rng, needs)
    models = _draw_models(rng, outputs, needs)
    pressures = _draw_pressures(rng, models)
    slips = _draw_slips(rng, len(pressures))
    columns, varying = _draw_columns(rng, outputs, needs, len(pressures))
    wheel = outputs != (DENSITY,)
    field_rows = _EASY_ROWS if tier == "easy" else int(rng.choice(_HARD_ROWS))
    spread = rng.random()
    return Design(
        tier=tier,
        models=models,
        inflation_kpa=pressures,
        lab_slips=slips,
        lab_rows=len(pressures) * len(slips) if wheel else int(rng.integers(24, 46)),
        field_rows=field_rows,
        test_rows=36,
        columns=columns,
        varying=varying,
        ground_pressure=wheel and (RUT in outputs or rng.random() < 0.7),
        psi=bool(rng.random() < 0.25),
        wobble=0.03 if rng.random() < 0.25 else 0.0,
        load_span=0.15 if outputs == (RUT,) and spread < 0.4 else (0.008 if spread < 0.2 else 0.0),
        levels=bool(rng.random() < 0.65),
        coupling=_draw_coupling(rng, tier),
        noise=_draw_noise(rng, tier),
    )
