"""Diagnoses: case folders, each told where the model misses, why, and how far it can be mended."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import Field

from calib.batch.campaign.kinds.base import (
    Kind,
    Planned,
    Section,
    Task,
    Work,
    refuse_slow_simulators,
)  # fmt: skip
from calib.batch.campaign.place import Place
from calib.batch.folders import read_folder
from calib.gap.batch import written
from calib.gap.case import Case, case_files, read_case
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.effects import EFFECTS, Effect
from calib.gap.effects.load import load_effects
from calib.report.page.gap_page import write_page


class DiagnoseSection(Section):
    """``[[diagnose]]``: every case folder."""

    cases: list[str] = Field(
        min_length=1, description="a list of folders with a case.toml, patterns allowed"
    )
    effects: str | None = Field(
        default=None, description="a Python file with effects of your own, as for `calib diagnose`"
    )
    pages: bool = Field(
        default=False, description="true or false: whether to draw figures and write a page each"
    )


# A case; the user's file of effects, first, and the prior files beside it; whether to write a page.
type DiagnosisItem = tuple[Case, Mapping[str, bytes], bool]


class Diagnose(Kind[DiagnoseSection, DiagnosisItem]):
    """Diagnose one case, as `calib diagnose` does."""

    name = "diagnose"
    section = DiagnoseSection

    def plan(self, section: DiagnoseSection, place: Place) -> Iterator[Planned]:
        """Yield a task for each case folder."""
        extra: dict[str, Path] = {}
        if section.effects is not None:
            path = place.file("effects", section.effects)
            extra["effects"] = path
            for name, effect in load_effects(path).items():
                if effect.prior_file is not None:
                    extra[f"effects, {name}.toml"] = effect.prior_file
        for case in place.find("cases", section.cases, holding="case.toml"):
            settings = {
                "case": place.name(case), "effects": section.effects, "pages": section.pages
            }  # fmt: skip
            yield Planned(place.word(case), settings, case_files(case)[1] | extra)

    def load(self, task: Task) -> DiagnosisItem:
        """Read the case."""
        effects = {
            path.name: path.read_bytes()
            for label, path in task.inputs.items()
            if label.startswith("effects")
        }
        path = task.inputs["case.toml"]
        case = read_case(path.parent)
        refuse_slow_simulators(case.models.values(), f"{path}, [models]", "calib diagnose")
        return case, effects, task.settings["pages"]

    def work(self, item: DiagnosisItem, seed: int) -> Work:
        """Diagnose it."""
        case, effects, page = item
        with _effects(effects) as own:
            found = diagnose(case, seed, effects={**EFFECTS, **own})
            files = written(found, effects) | (_page(found, seed) if page else {})
        return Work(diagnosis_numbers(found), files)


@contextmanager
def _effects(files: Mapping[str, bytes]) -> Iterator[Mapping[str, Effect]]:
    """Yield the user's effects; their prior files are read while they are in use."""
    with TemporaryDirectory() as scratch:
        paths = [Path(scratch) / name for name in files]
        for path in paths:
            path.write_bytes(files[path.name])
        yield load_effects(paths[0]) if paths else {}


def _page(found: Diagnosis, seed: int) -> dict[str, bytes]:
    with TemporaryDirectory() as scratch:
        write_page(found, Path(scratch), {"seed": seed})
        return read_folder(Path(scratch))


def diagnosis_numbers(found: Diagnosis) -> dict[str, Any]:
    """Return the key numbers of a diagnosis."""
    ranking = found.ranking
    first, second = (*ranking.order, "", "")[:2]
    return {
        "verdict": found.verdict,
        "first": first,
        "probability": ranking.probability[first],
        "second": second,
        "second_probability": ranking.probability.get(second),
        "none": ranking.probability.get("none"),
        "unknown": ranking.probability.get("unknown"),
        "shrink": {
            output: {
                "rmse_before": s.rmse_before, "rmse_after": s.rmse_after, "fraction": s.fraction,
                "lower": s.interval[0], "upper": s.interval[1],
            }
            for output, s in found.shrink.items()
        },
        "warnings": len(found.warnings),
    }  # fmt: skip
