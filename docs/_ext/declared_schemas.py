"""JSON schemas of the files that are read with pydantic."""

from __future__ import annotations

from typing import Any

from calib.batch.campaign.kinds import KINDS
from calib.check.schema import Manifest, RunRecord
from calib.inference.prior_entries import json_schema


def schemas() -> dict[str, dict[str, Any]]:
    """Return the schemas by the names of their files."""
    run = RunRecord.model_json_schema()
    # The whole file, kept beside what is read of it: no entry of its own.
    del run["properties"]["document"]
    run["required"].remove("document")
    return {
        "priors": json_schema(),
        "plan": _plan(),
        "manifest": Manifest.model_json_schema(),
        "run": run,
    }


def _plan() -> dict[str, Any]:
    """Return the schema of a plan: a seed, and lists of tables of every kind."""
    tables: dict[str, Any] = {
        name: {"type": "array", "items": kind.section.model_json_schema()}
        for name, kind in KINDS.items()
    }
    return {
        "title": "plan.toml",
        "type": "object",
        "properties": {"seed": {"type": "integer", "minimum": 0}} | tables,
        "additionalProperties": False,
    }
