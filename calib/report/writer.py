"""Write a study as one folder: page, figures, numbers, posteriors, manifest. It only formats."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calib.batch.environment import Environment, sha256
from calib.batch.folders import fresh_folder
from calib.batch.pool import HERE, Later, Pool
from calib.data import Table, write_table
from calib.data.files import read_text
from calib.inference.estimators import GeneticSettings
from calib.inference.io import groups_of, write_netcdf
from calib.inference.prior_files import default_priors
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import get_model
from calib.models.simulators.emulator import emulator_of, save_emulator
from calib.report.drawing import Drawn, begin_figures
from calib.report.figures.plate import Plate
from calib.report.page.content import render_page
from calib.report.publish import publication
from calib.report.sections import Found
from calib.report.study import OutputResult, Progress, Study
from calib.report.study_tasks import Task
from calib.report.summary import summarise

SCHEMA = "calib/manifest/2"


def file_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a folder but the manifest, by relative path."""
    return {
        path.relative_to(folder).as_posix(): sha256(path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).as_posix() != "manifest.json"
    }


def build_manifest(
    study: Study,
    settings: SamplerSettings,
    command: Sequence[str],
    inputs: Mapping[str, Mapping[str, Any]],
    *,
    title: str = "",
    environment: Environment | None = None,
) -> dict[str, Any]:
    """Return the manifest of a study, its file hashes still to be added.

    `inputs` are for every output the files its data and priors were copied to, and their hashes.
    ``seconds`` is the one place of a report that holds durations, which no two runs share.
    """
    return {
        "schema": SCHEMA,
        "title": title,
        "command": list(command),
        "seed": study.seed,
        **(environment or Environment.here()).document(),
        "settings": json.loads(json.dumps(asdict(settings))),
        "genetic_algorithm": asdict(GeneticSettings()),
        "tasks": {k: _task(r.task, inputs[k]) for k, r in study.results.items()},
        "seconds": {
            "study": study.seconds,
            **{
                key: {**r.seconds, "methods": {e.method: e.seconds for e in r.estimates}}
                for key, r in study.successes.items()
            },
        },
    }


def _task(task: Task, inputs: Mapping[str, Any]) -> dict[str, Any]:
    held = task.held_out
    return {
        "model": task.model,
        "held_out": None if held is None else {"column": held.column, "value": held.value},
        "label": task.table.label,
        **inputs,
    }


