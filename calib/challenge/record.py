"""A stage as plain data and back, so that a sealed key holds what its cases were made on."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.challenge.density import ConeLaw
from calib.challenge.design import Design, Noise
from calib.challenge.mechanics import Reality, self_propelled_slip, simulate
from calib.challenge.mechanism import CONDITION_NAMES, Conditions, Readings
from calib.challenge.soil import Soil
from calib.challenge.stage import Stage
from calib.challenge.surrogate import Simulator
from calib.challenge.tyre import Tyre

type Array = NDArray[np.float64]

_TUPLES = ("inflation_kpa", "lab_slips", "columns", "varying")


def stage_record(stage: Stage) -> dict[str, Any]:
    """Return what a stage is made of as JSON can hold it.

    Parameters
    ----------
    stage : Stage
        Its tyre is the tyre of all tests and not recorded.
    """
    simulator = stage.simulator
    return {
        # Pairs, since a key's names are sorted and the order of the outputs has a meaning.
        "design": {**asdict(stage.design), "models": list(stage.design.models.items())},
        "soil": asdict(stage.reality.soil),
        "cone": asdict(stage.reality.cone),
        "lab": _conditions_record(stage.lab),
        "field": _conditions_record(stage.field),
        "fresh": _conditions_record(stage.fresh),
        "levels": simulator.levels,
        "theta": {name: [float(v) for v in values] for name, values in simulator.theta.items()},
    }


def read_stage(record: dict[str, Any]) -> Stage:
    """Return the stage of a record.

    Parameters
    ----------
    record : dict
        From `stage_record`.
    """
    design = _design(record["design"])
    reality = Reality(Soil(**record["soil"]), Tyre(), ConeLaw(**record["cone"]))
    parts = [_conditions(record[name]) for name in ("lab", "field", "fresh")]
    zeros = [self_propelled_slip(reality, part.inflation_kpa) for part in parts]
    measured = [_measured(reality, design, *each) for each in zip(parts, zeros, strict=True)]
    theta = {name: np.array(values) for name, values in record["theta"].items()}
    return Stage(
        design=design,
        reality=reality,
        lab=parts[0],
        field=parts[1],
        fresh=parts[2],
        field_zero=zeros[1],
        fresh_zero=zeros[2],
        lab_readings=measured[0],
        field_without=measured[1],
        fresh_without=measured[2],
        lab_sd=_sd(design, measured[0], parts[0]),
        field_sd=_sd(design, measured[1], parts[1]),
        simulator=Simulator(design.models, theta, int(record["levels"])),
    )


def _design(record: dict[str, Any]) -> Design:
    tuples = {name: tuple(record[name]) for name in _TUPLES}
    changed = {"models": dict(record["models"]), "noise": Noise(**record["noise"])}
    return Design(**{**record, **tuples, **changed})


def _measured(reality: Reality, design: Design, part: Conditions, zero: Array) -> Readings:
    got = simulate(reality, part, zero)
    return {name: got[name] for name in design.outputs}


def _sd(design: Design, readings: Readings, part: Conditions) -> Readings:
    return {name: design.noise.sd(name, value, part.slip) for name, value in readings.items()}


def _conditions_record(conditions: Conditions) -> dict[str, Any]:
    """Return each condition's values, a single one where it does not vary."""
    record: dict[str, Any] = {"size": conditions.size}
    for name in CONDITION_NAMES:
        values = [float(v) for v in getattr(conditions, name)]
        record[name] = values if conditions.varies(name) else values[0]
    return record


def _conditions(record: dict[str, Any]) -> Conditions:
    size = int(record["size"])
    filled = {
        name: np.broadcast_to(np.asarray(record[name], dtype=np.float64), (size,)).copy()
        for name in CONDITION_NAMES
    }
    return Conditions(**filled)
