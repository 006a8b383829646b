"""Diagnoses: case folders, each told where the model misses, why, and how far it can be mended."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import Field

from calib.batch.campaign.kinds.base import (
    EMULATION,
    Emulated,
    Kind,
    Planned,
    Section,
    Task,
    Work,
    emulation_file,
    simulators_of,
)
from calib.batch.campaign.place import Place
from calib.batch.folders import read_folder
from calib.data.quantities import OUTPUTS
from calib.gap.batch import written
from calib.gap.case import Case, case_files, read_case
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.effects import EFFECTS, Effect
from calib.gap.effects.load import load_effects
from calib.inference.emulation.prepared import emulated_for_both
from calib.models import MODELS
from calib.models.simulators.emulator import emulator_of, save_emulator
from calib.models.simulators.registered import slow_simulator
from calib.report.page.diagnosis import write_page

# What is run of a slow simulator does not depend on a task's own stream: it is what
# `calib diagnose` runs by default, so that neither runs anything twice.
_EMULATION_SEED = 1


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


# A case; the user's file of effects, first, and the prior files beside it; whether to write a page;
# what became of simulators that had to be emulated.
type DiagnosisItem = tuple[Case, Mapping[str, bytes], bool, tuple[Emulated, ...]]


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
            content, files = case_files(case)
            models = content.get("models")
            settings = {
                "case": place.name(case), "effects": section.effects, "pages": section.pages,
                **simulators_of(models.values() if isinstance(models, dict) else ()),
            }  # fmt: skip
            yield Planned(place.word(case), settings, files | extra)

    def load(self, task: Task) -> DiagnosisItem:
        """Read the case; emulate simulators that have to be."""
        effects = {
            path.name: path.read_bytes()
            for label, path in task.inputs.items()
            if label.startswith("effects")
        }
        path = task.inputs["case.toml"]
        case = read_case(path.parent)
        return case, effects, task.settings["pages"], _emulated(case, _EMULATION_SEED)

    def work(self, item: DiagnosisItem, seed: int) -> Work:
        """Diagnose it."""
        case, effects, page, emulated = item
        with _effects(effects) as own, _in_place(emulated):
            found = diagnose(case, seed, effects={**EFFECTS, **own})
            files: dict[str, str | bytes] = {**written(found, effects)}
            files |= _page(found, seed) if page else {}
        numbers = diagnosis_numbers(found)
        if case.label:
            numbers["data_label"] = case.label
        if emulated:
            # A verdict under an emulator that is too far off is not to be used.
            numbers |= {} if all(e.passed for e in emulated) else {"converged": False}
            numbers["emulator"] = {e.model.name: e.numbers for e in emulated}
            files |= {EMULATION: emulation_file(emulated), **_emulators(emulated)}
        return Work(numbers, files)


def _emulated(case: Case, seed: int) -> tuple[Emulated, ...]:
    others = [] if case.new_conditions is None else [case.new_conditions]
    found = []
    for output, model in case.models.items():
        column = OUTPUTS[output]
        if slow_simulator(model) is None or column not in case.lab or column not in case.field:
            continue
        lab, field = (t.take(np.isfinite(t[column])) for t in (case.lab, case.field))
        made = emulated_for_both(
            model, lab, field, seed, priors=case.priors.get(output), elsewhere=others
        )
        found.append(Emulated.of(*made))
    return tuple(found)


@contextmanager
def _in_place(emulated: Sequence[Emulated]) -> Iterator[None]:
    """Let models be their emulators, in this process and for this task."""
    before = [MODELS[e.model.name] for e in emulated if e.model.name in MODELS]
    try:
        for e in emulated:
            MODELS.discard(e.model.name)
            MODELS.add(e.model)
        yield
    finally:
        for e in emulated:
            MODELS.discard(e.model.name)
        for model in before:
            MODELS.add(model)


def _emulators(emulated: Sequence[Emulated]) -> dict[str, bytes]:
    """Return the emulators as files, to predict from the diagnosis."""
    with TemporaryDirectory() as scratch:
        for e in emulated:
            if (emulator := emulator_of(e.model)) is not None:
                save_emulator(emulator, e.model.name, Path(scratch) / f"{e.model.name}.npz")
        return {f"emulators/{name}": data for name, data in read_folder(Path(scratch)).items()}


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
