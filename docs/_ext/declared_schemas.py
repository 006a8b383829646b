"""JSON schemas of the files, made from the models of pydantic that read or describe them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from result_schemas import RESULTS

from calib.batch.campaign.kinds import KINDS
from calib.checking.check import Manifest
from calib.gap.case import CaseFile
from calib.imports.mapping import Mapped
from calib.inference.io import RunRecord
from calib.inference.prior_files import PriorFileContent
from calib.models.simulators.files import SimulatorFile
from calib.report.comparison import ComparisonRecord
from challenge.format import Answer, Scored

# Committed, for those who implement the format: `python docs/_ext/declared_schemas.py` writes them.
OPEN = Path(__file__).parents[1] / "formats" / "schemas"


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
        **{name: of.model_json_schema() for name, of in RESULTS.items() if name != "case"},
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


def open_format() -> dict[str, str]:
    """Return the schemas of a case, its answer and a diagnosis as text, by the names of files."""
    kinds = {"case": CaseFile, "answer": Answer, "diagnosis": Scored}
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {
        f"{name}.json": json.dumps(draft | kind.model_json_schema(), indent=1) + "\n"
        for name, kind in kinds.items()
    }


if __name__ == "__main__":
    for file, text in open_format().items():
        (OPEN / file).write_text(text, encoding="utf-8")