def write_report(
    study: Study,
    out: Path,
    *,
    settings: SamplerSettings,
    command: Sequence[str],
    title: str,
    sections: Sequence[Found] = (),
    overwrite: bool = False,
    posteriors: bool = True,
    views: bool = True,
    environment: Environment | None = None,
    pdf: bool = False,
    drawn: Mapping[str, Later[Drawn]] | None = None,
    progress: Progress | None = None,
    pool: Pool = HERE,
) -> Path:
    """Write a report folder, whole or not at all, and return the path of its ``index.html``.

    Parameters
    ----------
    settings : SamplerSettings
        Of the study, for the manifest; so is the command line.
    sections : sequence of Found
        What it shows beside its outputs, in their order on the page.
    posteriors : bool
        Whether to keep the netCDF files, which are megabytes. Where they are left out, the
        manifest says so and has their hashes.
    views : bool
        Whether to keep what follows from the numbers: page, figures, tables, diagnoses of gaps. To
        keep under version control, numbers and inputs are enough; durations go too.
    environment : Environment, optional
        Where the manifest says the report was made: that of this process by default.
    pdf : bool
        Whether every figure also comes as PDF, for print.
    drawn : mapping of str to Later of Drawn, optional
        Figures of the outputs, if they were asked for already.
    pool : Pool, optional
        Where figures are drawn.

    Raises
    ------
    CalibError
        If the folder exists, and an earlier report is not to be replaced, or cannot be written.
    """
    tell = progress or (lambda what, done, planned: None)
    successes = study.successes
    with fresh_folder(out, overwrite=overwrite) as folder:
        inputs = _copy_inputs(study, folder)
        (folder / "figures").mkdir()
        pieces = begin_figures(study, pool, pdf=pdf) if drawn is None else drawn
        versions = (environment or Environment.here()).versions
        begun = [s.begin(folder, versions=versions, pdf=pdf, pool=pool) for s in sections]
        # Short, so last: both processes end at about the same time.
        kept = [pool.submit(_keep, key, result, folder) for key, result in successes.items()]
        summary = summarise(study)
        for section in sections:
            numbers = section.summary()
            if numbers is not None:
                summary[section.name] = numbers
        (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
        manifest = build_manifest(
            study, settings, command, inputs, title=title, environment=environment
        )
        manifest["pdf"] = pdf
        paper = publication(manifest, summary)
        for path, text in paper.files.items():
            (folder / path).parent.mkdir(exist_ok=True)
            (folder / path).write_text(text, encoding="utf-8")
        manifest |= {section.name: section.record() for section in sections}
        plates: dict[str, tuple[Plate, ...]] = {}
        images: dict[str, bytes] = {}
        for i, (key, piece) in enumerate(pieces.items()):
            tell("drawing figures", i, len(pieces))
            found = piece.result()
            plates[key] = found.plates
            images |= found.images
            for name, content in {**found.images, **found.prints}.items():
                (folder / "figures" / name).write_bytes(content)
        tell("drawing figures", len(pieces), len(pieces))
        for netcdf in kept:
            netcdf.result()
        page = render_page(
            study,
            plates,
            images,
            manifest=manifest,
            title=title,
            more=[finish(tell) for finish in begun],
            reconstructed=any(r.task.table.label for r in study.results.values()),
            paper=paper,
        )
        (folder / "index.html").write_text(page, encoding="utf-8")
        files = file_hashes(folder)
        left_out = [] if posteriors else [f"{key}.nc" for key in successes]
        manifest["views"] = views
        manifest["left_out"] = {name: files.pop(name) for name in left_out}
        if not views:
            del manifest["seconds"]
            files = {name: files[name] for name in files if _is_kept(name)}
        for made in sorted(folder.rglob("*"), reverse=True):  # what is in a folder before it
            if made.is_dir():
                with suppress(OSError):  # not empty
                    made.rmdir()
            elif made.relative_to(folder).as_posix() not in files:
                made.unlink()
        manifest["files"] = files
        (folder / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    return Path(out) / ("index.html" if views else "summary.json")


def _is_kept(name: str) -> bool:
    """Whether a file is numbers or input, not a view of them."""
    return name.startswith(("data/", "priors/", "emulators/")) or (
        "/" not in name and name.endswith(".json")
    )


def _keep(key: str, result: OutputResult, folder: Path) -> None:
    """Write the posterior of an output."""
    write_netcdf(groups_of(result.calibration), folder / f"{key}.nc")


def own_names(table: Table) -> dict[str, Any]:
    """Return the file's own column names, where they are not those of the copy that is kept."""
    return {} if table.header == tuple(table.columns) else {"header": list(table.header)}


def _copy_inputs(study: Study, folder: Path) -> dict[str, dict[str, Any]]:
    """Copy data and priors into the report, so that it can be computed again from itself."""
    (folder / "data").mkdir()
    (folder / "priors").mkdir()
    inputs = {}
    for key, result in study.results.items():
        task = result.task
        prior_path = task.prior_path or default_priors(task.model)
        write_table(folder / "data" / f"{key}.csv", task.table.whole())
        data = (folder / "data" / f"{key}.csv").read_bytes()
        priors = read_text(prior_path).encode()
        (folder / "priors" / f"{key}.toml").write_bytes(priors)
        emulator = emulator_of(get_model(task.model))
        if emulator is not None:
            save_emulator(emulator, task.model, folder / "emulators" / f"{key}.npz")
        inputs[key] = {
            "data": {
                "file": f"data/{key}.csv",
                "sha256": sha256(data),
                "source": task.table.source,
                "source_sha256": task.table.sha256,
                **own_names(task.table),
                "ignored": list(task.table.ignored),
            },
            "priors": {
                "file": f"priors/{key}.toml",
                "sha256": sha256(priors),
                "source": prior_path.name,
                "shipped": task.prior_path is None,
            },
        }
    return inputs
