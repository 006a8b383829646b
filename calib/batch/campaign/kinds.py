"""The kinds of task a plan may ask for, by the names of their tables.

A kind is a table of the plan, the tasks it stands for, and their work: fits, diagnoses and
replicates of simulation-based calibration. Another kind is a table, three functions and a line at
the end.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import product
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import Field

from calib.batch.campaign.kind import (
    Emulated,
    Kind,
    Place,
    Planned,
    Section,
    Task,
    Work,
    emulation_file,
    files_of,
    simulators_of,
    word,
)
from calib.data import Table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.batch import written
from calib.gap.case import Case, case_files, read_case
from calib.gap.describe import gap_document
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.effects import EFFECTS, Effect
from calib.gap.effects.user import load_effects
from calib.inference.calibration import calibrate
from calib.inference.emulation.prepared import emulated, emulated_for_both
from calib.inference.estimators import estimate
from calib.inference.io import save_calibration
from calib.inference.prior_files import default_priors, prior_file_model
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, get_model
from calib.models.simulators.declaration import slow_simulator
from calib.models.simulators.emulator import emulator_of, save_emulator
from calib.report.page.diagnosis import write_page
from calib.report.study import HoldOut, read_and_split
from calib.report.verdict import keep_verdict, verdict
from calib.validation.replicate import Item, replicate
from calib.validation.sbc import SETTINGS, chosen_models
from calib.validation.validate import validate_held_out

SHIPPED, NOTHING = "shipped", "nothing"  # in a list of prior files, and of rows to hold out


# Fits


class FitSection(Section):
    """``[[fit]]``: every file with every model, its priors and every hold-out."""

    data: list[str] = Field(min_length=1, description="a list of CSV files, patterns allowed")
    models: list[str] = Field(min_length=1, description="a list of models (see `calib models`)")
    priors: list[str] = Field(
        default=[SHIPPED],
        min_length=1,
        description=f"a list of prior files, each for one of the models, and {SHIPPED!r}",
    )
    hold_out: list[str] = Field(
        default=[NOTHING],
        min_length=1,
        description=f"a list of COLUMN=VALUE, the rows to hold out, and {NOTHING!r}",
    )
    max_steps: int = Field(
        default=25_600, ge=100, description="100 or more steps, where extending the chains stops"
    )
    posteriors: bool = Field(
        default=True, description="true or false: whether to keep a run folder for `calib predict`"
    )


# A problem on the rows that are not held out, these, how to sample, whether to keep it, and what
# became of the emulation of its simulator, if it needed one.
type FitItem = tuple[Problem, Table | None, SamplerSettings, bool, Emulated | None]


def _plan_fits(section: FitSection, place: Place) -> Iterator[Planned]:
    """Yield a task for each file, model, prior file and hold-out."""
    priors = _priors(section, place)
    with place.naming("hold_out"):
        for text in section.hold_out:
            _held(text)
    for path, model in product(place.find("data", section.data), section.models):
        for (prior, prior_path), out in product(priors[model], section.hold_out):
            settings = {
                "data": place.name(path), "model": model, "priors": prior, "hold_out": out,
                "max_steps": section.max_steps, "posteriors": section.posteriors,
                **simulators_of([model]),
            }  # fmt: skip
            inputs = {"data": path} | ({"priors": prior_path} if prior_path else {})
            yield f"{place.word(path)}.{model}.{word(prior)}.{word(out)}", settings, inputs


def _priors(section: FitSection, place: Place) -> dict[str, list[tuple[str, Path | None]]]:
    """Return names and paths of the prior files of each model."""
    found: dict[str, list[tuple[str, Path | None]]]
    with place.naming("models"):
        found = {get_model(m).name: [] for m in section.models}
    for name in section.priors:
        if name == SHIPPED:
            for model, files in found.items():
                own = default_priors(model)
                # A model's own are in its file, of which the plan knows nothing more.
                files.append((SHIPPED, own if isinstance(own, Path) else None))
            continue
        path = place.file("priors", name)
        model = prior_file_model(path)
        if model not in found:
            raise CalibError(
                f"{name} holds priors of {model}, which is not fitted",
                where=f"{place.where}, priors",
                expected=", ".join(found),
                hint="add the model, or leave the file out",
            )
        found[model].append((place.name(path), path))
    if bare := [model for model, files in found.items() if not files]:
        raise CalibError(
            f"no prior file is for {', '.join(bare)}",
            where=f"{place.where}, priors",
            hint=f"add {SHIPPED!r} to the list, or a file for each model",
        )
    return found


def _held(text: str) -> HoldOut | None:
    return None if text == NOTHING else HoldOut.parse(text)


def _load_fit(task: Task) -> FitItem:
    """Read the file and bind the model to it; emulate its simulator if that has to be."""
    model = get_model(task.settings["model"])
    kept = _held(task.settings["hold_out"])
    fitted, held = read_and_split(task.inputs["data"], (*model.conditions, model.output), kept)
    problem = build_problem(model.name, fitted, task.inputs.get("priors"))
    made: Emulated | None = None
    if slow_simulator(model.name) is not None:
        # With the seed of `calib fit`, not the task's: neither runs anything twice.
        emulation = emulated(problem, 2019, elsewhere=[] if held is None else [held])
        problem, made = emulation.problem, Emulated.of(emulation)
    settings = SamplerSettings(max_steps=task.settings["max_steps"])
    return problem, held, settings, task.settings["posteriors"], made


def _fit(item: FitItem, seed: int) -> Work:
    """Sample the posterior, as `calib fit` does, and score it on the rows that were held out."""
    problem, held, settings, posterior, emulation = item
    model = problem.bound.model.name
    point = estimate(problem, "least_squares", generator(seed, model, "least_squares"))
    calibration = calibrate(problem, seed, estimates=(point,), settings=settings)
    report = calibration.draws.report
    shown = ("unit", "mean", "sd", "median", "hdi_lower", "hdi_upper", "sd_ratio")
    numbers: dict[str, Any] = {
        "model": model,
        "rows": len(problem.table),
        "converged": report.passed,
        "rhat": float(report.rhat.max()),
        "ess": float(min(report.ess_bulk.min(), report.ess_tail.min())),
        "log_evidence": calibration.draws.log_evidence,
        "posterior": {
            s.name: {key: getattr(s, key) for key in shown} for s in calibration.summary.values()
        },
    }
    validation = None if held is None else validate_held_out(calibration, held)
    fails = () if emulation is None else emulation.numbers.get("reasons", ())
    judged = verdict(calibration, validation, emulator_fails=fails)
    numbers["verdict"] = judged.headline
    files: dict[str, str | bytes] = {}
    if posterior:
        # How long it took stands elsewhere: without it, equal posteriors are equal files.
        timeless = replace(calibration, draws=replace(calibration.draws, seconds=0.0))

        def keep(folder: Path) -> None:
            save_calibration(timeless, folder)
            keep_verdict(judged, folder)

        files |= {f"run/{name}": data for name, data in files_of(keep).items()}
    if emulation is not None:
        numbers["converged"] = report.passed and emulation.numbers["passed"]
        numbers["emulator"] = emulation.numbers
        files |= emulation_file([emulation])
    if judged.warnings:
        numbers["warnings"] = " | ".join(judged.warnings)
    if problem.table.label:
        numbers["data_label"] = problem.table.label
    if validation is not None:
        scores = validation.scores
        numbers["held_out"] = {
            "rows": scores.n,
            "rmse": scores.rmse,
            "crps": scores.crps if isfinite(scores.crps) else None,
            "in_90_percent_band": scores.coverage[0.9].hits,
        }
    return numbers, files


# Diagnoses


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


def _plan_diagnoses(section: DiagnoseSection, place: Place) -> Iterator[Planned]:
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
        yield place.word(case), settings, files | extra


def _load_diagnosis(task: Task) -> DiagnosisItem:
    """Read the case; emulate simulators that have to be."""
    effects = {
        path.name: path.read_bytes()
        for label, path in task.inputs.items()
        if label.startswith("effects")
    }
    case = read_case(task.inputs["case.toml"].parent)
    others = [] if case.new_conditions is None else [case.new_conditions]
    made = []
    for output, model in case.models.items():
        column = OUTPUTS[output]
        if slow_simulator(model) is None or column not in case.lab or column not in case.field:
            continue
        lab, field = (t.take(np.isfinite(t[column])) for t in (case.lab, case.field))
        # With the seed of `calib diagnose`, not the task's: neither runs anything twice.
        both = emulated_for_both(
            model, lab, field, 1, priors=case.priors.get(output), elsewhere=others
        )
        made.append(Emulated.of(*both))
    return case, effects, task.settings["pages"], tuple(made)


def _diagnose(item: DiagnosisItem, seed: int) -> Work:
    """Diagnose a case, as `calib diagnose` does."""
    case, effects, page, made = item
    with _effects(effects) as own, MODELS.standing_in(*(e.model for e in made)):
        found = diagnose(case, seed, effects={**EFFECTS, **own})
        files: dict[str, str | bytes] = {**written(found, effects)}
        if page:
            files |= files_of(lambda folder: write_page(gap_document(found), folder))
    numbers = diagnosis_numbers(found)
    if case.label:
        numbers["data_label"] = case.label
    if made:
        # A verdict under an emulator that is too far off is not to be used.
        numbers |= {} if all(e.numbers["passed"] for e in made) else {"converged": False}
        numbers["emulator"] = {e.model.name: e.numbers for e in made}
        files |= emulation_file(made)
        # To predict from the diagnosis.
        kept = files_of(lambda folder: _keep_emulators(made, folder))
        files |= {f"emulators/{name}": data for name, data in kept.items()}
    return numbers, files


def _keep_emulators(made: Sequence[Emulated], folder: Path) -> None:
    for e in made:
        if (emulator := emulator_of(e.model)) is not None:
            save_emulator(emulator, e.model.name, folder / f"{e.model.name}.npz")


@contextmanager
def _effects(files: Mapping[str, bytes]) -> Iterator[Mapping[str, Effect]]:
    """Yield the user's effects; their prior files are read while they are in use."""
    with TemporaryDirectory() as scratch:
        paths = [Path(scratch) / name for name in files]
        for path in paths:
            path.write_bytes(files[path.name])
        yield load_effects(paths[0]) if paths else {}


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
                "rmse_before": s.rmse_before,
                "rmse_after": s.rmse_after,
                "fraction": s.fraction,
                "lower": s.interval[0],
                "upper": s.interval[1],
            }
            for output, s in found.shrink.items()
        },
        "warnings": len(found.warnings),
    }


