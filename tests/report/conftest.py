from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from calib.batch.environment import Environment
from calib.inference.sampler import SamplerSettings
from calib.report.document import summarise
from calib.report.publish import Publication, publication
from calib.report.sections import Report
from calib.report.study import Failure, Study
from calib.report.writer import build_manifest

type Records = tuple[dict[str, Any], dict[str, Any]]


def records(results: dict[str, Any]) -> Records:
    """Manifest and summary of some results, as they are read back from a report."""
    study = Study(results, 42, 3.2)
    inputs = {
        key: {
            "data": {"file": f"data/{key}.csv", "sha256": f"{i:02x}da7a" * 8, "ignored": [],
                     "source": r.task.table.source,
                     "source_sha256": "ab" * 32},
            "priors": {"file": f"priors/{key}.toml", "sha256": f"{i:02x}b0b1" * 8,
                       "source": f"{r.task.model}.toml"},
        }
        for i, (key, r) in enumerate(results.items())
    }  # fmt: skip
    command = ["calib", "report", "--out", "a folder"]
    manifest = build_manifest(
        Report(study), SamplerSettings(), command, "A <title>", Environment.here(), inputs
    )
    return json.loads(json.dumps(manifest)), json.loads(json.dumps(summarise(study)))


@pytest.fixture(scope="session")
def he2019(density, drawbar, rut) -> Records:
    # The genetic algorithm takes seconds: what least squares found stands for what it would find.
    searched = replace(density.estimates[0], method="genetic")
    density = replace(density, estimates=(*density.estimates, searched))
    return records({"bulk_density": density, "drawbar_pull": drawbar, "rut_depth": rut})


@pytest.fixture(scope="session")
def users(plate, unconverged) -> Records:
    """A user's own data, one output not converged, one that failed."""
    failed = Failure(replace(plate.task, output="bulk_density"), "CalibError: no rows")
    return records({"rut_depth": plate, "drawbar_pull": unconverged, "bulk_density": failed})


@pytest.fixture(scope="session")
def published(he2019) -> Publication:
    return publication(*he2019)
