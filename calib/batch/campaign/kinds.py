"""The kinds of task a plan may ask for, by the names of their tables.

A kind is a table of the plan, the tasks it stands for, and their work: fits, diagnoses, challenge
cases (made by the repository's test bench, which a wheel does not have) and replicates of
simulation-based calibration. Another kind is a class here and a line at the end.
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
from typing import Any, Literal

import numpy as np
from pydantic import Field

from calib.batch.campaign.kind import (
    EMULATION,
    Emulated,
    Kind,
    Place,
    Planned,
    Section,
    Task,
    Work,
    emulation_file,
    simulators_of,
    word,
)
from calib.batch.environment import from_the_bench, source_sha256
from calib.batch.folders import read_folder
from calib.data import Table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.batch import written
from calib.gap.case import Case, case_files, read_case
from calib.gap.diagnose import Diagnosis, diagnose
from calib.gap.effects import EFFECTS, Effect
from calib.gap.effects.user import load_effects
from calib.inference.calibration import Calibration, calibrate
from calib.inference.emulation.prepared import emulated, emulated_for_both
from calib.inference.estimators import estimate
from calib.inference.io import save_calibration
from calib.inference.prior_files import default_priors, prior_file_model
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import MODELS, get_model
from calib.models.simulators.emulator import emulator_of, save_emulator
from calib.models.simulators.registered import slow_simulator
from calib.report.page.diagnosis import write_page
from calib.report.study_tasks import HoldOut, read_and_split
from calib.report.verdict import Verdict, keep_verdict, verdict
from calib.validation.replicate import Item, replicate
from calib.validation.sbc import SETTINGS, chosen_models
from calib.validation.validate import validate_held_out

# What is run of a slow simulator does not depend on a task's own stream: it is what
# `calib fit` runs by default, so that neither runs anything twice.
_FIT_EMULATION_SEED = 2019

SHIPPED, NOTHING = "shipped", "nothing"


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
            emulation = emulated(
                problem, _FIT_EMULATION_SEED, elsewhere=[] if held is None else [held]
            )
            problem, made = emulation.problem, Emulated.of(emulation)
        return problem, held, settings, task.settings["posteriors"], made

    def work(self, item: FitItem, seed: int) -> Work:
        """Sample the posterior, and score it on the rows that were held out."""
        problem, held, settings, posterior, emulation = item
        model = problem.bound.model.name
        point = estimate(problem, "least_squares", generator(seed, model, "least_squares"))
        calibration = calibrate(problem, seed, estimates=(point,), settings=settings)
        numbers = _fit_numbers(calibration)
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
                where=f"{place.where}, priors", expected=", ".join(found),
                hint="add the model, or leave the file out",
            )  # fmt: skip
        found[model].append((place.name(path), path))
    bare = [model for model, files in found.items() if not files]
    if bare:
        raise CalibError(
            f"no prior file is for {', '.join(bare)}", where=f"{place.where}, priors",
            hint=f"add {SHIPPED!r} to the list, or a file for each model",
        )  # fmt: skip
    return found


def _held(text: str) -> HoldOut | None:
    return None if text == NOTHING else HoldOut.parse(text)


def _fit_numbers(calibration: Calibration) -> dict[str, Any]:
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


# As for `calib diagnose` by default.
_CASE_EMULATION_SEED = 1


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
        return case, effects, task.settings["pages"], _emulated_case(case, _CASE_EMULATION_SEED)

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


def _emulated_case(case: Case, seed: int) -> tuple[Emulated, ...]:
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


class SbcSection(Section):
    """``[[sbc]]``: simulated campaigns of some models."""

    simulations: int = Field(ge=1, description="how many of each model, 1 or more")
    draw_seed: int = Field(
        ge=0, description="0 or a positive whole number: which campaigns are drawn"
    )
    models: list[str] = Field(
        default=chosen_models(), min_length=1,
        description="a list of models, see `calib models`; by default all that are not slow",
    )  # fmt: skip


class Sbc(Kind[SbcSection, Item]):
    """One replicate, that of `calib sbc --seed DRAW_SEED`, which judges them all together."""

    name = "sbc"
    section = SbcSection

    def plan(self, section: SbcSection, place: Place) -> Iterator[Planned]:
        """Yield a task for each replicate."""
        with place.telling("models"):
            names = [get_model(name).name for name in section.models]
        for model in names:
            if slow_simulator(model) is not None:
                # Its truths are runs, and so it is emulated on the way: for one process at a time.
                raise CalibError(
                    f"the simulator behind {model} is emulated for every replicate, which a "
                    "campaign cannot do side by side", where=f"{place.where}, models",
                    expected="closed forms, and simulators with emulate = false",
                    hint=f"use calib sbc --model {model} --data CSV, which spreads the runs "
                    "themselves over --workers",
                )  # fmt: skip
            for i in range(section.simulations):
                yield Planned(
                    f"{model}-{i:04d}",
                    {"model": model, "index": i, "draw_seed": section.draw_seed,
                     "sampler": asdict(SETTINGS)},
                )  # fmt: skip

    def load(self, task: Task) -> Item:
        """Return what the replicate needs."""
        s = task.settings
        return Item(s["model"], s["index"], s["draw_seed"], SETTINGS)

    def work(self, item: Item, seed: int) -> Work:
        """Run the replicate; its record is what `calib sbc` keeps of it."""
        record = replicate(item)
        numbers = {key: record[key] for key in ("model", "converged", "steps", "extended")}
        # As a fraction of the draws: uniform between 0 and 1 if all is right.
        numbers |= {"rank": {name: rank / n for name, (rank, n) in record["ranks"].items()}}
        return Work(numbers, {"replicate.json": json.dumps(record, indent=1) + "\n"})


_TABLE = "[[challenge]]"


class ChallengeSection(Section):
    """``[[challenge]]``: cases drawn from a seed."""

    cases: int = Field(ge=1, description="how many, 1 or more")
    draw_seed: int = Field(ge=0, description="0 or a positive whole number: which cases are drawn")
    tier: Literal["both", "easy", "hard"] = Field(
        default="both", description="'easy', 'hard' or 'both'"
    )
    null_fraction: float = Field(
        default=1.0 / 3.0, ge=0.0, le=0.7, description="the share without a gap, 0 to 0.7"
    )


# A case's seed, tier and truth, and the hash of the code that makes it.
type ChallengeItem = tuple[np.random.SeedSequence, Literal["easy", "hard"], str, str]


class Challenge(Kind[ChallengeSection, ChallengeItem]):
    """Make, diagnose and mark one case.

    The cases are those of `calib challenge make --seed DRAW_SEED`, but their answers lie beside
    the diagnoses: this is for figures over many cases, not for a test that others should believe.
    """

    name = "challenge"
    section = ChallengeSection

    def plan(self, section: ChallengeSection, place: Place) -> Iterator[Planned]:
        """Yield a task for each case."""
        with from_the_bench(place.where):
            from challenge.make import case_jobs

        tiers: tuple[Any, ...] = ("easy", "hard") if section.tier == "both" else (section.tier,)
        jobs, _ = case_jobs(section.draw_seed, section.cases, tiers, section.null_fraction)
        for name, (own, tier, truth) in jobs.items():
            yield Planned(
                name,
                {"draw_seed": section.draw_seed, "spawn_key": list(own.spawn_key), "tier": tier,
                 "truth": truth, "bench": _bench()},
            )  # fmt: skip

    def load(self, task: Task) -> ChallengeItem:
        """Return what the case is made from."""
        s = task.settings
        own = np.random.SeedSequence(s["draw_seed"], spawn_key=tuple(s["spawn_key"]))
        return own, s["tier"], s["truth"], s["bench"]

    def work(self, item: ChallengeItem, seed: int) -> Work:
        """Make the case, diagnose its files, and mark the diagnosis with its key."""
        with from_the_bench(_TABLE):
            from challenge.answers import read_answer
            from challenge.make import make_case

        own, tier, truth, bench = item
        if _bench() != bench:
            raise CalibError(
                "this worker would make other cases", where=_TABLE,
                expected=f"the folder `challenge` whose hash is {bench}",
                hint="give the worker the same checkout",
            )  # fmt: skip
        made = make_case(own, tier, truth)
        with TemporaryDirectory() as scratch:
            folder = Path(scratch) / "case"
            made.write(folder)
            found = diagnose(read_case(folder), seed)
            files = written(found)
            for name in ("diagnosis.json", "fresh_prediction.csv"):
                (folder / name).write_bytes(files[name])
            answer = read_answer("case", made.key, folder)
        numbers = {
            "tier": answer.tier,
            "truth": answer.truth,
            "truth_probability": answer.truth_probability,
            "right_first": answer.among_first(1),
            "right_first_two": answer.among_first(2),
            "localisation_auc": answer.auc,
            "gap_over_noise": made.key["gap_over_noise"],
            "actual_shrink": {s.output: s.actual for s in answer.shrinks},
            "shrink_covered": {s.output: s.covered for s in answer.shrinks},
        }
        return Work(numbers | diagnosis_numbers(found), files)


def _bench() -> str:
    """Return the hash of the bench's code here."""
    import challenge

    return source_sha256(Path(challenge.__path__[0]))[:12]


KINDS: dict[str, Kind[Any, Any]] = {
    kind.name: kind for kind in (Fit(), Diagnose(), Challenge(), Sbc())
}
