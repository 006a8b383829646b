"""What tables and methods read of a manifest and a summary, with names and types."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from calib.inference.calibration import ParameterSummary
from calib.models import get_model

_NAN = float("nan")


@dataclass(frozen=True)
class Output:
    """One output that was worked out: its entries in manifest and summary."""

    key: str
    model: str
    task: Mapping[str, Any]
    found: Mapping[str, Any]

    @property
    def name(self) -> str:
        """In words."""
        return self.key.replace("_", " ").capitalize()

    @property
    def model_words(self) -> str:
        """The model by its title and its place in the source, with marks."""
        model = get_model(self.model)
        source = f"the source [@{model.cited}]" if model.cited else model.source
        numbers = model.numbers.replace("-", "\N{EN DASH}")
        origin = f"{numbers} of {source}" if numbers and source else source
        return f"\u201c{model.title}\u201d" + (f" ({origin})" if origin else "")

    @property
    def label(self) -> str:
        """What the data are called; empty for measurements."""
        return str(self.found["data"]["label"])

    @property
    def data_words(self) -> str:
        """What to call the data."""
        return f"{self.label} data" if self.label else "data"

    @property
    def converged(self) -> bool:
        """Whether the posterior passed the gate."""
        return bool(self.found["sampling"]["converged"])

    @property
    def held_out(self) -> str:
        """Which rows were held out, in words; empty where none were."""
        held = self.task["held_out"]
        if held is None or self.found["validation"]["method"] != "held_out":
            return ""
        name, _, unit = held["column"].rpartition("_")
        return f"{name.replace('_', ' ')} {held['value']:g} {unit}"

    @property
    def estimates_use_all_rows(self) -> bool:
        """Whether point estimates are of more rows than the posterior: the source's were."""
        data = self.found["data"]
        return get_model(self.model).estimates_all_rows and bool(data["n_all"] > data["n"])

    @property
    def posterior(self) -> tuple[ParameterSummary, ...]:
        """Summaries of all parameters."""
        return tuple(_summary(name, entry) for name, entry in self.found["posterior"].items())


def outputs(manifest: Mapping[str, Any], summary: Mapping[str, Any]) -> list[Output]:
    """Return the outputs that were worked out; those that failed are left out."""
    return [
        Output(key, str(manifest["tasks"][key]["model"]), manifest["tasks"][key], found)
        for key, found in summary["models"].items()
        if "error" not in found
    ]


def _summary(name: str, entry: Mapping[str, Any]) -> ParameterSummary:
    """Read a posterior summary back; what JSON has no number for is NaN."""
    spelled = {**entry, "sd_ratio": entry["posterior_to_prior_sd"]}
    numbers: dict[str, Any] = {
        f.name: _NAN if spelled.get(f.name) is None else spelled[f.name]
        for f in fields(ParameterSummary)
        if f.name != "name"
    }
    return ParameterSummary(name=name, **numbers)
