"""Functional mock-up units (FMI 2.0 and 3.0), simulated by FMPy in processes of their own."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calib.models.base import Array
from calib.models.constants import FMU_CALLS
from calib.models.simulators.process import call_function
from calib.models.simulators.simulator import Failure, Given


@dataclass(frozen=True)
class FmuRunner:
    """An FMU: parameters and conditions are start values of its variables, named in `names`.

    It is simulated for each row of conditions, and outputs are those at the end; with `along` once,
    to the last row, and outputs are series at steps of its own, which it gives under this name.
    `experiment` has arguments of FMPy's ``simulate_fmu``. `limit` is in seconds for each process.
    """

    path: Path
    sha256: str
    names: Mapping[str, str]
    columns: tuple[str, ...]
    experiment: Mapping[Any, float]
    along: str = ""
    limit: float = 600.0
    key: ClassVar[str] = "fmu"
    runs: ClassVar[bool] = True

    @property
    def identity(self) -> str:
        """The content of the FMU, and how it is simulated."""
        return json.dumps(["fmu", self.sha256, dict(self.names), dict(self.experiment)])

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Simulate it."""
        lists = {name: v.tolist() for name, v in conditions.items()}
        given = {"output": [self.names[c] for c in self.columns], **self.experiment}
        n = next(iter(conditions.values())).size
        if times := lists.pop(self.along, None):
            n, given["until"] = 1, max(times)
        lists |= {name: [value] * n for name, value in parameters.items()}
        starts = [{self.names[name]: v[i] for name, v in lists.items()} for i in range(n)]
        found: list[dict[str, Array]] = []
        for i in range(0, n, FMU_CALLS):
            # Unpacked here, because a process that is ended removes nothing.
            with tempfile.TemporaryDirectory("", "calib-run-", ignore_cleanup_errors=True) as name:
                told = (str(self.path), name, starts[i : i + FMU_CALLS], given)
                made = call_function(simulated, told, self.limit)
            if isinstance(made, Failure):
                return made
            found += made
        last = {c: np.array([one[self.names[c]][-1] for one in found]) for c in self.columns}
        series = {c: found[0][self.names.get(c, "time")] for c in (self.along, *self.columns)}
        return series if times else last


def simulated(
    path: str, folder: str, starts: Sequence[Mapping[str, float]], given: Mapping[str, Any]
) -> list[dict[str, Array]]:
    """Unpack an FMU in a folder and return its series for each set of start values."""
    import fmpy

    fmpy.extract(path, folder)
    described: Any = fmpy.read_model_description(folder, False)
    planned, co = described.defaultExperiment, described.coSimulation
    told = {"model_description": described, "remote_platform": None, **given}
    end = told.get("until") or told.get("stop_time") or planned.stopTime
    if "until" in told:  # and to the end of a step, where an FMU has such
        step = getattr(co, "fixedInternalStepSize", None) or getattr(planned, "stepSize", None)
        step = float(given.get("output_interval") or step or 0.0)
        told.setdefault("stop_time", told.pop("until") + step)
    found = []
    for start in starts:
        series = fmpy.simulate_fmu(folder, start_values=start, **told)
        kept = np.append(np.diff(time := series["time"]) > 0.0, True)  # after an event, not before
        if not (time[-1] >= float(end) or np.isclose(time[-1], float(end))):
            raise RuntimeError(f"it ended at the time {time[-1]:g}, before {end}")
        found.append({name: series[name][kept] for name in series.dtype.names})
    return found
