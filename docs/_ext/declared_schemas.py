"""JSON schemas of the files, made from the models of pydantic that read or describe them."""

from __future__ import annotations

from typing import Any

from result_schemas import RESULTS

from calib.batch.campaign.kinds import KINDS
from calib.checking.check import Manifest
from calib.imports.mapping import Mapped
from calib.inference.io import RunRecord
from calib.inference.prior_files import PriorFileContent
from calib.models.simulators.files import SimulatorFile
from calib.report.comparison import ComparisonRecord


def schemas() -> dict[str, dict[str, Any]]:
    """Return the schemas by the names of their files."""
    return {
        "priors": PriorFileContent.model_json_schema(),
        "mapping": Mapped.model_json_schema(),
        "plan": _plan(),
        "simulator": SimulatorFile.model_json_schema(),
        "manifest": _without_document(Manifest.model_json_schema()),
        "run": _without_document(RunRecord.model_json_schema()),
        "comparison": _without_document(ComparisonRecord.model_json_schema()),
        **{name: of.model_json_schema() for name, of in RESULTS.items()},
    }


def _without_document(schema: dict[str, Any]) -> dict[str, Any]:
    """Leave the whole file out, kept beside what is read of it: no entry of its own."""
    del schema["properties"]["document"]
    schema["required"].remove("document")
    return schema


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
