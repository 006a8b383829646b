"""A case as files: the tables and the case file of the contract, and its answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from challenge.build import DrawnCase
from challenge.design import Design, Noise
from challenge.mechanism import DENSITY, DRAWBAR, RUT, Conditions, Readings
from challenge.record import scenario_record
from challenge.tyre import PSI_KPA, average_ground_pressure

type Array = NDArray[np.float64]

OUTPUT_COLUMNS = {
    DRAWBAR: "drawbar_pull_kn",
    RUT: "rut_depth_mm",
    DENSITY: "bulk_density_g_cm3",
}
_DECIMALS = {DRAWBAR: 4, RUT: 3, DENSITY: 4}
_COLUMNS = {
    "run_order": "run_order",
    "slip": "slip_ratio",
    "inflation_kpa": "inflation_pressure_kpa",
    "load_kn": "normal_load_kn",
    "speed_m_s": "speed_m_s",
    "pass_number": "pass_number",
    "water_content": "gravimetric_water_content",
    "cone_index_kpa": "cone_index_kpa",
}
_COUNTS = ("run_order", "pass_number")


@dataclass(frozen=True)
class CaseFiles:
    """One case, ready to be written.

    Attributes
    ----------
    files : dict
        File name to text.
    answer : dict
        What is true of it, as ``answer.json`` has it.
    """

    files: dict[str, str]
    answer: dict[str, Any]


def _condition_columns(design: Design, conditions: Conditions) -> dict[str, list[str]]:
    """Return the recorded conditions as text, in the contract's order."""
    columns: dict[str, list[str]] = {}
    for name, column in _COLUMNS.items():
        if name in design.columns and name != "cone_index_kpa":
            values = getattr(conditions, name)
            if name == "inflation_kpa" and design.psi:
                column, values = "inflation_pressure_psi", np.round(values / PSI_KPA, 3)
            columns[column] = [str(int(v)) if name in _COUNTS else repr(float(v)) for v in values]
    if design.ground_pressure:
        pressure = average_ground_pressure(conditions.inflation_kpa, conditions.load_kn)
        columns["average_ground_pressure_kpa"] = [repr(float(v)) for v in np.round(pressure, 3)]
    if "cone_index_kpa" in design.columns:
        columns["cone_index_kpa"] = [repr(float(v)) for v in conditions.cone_index_kpa]
    return columns


def _table(columns: dict[str, list[str]]) -> str:
    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(row) for row in rows)]) + "\n"


def _readings(
    rng: np.random.Generator, noise: Noise, truth: Readings, sd: Readings
) -> dict[str, list[str]]:
    columns = {}
    for name, reading in truth.items():
        noisy = reading + noise.draw(rng, sd[name])
        step = noise.step(sd[name])
        if step:
            noisy = step * np.round(noisy / step)
        if name != DRAWBAR:
            # A ruler reads no negative rut and a cylinder no negative density.
            noisy = np.maximum(noisy, 0.05 * reading)
        rounded = np.round(noisy, _DECIMALS[name])
        columns[OUTPUT_COLUMNS[name]] = [repr(float(value)) for value in rounded]
    return columns


def _case_toml(design: Design) -> str:
    lines = ['calibration = "lab.csv"', 'field = "field.csv"', 'predict = "fresh.csv"', ""]
    lines += ["[models]", *(f'{output} = "{model}"' for output, model in design.models.items())]
    return "\n".join(lines) + "\n"


def _plain(readings: Readings) -> dict[str, list[float]]:
    return {name: [float(value) for value in values] for name, values in readings.items()}


def case_files(rng: np.random.Generator, case: DrawnCase) -> CaseFiles:
    """Add noise to a drawn case and lay it out as the contract asks.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the measurement noise.
    case : DrawnCase
        The case without noise.
    """
    scenario, design = case.scenario, case.scenario.design
    lab = _condition_columns(design, scenario.lab) | _readings(
        rng, design.noise, scenario.lab_readings, scenario.lab_sd
    )
    conditions = _condition_columns(design, scenario.field)
    field = conditions | _readings(rng, design.noise, case.field_truth, scenario.field_sd)
    told = case.told
    answer = {
        "salt": rng.bytes(16).hex(),
        "tier": design.tier,
        "truth": case.truth,
        "mechanism": case.mechanism,
        "gap_over_noise": case.gap_over_noise,
        "contributions": case.contributions,
        "isolable_nats": told.isolable_nats,
        "rival": told.rival,
        "rival_nats": told.rival_nats if np.isfinite(told.rival_nats) else None,
        "noise_sd": _plain(scenario.field_sd),
        "field_truth": _plain(case.field_truth),
        "field_without": _plain(scenario.field_without),
        "fresh_truth": _plain(case.test_truth),
        "fresh_without": _plain(scenario.test_without),
        # The name that keys had before scenarios were called so: the same seed, the same key.
        "stage": scenario_record(scenario),
    }
    files = {
        "case.toml": _case_toml(design),
        "lab.csv": _table(lab),
        "field.csv": _table(field),
        "fresh.csv": _table(_condition_columns(design, scenario.test)),
    }
    return CaseFiles(files, answer)