# Simulation-based calibration


class SbcSection(Section):
    """``[[sbc]]``: simulated campaigns of some models."""

    simulations: int = Field(ge=1, description="how many of each model, 1 or more")
    draw_seed: int = Field(
        ge=0, description="0 or a positive whole number: which campaigns are drawn"
    )
    models: list[str] = Field(
        default=chosen_models(),
        min_length=1,
        description="a list of models, see `calib models`; by default all that are not slow",
    )


def _plan_sbc(section: SbcSection, place: Place) -> Iterator[Planned]:
    """Yield a task for each replicate of `calib sbc --seed DRAW_SEED`, which judges them all."""
    with place.naming("models"):
        names = [get_model(name).name for name in section.models]
    for model in names:
        if slow_simulator(model) is not None:
            # Its truths are runs, and so it is emulated on the way: for one process at a time.
            raise CalibError(
                f"the simulator behind {model} is emulated for every replicate, which a campaign "
                "cannot do side by side",
                where=f"{place.where}, models",
                expected="closed forms, and simulators with emulate = false",
                hint=f"use calib sbc --model {model} --data CSV, which spreads the runs "
                "themselves over --workers",
            )
        for i in range(section.simulations):
            settings = {
                "model": model, "index": i, "draw_seed": section.draw_seed,
                "sampler": asdict(SETTINGS),
            }  # fmt: skip
            yield f"{model}-{i:04d}", settings, {}


def _load_sbc(task: Task) -> Item:
    s = task.settings
    return Item(s["model"], s["index"], s["draw_seed"], SETTINGS)


def _sbc(item: Item, seed: int) -> Work:
    """Run the replicate; its record is what `calib sbc` keeps of it."""
    record = replicate(item)
    numbers = {key: record[key] for key in ("model", "converged", "steps", "extended")}
    # As a fraction of the draws: uniform between 0 and 1 if all is right.
    numbers |= {"rank": {name: rank / n for name, (rank, n) in record["ranks"].items()}}
    return numbers, {"replicate.json": json.dumps(record, indent=1) + "\n"}


KINDS: Mapping[str, Kind] = {
    "fit": Kind(FitSection, _plan_fits, _load_fit, _fit),
    "diagnose": Kind(DiagnoseSection, _plan_diagnoses, _load_diagnosis, _diagnose),
    "sbc": Kind(SbcSection, _plan_sbc, _load_sbc, _sbc),
}
