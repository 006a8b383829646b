"""Fits: data files x models x priors x hold-outs, each a posterior."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from itertools import product
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

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
from calib.batch.campaign.place import Place, word
from calib.batch.folders import read_folder
from calib.data import Table
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.emulation.prepared import emulated
from calib.inference.estimators import estimate
from calib.inference.io import save_calibration
from calib.inference.prior_files import default_priors, prior_file_model
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import get_model
from calib.models.simulators.registered import slow_simulator
from calib.report.study_tasks import HoldOut, read_and_split
from calib.report.verdict import Verdict, keep_verdict, verdict
from calib.validation.validate import validate_held_out

SHIPPED, NOTHING = "shipped", "nothing"

# What is run of a slow simulator does not depend on a task's own stream: it is what
# `calib fit` runs by default, so that neither runs anything twice.
_EMULATION_SEED = 2019


class FitSection(Section):
    """``[[fit]]``: every file with every model, its priors and every hold-out."""

    data: list[str] = Field(min_length=1, description="a list of CSV files, patterns allowed")
    models: list[str] = Field(min_length=1, description="a list of models (see `calib models`)")
    priors: list[str] = Field(
        default=[SHIPPED], min_length=1,
        description=f"a list of prior files, each for one of the models, and {SHIPPED!r}",
    )  # fmt: skip
    hold_out: list[str] = Field(
        default=[NOTHING], min_length=1,
        description=f"a list of COLUMN=VALUE, the rows to hold out, and {NOTHING!r}",
    )  # fmt: skip
    max_steps: int = Field(
        default=25_600, ge=100, description="100 or more steps, where extending the chains stops"
    )
    posteriors: bool = Field(
        default=True, description="true or false: whether to keep a run folder for `calib predict`"
    )


# A problem on the rows that are not held out, these, how to sample, whether to keep it, and what
# became of the emulation of its simulator, if it needed one.
type FitItem = tuple[Problem, Table | None, SamplerSettings, bool, Emulated | None]


class Fit(Kind[FitSection, FitItem]):
    """Calibrate one model on one file, as `calib fit` does."""

    name = "fit"
    section = FitSection

    def plan(self, section: FitSection, place: Place) -> Iterator[Planned]:
        """Yield a task for each file, model, prior file and hold-out."""
        priors = _priors(section, place)
        with place.telling("hold_out"):
            for text in section.hold_out:
                _held(text)
        for path, model in product(place.find("data", section.data), section.models):
            for (prior, prior_path), out in product(priors[model], section.hold_out):
                yield Planned(
                    f"{place.word(path)}.{model}.{word(prior)}.{word(out)}",
                    {
                        "data": place.name(path), "model": model, "priors": prior,
                        "hold_out": out, "max_steps": section.max_steps,
                        "posteriors": section.posteriors, **simulators_of([model]),
                    },
                    {"data": path} | ({"priors": prior_path} if prior_path else {}),
                )  # fmt: skip

    def load(self, task: Task) -> FitItem:
        """Read the file and bind the model to it; emulate its simulator if that has to be."""
        model = get_model(task.settings["model"])
        kept = _held(task.settings["hold_out"])
        fitted, held = read_and_split(task.inputs["data"], (*model.conditions, model.output), kept)
        problem = build_problem(model.name, fitted, task.inputs.get("priors"))
        settings = SamplerSettings(max_steps=task.settings["max_steps"])
        made: Emulated | None = None
        if slow_simulator(model.name) is not None:
            emulation = emulated(problem, _EMULATION_SEED, elsewhere=[] if held is None else [held])
            problem, made = emulation.problem, Emulated.of(emulation)
        return problem, held, settings, task.settings["posteriors"], made

    def work(self, item: FitItem, seed: int) -> Work:
        """Sample the posterior, and score it on the rows that were held out."""
        problem, held, settings, posterior, emulation = item
        model = problem.bound.model.name
        point = estimate(problem, "least_squares", generator(seed, model, "least_squares"))
        calibration = calibrate(problem, seed, estimates=(point,), settings=settings)
        numbers = _numbers(calibration)
        validation = None if held is None else validate_held_out(calibration, held)
        fails = () if emulation is None else emulation.numbers.get("reasons", ())
        judged = verdict(calibration, validation, emulator_fails=fails)
        numbers["verdict"] = judged.headline
        files = dict(_run_folder(calibration, judged)) if posterior else {}
        if emulation is not None:
            # A posterior under an emulator that is too far off is not to be used either.
            numbers["converged"] = numbers["converged"] and emulation.passed
            numbers["emulator"] = emulation.numbers
            files[EMULATION] = emulation_file([emulation])
        if judged.warnings:
            numbers["warnings"] = " | ".join(judged.warnings)
        if problem.table.label:
            numbers["data_label"] = problem.table.label
        if validation is not None:
            scores = validation.scores
            numbers["held_out"] = {
                "rows": scores.n, "rmse": scores.rmse,
                "crps": scores.crps if isfinite(scores.crps) else None,
                "in_90_percent_band": scores.coverage[0.9].hits,
            }  # fmt: skip
        return Work(numbers, files)


def _priors(section: FitSection, place: Place) -> dict[str, list[tuple[str, Path | None]]]:
    """Return names and paths of the prior files of each model."""
    with place.telling("models"):
        found: dict[str, list[tuple[str, Path | None]]] = {
            get_model(m).name: [] for m in section.models
        }
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
                where=f"{place.where}, priors", allowed=", ".join(found),
                mend="add the model, or leave the file out",
            )  # fmt: skip
        found[model].append((place.name(path), path))
    bare = [model for model, files in found.items() if not files]
    if bare:
        raise CalibError(
            f"no prior file is for {', '.join(bare)}", where=f"{place.where}, priors",
            mend=f"add {SHIPPED!r} to the list, or a file for each model",
        )  # fmt: skip
    return found


def _held(text: str) -> HoldOut | None:
    return None if text == NOTHING else HoldOut.parse(text)


def _numbers(calibration: Calibration) -> dict[str, Any]:
    report = calibration.draws.report
    return {
        "model": calibration.problem.bound.model.name,
        "rows": len(calibration.problem.table),
        "converged": report.passed,
        "rhat": float(report.rhat.max()),
        "ess": float(min(report.ess_bulk.min(), report.ess_tail.min())),
        "log_evidence": calibration.draws.log_evidence,
        "posterior": {
            s.name: {key: value for key, value in asdict(s).items() if key in _SHOWN}
            for s in calibration.summary.values()
        },
    }


_SHOWN = ("unit", "mean", "sd", "median", "hdi_lower", "hdi_upper", "sd_ratio")


def _run_folder(calibration: Calibration, judged: Verdict) -> Mapping[str, str | bytes]:
    # How long it took stands elsewhere: without it, equal posteriors are equal files.
    calibration = replace(calibration, draws=replace(calibration.draws, seconds=0.0))
    with TemporaryDirectory() as scratch:
        save_calibration(calibration, Path(scratch))
        keep_verdict(judged, Path(scratch))
        return {f"run/{name}": data for name, data in read_folder(Path(scratch)).items()}
