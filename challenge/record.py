"""A scenario as plain data, so that a sealed key holds what its cases were made from."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from challenge.design import Design
from challenge.mechanism import CONDITION_NAMES, Conditions
from challenge.scenario import Scenario


def scenario_record(scenario: Scenario) -> dict[str, Any]:
    """Return what a scenario is made of as JSON can hold it.

    Parameters
    ----------
    scenario : Scenario
        Its tyre is the tyre of all tests and not recorded.
    """
    simulator = scenario.simulator
    return {
        # Pairs, since a key's names are sorted and the order of the outputs has a meaning.
        "design": _design_record(scenario.design),
        "soil": asdict(scenario.reality.soil),
        "cone": asdict(scenario.reality.cone),
        "lab": _conditions_record(scenario.lab),
        "field": _conditions_record(scenario.field),
        "fresh": _conditions_record(scenario.test),
        "levels": simulator.levels,
        "theta": {name: [float(v) for v in values] for name, values in simulator.theta.items()},
    }


def _design_record(design: Design) -> dict[str, Any]:
    record = {**asdict(design), "models": list(design.models.items())}
    record["fresh_rows"] = record.pop("test_rows")  # the name that keys have for it
    return record


def _conditions_record(conditions: Conditions) -> dict[str, Any]:
    """Return each condition's values, a single one where it does not vary."""
    record: dict[str, Any] = {"size": conditions.size}
    for name in CONDITION_NAMES:
        values = [float(v) for v in getattr(conditions, name)]
        record[name] = values if conditions.varies(name) else values[0]
    return record
